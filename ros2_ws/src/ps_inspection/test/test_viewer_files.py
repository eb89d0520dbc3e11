"""The Foxglove layout and the RViz configuration are whole: every panel is placed and complete.

That their topics are those of the running cell is tested with the graph, in tests/.
"""
import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from ps_head_driver.frames import LINK_FRAME, OPTICAL_FRAME, PLANE_FRAME

CONFIG = Path(__file__).resolve().parents[1] / 'config'
LAYOUT = json.loads((CONFIG / 'foxglove_layout.json').read_text())
RVIZ = yaml.safe_load((CONFIG / 'ps_head.rviz').read_text())
# keys without which a panel shows nothing
NEEDED = {
    'Image': {'imageMode'}, 'RawMessages': {'topicPath'}, 'Plot': {'paths'}, '3D': {'layers'},
    'StateTransitions': {'paths'}, 'DiagnosticSummary': {'topicToRender'}, 'Tab': {'tabs'}}


def leaves(node: Any) -> list[str]:
    """Panels of a layout tree: a panel id, or a split in two."""
    if isinstance(node, str):
        return [node]
    assert set(node) == {'direction', 'first', 'second', 'splitPercentage'}
    assert node['direction'] in ('row', 'column')
    assert 0 < node['splitPercentage'] < 100
    return leaves(node['first']) + leaves(node['second'])


def test_foxglove_places_every_panel_once():
    assert set(LAYOUT) == {
        'configById', 'globalVariables', 'userNodes', 'playbackConfig', 'layout'}
    panels = LAYOUT['configById']
    placed = leaves(LAYOUT['layout'])
    for panel in placed:
        if panel.startswith('Tab!'):
            for tab in panels[panel]['tabs']:
                placed += leaves(tab['layout'])
    assert sorted(placed) == sorted(panels)


@pytest.mark.parametrize(('panel', 'content'), LAYOUT['configById'].items())
def test_foxglove_panel_has_what_its_kind_needs(panel, content):
    kind, _, identity = panel.partition('!')
    assert identity
    assert NEEDED[kind] <= set(content)
    for path in content.get('paths', []):
        assert path['value'].startswith('/')
        assert kind != 'Plot' or path['enabled'], 'a disabled path draws nothing'


def test_rviz_displays_are_of_jazzy_and_named():
    manager = RVIZ['Visualization Manager']
    displays = manager['Displays']
    assert [d['Class'].split('/')[0] for d in displays] == ['rviz_default_plugins'] * len(displays)
    names = [display['Name'] for display in displays]
    assert len(set(names)) == len(names)
    assert {'Head', 'Shape', 'Normals', 'Height'} <= set(names)
    # a latched description needs a latched reader, or RViz sees no head
    head = displays[names.index('Head')]
    assert head['Description Topic']['Durability Policy'] == 'Transient Local'


def test_rviz_frames_are_those_of_the_head():
    manager = RVIZ['Visualization Manager']
    shown = next(d for d in manager['Displays'] if d['Name'] == 'Frames')['Frames']
    assert set(shown) - {'All Enabled'} == {LINK_FRAME, OPTICAL_FRAME, PLANE_FRAME}
    assert manager['Global Options']['Fixed Frame'] == LINK_FRAME
    assert manager['Displays'][0]['Reference Frame'] == PLANE_FRAME
