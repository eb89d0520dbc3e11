"""Hostile sessions do no harm; bench/bench_session_fuzz.py tries a hundred thousand."""
from pathlib import Path
import resource

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
import pytest

pytest.importorskip('rclpy')

from session_attack import attack
from session_mutator import Mutator, small_session
from sessions import record, rendered

from ps_reconstruction.pipeline import warm_up


@pytest.fixture(scope='module')
def mutator(tmp_path_factory: pytest.TempPathFactory) -> Mutator:
    warm_up()       # the compiler's cache is no change outside
    folder = tmp_path_factory.mktemp('source') / 's'
    return Mutator(small_session(folder, record, rendered(scale=0.025)))


def test_the_unchanged_session_is_good(mutator: Mutator, tmp_path: Path) -> None:
    """Else nothing below would reach the code that it is to try."""
    from session_mutator import whole

    from ps_inspection.session_export import export_session
    from ps_reconstruction.session_reader import Session
    for number, data in enumerate((mutator.file, whole(mutator.records),
                                   mutator._with_stack(mutator.stack))):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / 's_0.mcap').write_bytes(data)
        outcome = export_session(Session(folder), folder / 'out')
        assert (outcome.done, outcome.failed, outcome.problems) == (1, {}, [])


@given(seed=st.integers(0, 2**32))
@settings(max_examples=250, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_hostile_sessions_do_no_harm(mutator: Mutator, tmp_path: Path, seed: int) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    _, wrong = attack(mutator, seed, tmp_path)
    assert wrong == []
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000    # kB
