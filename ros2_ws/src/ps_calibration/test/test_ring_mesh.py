"""The target as a solid and as drawings: closed, as large as its file says, readable."""
import json
import math
import re
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import yaml

from ps_calibration.cli import ps_ring_target
from ps_calibration.ring_mesh import is_closed, target_mesh, volume
from ps_calibration.ring_target import RingTarget, default_target_path


@pytest.fixture(scope='module')
def content() -> dict:
    return yaml.safe_load(default_target_path().read_text())


def run(monkeypatch, *arguments) -> None:
    monkeypatch.setattr(sys, 'argv', ['ps_ring_target', *map(str, arguments)])
    ps_ring_target.main()


@pytest.mark.parametrize('change', [
    {}, {'arc': [0.2, 2.9], 'slits': {'azimuths': [0.6, 2.0], 'width': 0.002}},
    {'slits': {'azimuths': [], 'width': 0.001}, 'inner_radius': 0.007, 'height': 0.009}])
def test_solid_is_closed_and_has_the_volume_of_its_dimensions(content: dict, change: dict) -> None:
    target = RingTarget.model_validate({**content, **change})
    mesh = target_mesh(target)
    assert is_closed(mesh)
    assert not is_closed(mesh[1:])
    width = target.slits.width

    def slit_to(radius: float) -> float:
        return (width / 2 * math.sqrt(radius ** 2 - width ** 2 / 4)
                + radius ** 2 * math.asin(width / 2 / radius))

    inner, outer = target.inner_radius, target.outer_radius
    wall = ((target.arc[1] - target.arc[0]) / 2 * (outer ** 2 - inner ** 2)
            - len(target.slits.azimuths) * (slit_to(outer) - slit_to(inner)))
    plate = target.base.size[0] * target.base.size[1] * target.base.thickness
    assert volume(mesh) - plate == pytest.approx(wall * target.height, rel=1e-4)
    corners = mesh.reshape(-1, 3)
    assert corners.min(axis=0) == pytest.approx(
        [-target.base.size[0] / 2, -target.base.size[1] / 2, -target.base.thickness])
    assert corners[:, 2].max() == pytest.approx(target.height)


def test_command_writes_what_it_says(content: dict, tmp_path, monkeypatch, capsys) -> None:
    stl, svg, dots = tmp_path / 'ring.stl', tmp_path / 'ring.svg', tmp_path / 'dots.svg'
    run(monkeypatch, '--stl', stl, '--drawing', svg, '--dots', dots, '--json', tmp_path / 'j')
    assert 'half-ring-24: the file is valid' in capsys.readouterr().out
    result = json.loads((tmp_path / 'j').read_text())
    data = stl.read_bytes()
    count = int(np.frombuffer(data, '<u4', 1, 80)[0])
    assert len(data) == 84 + 50 * count == 84 + 50 * result['triangles']
    record = np.dtype([('normal', '<f4', 3), ('corners', '<f4', (3, 3)), ('spare', '<u2')])
    triangles = np.frombuffer(data, record, count, 84)
    assert np.ptp(triangles['corners'].reshape(-1, 3), axis=0) == pytest.approx([60, 50, 7])
    assert volume(triangles['corners'].astype(float)) == pytest.approx(
        result['volume_m3'] * 1e9, rel=1e-4)
    top = triangles['corners'][:, :, 2].min(axis=1) > 3.999
    assert triangles['normal'][top] == pytest.approx(np.tile([0, 0, 1.0], (top.sum(), 1)))

    root = ET.parse(svg).getroot()
    assert root.get('width') == '297mm'
    assert root.get('viewBox') == '0 0 297 210'      # one unit is a millimetre
    texts = {element.text for element in root.iter('{http://www.w3.org/2000/svg}text')}
    assert {'60', '50', '4', '3', 'R10', 'R12', '90.00°', 'half-ring-24'} <= texts
    circles = re.findall(r'<circle class="dot" cx="([\d.]+)" cy="([\d.]+)" r="0.800"',
                         dots.read_text())
    places = np.array(circles, float) - np.array(circles[0], float)
    centres = np.array(content['fiducials']['centres']) * 1e3
    assert places * [1, -1] == pytest.approx(centres - centres[0], abs=2e-3)


def test_command_says_what_is_wrong(content: dict, tmp_path, monkeypatch) -> None:
    path = tmp_path / 'target.yaml'
    path.write_text(yaml.safe_dump({**content, 'height': 0}))
    with pytest.raises(SystemExit, match=r'CALIBRATION_BAD_REQUEST: .*target\.yaml: height'):
        run(monkeypatch, path)
    with pytest.raises(SystemExit, match=r'No such file'):
        run(monkeypatch, '--stl', tmp_path / 'no' / 'ring.stl')
