"""Hostile sessions do no harm; bench/bench_session_fuzz.py tries a hundred thousand."""
from pathlib import Path
import resource

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
import pytest

pytest.importorskip('rclpy')

from session_attack import attack
from session_mutator import CHUNK, METADATA, Mutator, small_session, text, whole
from session_mutator import record as record_bytes
from sessions import record, rendered

from ps_inspection.session_export import export_session
from ps_inspection.session_writer import SessionWriter, WriterOptions
from ps_reconstruction import session_reader
from ps_reconstruction.pipeline import warm_up
from ps_reconstruction.session_format import Topic
from ps_reconstruction.session_reader import MAGIC, Session


@pytest.fixture(scope='module')
def mutator(tmp_path_factory: pytest.TempPathFactory) -> Mutator:
    warm_up()       # the compiler's cache is no change outside
    folder = tmp_path_factory.mktemp('source') / 's'
    return Mutator(small_session(folder, record, rendered(scale=0.025)))


def test_the_unchanged_session_is_good(mutator: Mutator, tmp_path: Path) -> None:
    """Else nothing below would reach the code that it is to try."""
    for number, data in enumerate((mutator.file, whole(mutator.records),
                                   mutator._with_stack(mutator.stack))):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / 's_0.mcap').write_bytes(data)
        outcome = export_session(Session(folder), folder / 'out')
        assert (outcome.done, outcome.failed, outcome.problems) == (1, {}, [])


def test_what_is_kept_of_a_file_is_bounded(
        mutator: Mutator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 's_0.mcap').write_bytes(MAGIC + record_bytes(CHUNK, b'') * 5000)
    assert len(Session(tmp_path).info().scan.problems) < 300
    large = (METADATA, text('session') + text(text('notes') + text('x' * 100_000)))
    (tmp_path / 's_0.mcap').write_bytes(whole([*mutator.records, large]))
    assert Session(tmp_path).info().scan.metadata['session']['notes']
    monkeypatch.setattr(session_reader, 'MAX_DESCRIPTION_BYTES', 90_000)
    info = Session(tmp_path).info()
    assert 'notes' not in info.scan.metadata['session']
    assert 'larger than 90000 bytes' in info.scan.problems[0]


def test_names_are_shown_without_obeying_them(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from ps_inspection.cli.ps_session import main
    topic = Topic('/[/red]\x1b[2Jx', 'std_msgs/msg/String', definition='string data\n')
    SessionWriter(tmp_path / 's', [topic], WriterOptions(min_free_bytes=0),
                  {'session': {'notes': '[bold]\x1b]0;mine\x07'}}).close()
    main(['info', str(tmp_path / 's')])
    shown = capsys.readouterr().out
    assert '[/red]?[2Jx' in shown
    assert '[bold]?]0;mine?' in shown
    assert '\x1b' not in shown


@given(seed=st.integers(0, 2**32))
@settings(max_examples=250, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_hostile_sessions_do_no_harm(mutator: Mutator, tmp_path: Path, seed: int) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    _, wrong = attack(mutator, seed, tmp_path)
    assert wrong == []
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000    # kB
