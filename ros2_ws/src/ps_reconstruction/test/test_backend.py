"""The seam for GPU kernels, with a plug-in that is the CPU in disguise, and without one."""
from collections.abc import Iterator
import logging
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ps_reconstruction import backend, stv, stv_kernels, surface
from ps_reconstruction.integration import poisson
from ps_reconstruction.problem import Problem, constant_lights


@pytest.fixture(autouse=True)
def forget() -> Iterator[None]:
    backend._plugin.cache_clear()
    yield
    backend._plugin.cache_clear()


def glossy_bowl() -> Problem:
    y, x = np.mgrid[-0.6:0.6:60j, -0.6:0.6:70j]
    normal = np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=-1)
    azimuth = np.arange(4) * np.pi / 2
    lights = np.stack([0.5 * np.cos(azimuth), 0.5 * np.sin(azimuth), np.full(4, 0.87)], axis=-1)
    half = lights + np.array([0, 0, 1])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    value = 0.5 * np.clip(normal @ lights.T, 0, 1) + 0.4 * np.clip(normal @ half.T, 0, 1) ** 60
    grid, step = constant_lights(lights, x.shape)
    return Problem([np.ascontiguousarray(value[..., t], np.float32) for t in range(4)], grid, step,
                   np.ones((4, 1)))


def install(monkeypatch: pytest.MonkeyPatch, load: Any) -> None:
    monkeypatch.setattr(backend, 'entry_points',
                        lambda **_: [SimpleNamespace(load=load)])
    monkeypatch.setenv('PS_BACKEND', 'other')


def test_plug_in_gets_the_work_and_gives_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = glossy_bowl()
    expected = stv.solve(problem)
    calls: list[str] = []

    def spy(name: str) -> Any:
        def function(*arguments: Any) -> Any:
            calls.append(name)
            return getattr(stv_kernels, name)(*arguments)
        return function

    names = ('solve_pixels', 'combine_patches', 'finish')
    install(monkeypatch, lambda: SimpleNamespace(WHOLE=True, **{n: spy(n) for n in names}))
    found = stv.solve(problem)
    assert calls == list(names)       # once each: the whole picture at a time
    np.testing.assert_array_equal(found.normal, expected.normal)
    np.testing.assert_array_equal(found.reason, expected.reason)


def test_plug_in_may_replace_one_kernel_only(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, lambda: SimpleNamespace(
        solve_poisson=lambda right, *_: np.full_like(right, 7)))
    du, dv = np.zeros((2, 8, 9), np.float32)
    assert (poisson(du, dv) == 7).all()
    assert (surface.relief(du, dv, np.ones_like(du), 1.0, 2.0) == 7).all()
    assert np.isfinite(stv.solve(glossy_bowl()).normal).all()


def no_driver() -> None:
    raise OSError('libcuda.so.1: cannot open shared object file')


@pytest.mark.parametrize(('load', 'reason'), [(no_driver, 'libcuda'), (None, 'no such plug-in')])
def test_without_it_the_cpu_works_and_one_line_says_so(
    load: Any, reason: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
) -> None:
    expected = stv.solve(glossy_bowl())
    if load is None:
        monkeypatch.setenv('PS_BACKEND', 'not_installed')
    else:
        install(monkeypatch, load)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            found = stv.solve(glossy_bowl())
    np.testing.assert_array_equal(found.normal, expected.normal)
    [line] = [record.getMessage() for record in caplog.records]
    assert reason in line
    assert 'CPU' in line
