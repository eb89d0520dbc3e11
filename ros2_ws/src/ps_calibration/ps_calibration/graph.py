"""The nodes of this package, for launch files and ps_cell."""
from ps_head_driver.graph import NodeSpec

NODES = (NodeSpec('ps_calibration', 'ring_calibration', ('calibration_file', 'head_file')),)
