"""The benchmark's bookkeeping, and its figures on real data where these are present."""
import json
from pathlib import Path

import numpy as np
import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Light, Stack, Truth
from ps_head_driver.stack_folder import write_stack
from ps_reconstruction.benchmark import (
    PAPER,
    Error,
    Result,
    average,
    find_objects,
    rank_correlation,
    run,
    subsets_of,
)
from ps_reconstruction.cli import ps_diligent

TARGETS = {('ball', 'all'): 1.6, ('cat', 'all'): 4.9, ('ball', 'four'): 2.5, ('cat', 'four'): 7.2}


def result(name: str, mean: float) -> Result:
    error = Error(mean, mean, mean)
    return Result(name, 'all', 96, {'ls': error, 'stv': error}, 0.5, {'ls': 0.1, 'stv': 1.0},
                  None if name not in PAPER else {
                      'ls': Error(*PAPER[name][0]), 'stv': Error(*PAPER[name][1])})


def test_missing_normals_count_ninety_degrees() -> None:
    error = Error.of(np.array([0.0, 0.0, 0.0, np.nan]))
    assert error.mean == 22.5
    assert error.median == 0


def test_averages_are_those_of_the_paper() -> None:
    results = [result(name, 1.0) for name in PAPER]
    for method, mean, p90 in (('ls', 16.150, 31.509), ('stv', 14.412, 28.786)):
        value = average(results, method, paper=True)
        assert value is not None
        assert value.mean == pytest.approx(mean, abs=2e-3)
        assert value.p90 == pytest.approx(p90, abs=2e-3)
    assert average([result('unknown', 3.0)], 'ls', paper=True) is None


def test_rank_correlation_ignores_missing_values() -> None:
    a = np.array([1.0, 2.0, 3.0, np.nan])
    assert rank_correlation(a, np.array([10.0, 20.0, 25.0, 0.0])) == pytest.approx(1)


def test_folders_without_objects_are_named(tmp_path: Path) -> None:
    with pytest.raises(PsError) as caught:
        find_objects(tmp_path)
    assert caught.value.code == ErrorCode.RECONSTRUCTION_BAD_STACK
    assert str(tmp_path) in caught.value.message
    assert ps_diligent.main([str(tmp_path)]) == 1


def test_a_rendered_object_runs_from_folder_to_table(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    y, x = np.mgrid[0.6:-0.6:32j, -0.6:0.6:32j]
    normal = np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=-1)
    directions = np.array([[0.5, 0, 0.9], [0, 0.5, 0.9], [-0.5, 0, 0.9], [0, -0.5, 0.9],
                           [0.1, 0.1, 1.0]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    images = [np.repeat((50000 * np.clip(normal @ d, 0, 1)).astype(np.uint16)[..., None], 3, 2)
              for d in directions]
    lights = [Light(distant=True, axis=(-d[0], -d[1], -d[2]), intensity=(1.0, 1.0, 1.0),
                    name=f'{i + 1:03d}') for i, d in enumerate(directions)]
    mask = np.ones((32, 32), np.bool_)
    write_stack(Stack(images, lights, mask=mask), tmp_path / 'ballPNG',
                Truth(normal.astype(np.float32)))
    (tmp_path / 'subsets.json').write_text('{"ballPNG": {"four": [1, 2, 3, 4]}}')
    assert subsets_of(tmp_path / 'ballPNG') == ['all', 'four']
    report = tmp_path / 'table.json'
    assert ps_diligent.main([str(tmp_path), '--json', str(report), '--figures',
                             str(tmp_path / 'figures')]) == 0
    content = json.loads(report.read_text())
    assert [o['lights'] for o in content['objects']] == [5, 4]
    for entry in content['objects']:
        assert entry['errors']['ls']['mean'] < 0.2
        assert entry['errors']['stv']['mean'] < 0.2
        assert entry['paper']['stv']['mean'] == 3.451
    assert set(content['average']) == {'all', 'four'}
    assert len(list((tmp_path / 'figures').glob('ballPNG_*.png'))) == 2
    assert 'ballPNG' in capsys.readouterr().out


@pytest.mark.parametrize(('name', 'subset'), list(TARGETS))
def test_diligent_targets(data: Path, name: str, subset: str) -> None:
    folder = data / 'diligent' / f'{name}PNG'
    if not folder.is_dir():
        pytest.skip(f'{folder} is missing')
    [(found, _)] = run(folder, [subset])
    assert found.errors['stv'].mean <= TARGETS[name, subset]
    assert found.errors['stv'].p90 <= found.errors['ls'].p90
    assert found.rank_correlation > 0.1
