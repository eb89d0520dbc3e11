from collections.abc import Callable
import json
from pathlib import Path
import subprocess
import sys

import cv2
import numpy as np
import pytest

from ps_head_driver.stack import Truth
from ps_head_driver.stack_folder import write_stack
from ps_reconstruction.cli.ps_reconstruct import main


@pytest.fixture
def folder(render: Callable, tmp_path: Path) -> Path:
    """A stack folder of a tilted plate with its truth."""
    stack, normal, z = render(lambda x, y: 0.1 * x - 0.05 * y)
    stack.images[:] = [np.rint(image * 65535).astype(np.uint16) for image in stack.images]
    write_stack(stack, tmp_path / 'stack', Truth(normal.astype(np.float32), z.astype(np.float32)))
    return tmp_path / 'stack'


def test_files_and_figures(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out, report = tmp_path / 'out', tmp_path / 'report.json'
    assert main([str(folder), '--out', str(out), '--json', str(report)]) == 0
    assert 'mean' in capsys.readouterr().out
    content = json.loads(report.read_text())
    assert content['method'] == 'ls'
    assert content['lights'] == 4
    assert content['near_field'] is True
    assert content['valid_fraction'] == 1.0
    assert content['error_deg']['mean'] < 0.05
    assert set(content['error_deg']) == {'mean', 'median', 'p90'}
    assert content['timings_s']['normals'] > 0
    result = np.load(out / 'result.npz')
    assert set(result.files) == {
        'normal', 'slope', 'albedo', 'height', 'curvature', 'shape', 'confidence', 'reason',
        'mask'}
    assert result['slope'].reshape(-1, 2).mean(axis=0) == pytest.approx((0.1, -0.05), abs=2e-3)
    assert result['normal'][..., 2].min() > 0
    for name, kind in {'normal': np.uint16, 'slope': np.uint16, 'albedo': np.uint16,
                       'height': np.uint16, 'shape': np.uint8, 'height_view': np.uint8}.items():
        picture = cv2.imread(str(out / f'{name}.png'), cv2.IMREAD_UNCHANGED)
        assert picture.dtype == kind
    normal = cv2.imread(str(out / 'normal.png'), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_allclose(normal / 32767.5 - 1, result['normal'], atol=1e-4)


@pytest.mark.parametrize('method', ['ls', 'stv'])
def test_methods_and_subsets(folder: Path, tmp_path: Path, method: str) -> None:
    report = tmp_path / 'report.json'
    assert main([str(folder), '--out', str(tmp_path / 'out'), '--method', method,
                 '--lights', '1,2,3', '--json', str(report)]) == 0
    content = json.loads(report.read_text())
    assert (content['method'], content['lights']) == (method, 3)
    assert content['error_deg']['mean'] < 0.2


@pytest.mark.parametrize(('arguments', 'code', 'words'), [
    (['missing'], 1, 'no such'), (['{folder}', '--lights', '1,2'], 1, 'at least 3'),
    (['{folder}', '--lights', '1,2,99'], 1, '99'), (['{folder}', '--slant', '95'], 1, 'slant'),
    (['{folder}', '--method', 'magic'], 2, 'magic'), ([], 2, 'INPUT')])
def test_wrong_use_is_one_clear_line(
    folder: Path, tmp_path: Path, arguments: list[str], code: int, words: str,
) -> None:
    filled = [a.format(folder=folder) for a in arguments]
    done = subprocess.run(
        [sys.executable, '-m', 'ps_reconstruction.cli.ps_reconstruct', *filled,
         '--out', str(tmp_path / 'out')], capture_output=True, text=True, timeout=120,
        check=False)
    assert done.returncode == code
    assert words in done.stderr
    assert 'Traceback' not in done.stderr
    if code == 1:
        assert len(done.stderr.strip().splitlines()) == 1


def test_four_plain_pictures_are_relative(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    bumps = cv2.GaussianBlur(rng.normal(0, 1, (80, 100)), (0, 0), 4)
    q, p = np.gradient(bumps / bumps.std() * 2)
    for name, (x, y) in {'000': (0, -1), '090': (1, 0), '180': (0, 1), '270': (-1, 0)}.items():
        # slopes with y up: dz/dy = -q
        shading = (1 - p * x + q * y) / np.sqrt(1 + p * p + q * q)
        cv2.imwrite(str(tmp_path / f'part_{name}.png'),
                    np.clip(shading * 120, 0, 255).astype(np.uint8))
    report = tmp_path / 'report.json'
    assert main([str(tmp_path), '--out', str(tmp_path / 'out'), '--json', str(report)]) == 0
    content = json.loads(report.read_text())
    assert content['error_deg'] is None
    assert content['metric'] is False
    slope = np.load(tmp_path / 'out' / 'result.npz')['slope']
    assert np.corrcoef(slope[..., 0].ravel(), p.ravel())[0, 1] > 0.99
    assert np.corrcoef(slope[..., 1].ravel(), -q.ravel())[0, 1] > 0.99
