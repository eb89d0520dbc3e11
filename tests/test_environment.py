"""The process environment of the cell reaches Fast DDS."""
import os
from pathlib import Path
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest

from ps_inspection.environment import cell_environment, fastdds_profile

LARGEST_SEGMENT = r"""
import os, re, rclpy
others = set(os.listdir('/dev/shm'))
rclpy.init()
node = rclpy.create_node('measured')
sizes = [int(end, 16) - int(start, 16) for start, end, name in re.findall(
    r'^([0-9a-f]+)-([0-9a-f]+) .*/dev/shm/(fastrtps_\S+)', open('/proc/self/maps').read(), re.M)
    if name not in others]
print(max(sizes, default=0))
node.destroy_node()
rclpy.try_shutdown()
"""


@pytest.mark.graph
def test_profile_sets_the_shared_memory_segment(ros_domain: int) -> None:
    pytest.importorskip('rclpy')
    wanted = int(ElementTree.parse(fastdds_profile()).findtext('.//{*}segment_size') or 0)
    sizes = []
    for extra in ({}, cell_environment({})):
        environment = {name: value for name, value in os.environ.items()
                       if name not in cell_environment({})}
        result = subprocess.run([sys.executable, '-c', LARGEST_SEGMENT], check=True, timeout=60,
                                capture_output=True, text=True, env=environment | extra)
        sizes.append(int(result.stdout))
    assert sizes[0] < wanted <= sizes[1]


def test_values_of_the_user_win() -> None:
    assert cell_environment({'MALLOC_MMAP_MAX_': '9'})['MALLOC_MMAP_MAX_'] == '9'
    assert cell_environment({'MALLOC_MMAP_MAX_': ''})['MALLOC_MMAP_MAX_'] == '0'
    assert Path(cell_environment({})['FASTRTPS_DEFAULT_PROFILES_FILE']).is_file()
