"""The nodes of the whole cell, for inspection.launch.py and ps_cell."""
from ps_calibration.graph import NODES as CALIBRATION_NODES
from ps_head_driver.graph import NODES as HEAD_NODES
from ps_head_driver.graph import NodeSpec
from ps_reconstruction.graph import NODES as RECONSTRUCTION_NODES

NODES = (
    *HEAD_NODES, *RECONSTRUCTION_NODES, *CALIBRATION_NODES,
    NodeSpec('ps_inspection', 'session_recorder', ('session_folder',)),
    NodeSpec('ps_inspection', 'inspection', ('session_folder', 'output_folder')),
)
