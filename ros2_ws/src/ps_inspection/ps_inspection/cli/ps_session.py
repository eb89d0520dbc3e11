"""ps_session: look into, play, export, reconstruct, report and repair recorded sessions."""
import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import datetime
import json
import os
from pathlib import Path
import select
import signal
import sys
from typing import Any

from rich.console import Console
from rich.table import Table

from ps_head_driver.errors import PsError
from ps_inspection.session_recovery import recover
from ps_reconstruction.session_reader import Session

Report = dict[str, Any]


class _PlainConsole(Console):
    """Shows texts of files as they are: no markup, and nothing that a terminal would obey."""

    def print(self, *objects: Any, **options: Any) -> None:
        super().print(*(_plain(o) if isinstance(o, str) else o for o in objects), **options)


def _plain(text: str) -> str:
    return ''.join(c if c.isprintable() or c == '\n' else '?' for c in text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='ps_session', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Look into, play, export, reconstruct, report and repair recorded sessions.',
        epilog='example: ps_session info ~/ps_sessions/session_20260102_030405')
    commands = parser.add_subparsers(dest='command', required=True)

    def add(name: str, run: Callable[[argparse.Namespace, Console], Report], text: str,
            example: str) -> argparse.ArgumentParser:
        command = commands.add_parser(
            name, help=text, description=text, epilog=f'example: ps_session {name} {example}')
        command.add_argument('session', type=Path, metavar='SESSION',
                             help='session folder (or the .mcap file in it)')
        command.add_argument('--json', type=Path, metavar='FILE', help='write the result as JSON')
        command.set_defaults(run=run)
        return command

    add('info', _info, 'Say what is in a session, also in an unfinished one.', 'SESSION')
    add('recover', _recover, 'Make a session complete that a crash cut off.', 'SESSION')
    play = add('play', _play, 'Play a session into a running graph; Enter pauses.',
               'SESSION --rate 2')
    play.add_argument('--rate', type=_positive, default=1.0, help='2: twice as fast')
    play.add_argument('--start', type=float, default=0.0, metavar='S',
                      help='seconds to leave out at the beginning')
    play.add_argument('--loop', action='store_true', help='begin again at the end')
    play.add_argument('--all', action='store_true',
                      help='also reconstruction_info and diagnostics, which live nodes send')
    play.add_argument('--namespace', default='', help='in place of the recorded one')
    export = add('export', _export, 'Write stack folders and an index.csv.', 'SESSION --out DIR')
    export.add_argument('--out', type=Path, required=True, metavar='DIR')
    again = add('reconstruct', _reconstruct,
                'Reconstruct every stack; run again to go on after an interruption.',
                'SESSION --out DIR')
    again.add_argument('--out', type=Path, required=True, metavar='DIR')
    again.add_argument('--method', choices=('ls', 'stv'), default='',
                       help='in place of the recorded one')
    again.add_argument('--workers', type=_count, default=len(os.sched_getaffinity(0)), metavar='N',
                       help='processes on this machine (default: one for each core)')
    again.add_argument('--scheduler', default='', metavar='ADDRESS',
                       help='of a Dask cluster whose workers do it, such as tcp://10.0.0.5:8786')
    report = add('report', _report, 'Write an HTML page with pictures, figures and faults.',
                 'SESSION --out report.html')
    report.add_argument('--out', type=Path, required=True, metavar='FILE')
    report.add_argument('--pictures', type=_count, default=60, metavar='N',
                        help='stacks shown with pictures, evenly chosen (default: 60)')
    return parser


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    options = _parser().parse_args(argv)
    console = _PlainConsole(highlight=False, markup=False)
    try:
        report = options.run(options, console)
        if options.json:
            options.json.write_text(json.dumps(report, indent=2) + '\n')
    except PsError as error:
        sys.exit(f'ps_session: {_plain(error.message)}')
    except OSError as error:
        sys.exit(f'ps_session: {error.filename}: {error.strerror}')
    except KeyboardInterrupt:
        sys.exit(130)
    if report.get('failed'):
        sys.exit(f'ps_session: {len(report["failed"])} stacks failed')


def _damage(problems: Sequence[str], console: Console) -> None:
    for problem in problems:
        console.print(f'damage: {problem}', style='yellow')


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError('must be positive')
    return value


def _count(text: str) -> int:
    value = int(text)
    if not 1 <= value <= 1024:
        raise argparse.ArgumentTypeError('must be from 1 to 1024')
    return value


def _info(options: argparse.Namespace, console: Console) -> Report:
    info = Session(options.session).info()
    table = Table('topic', 'type', 'messages', box=None, pad_edge=False)
    for name, count in info.counts.items():
        table.add_row(_plain(name), _plain(info.types[name]), str(count))
    about = info.scan.metadata.get('session', {})
    for name, value in about.items():
        console.print(f'{name:12} {value}')
    start = datetime.fromtimestamp(info.start * 1e-9).astimezone()
    console.print(f'start        {start.isoformat(timespec="milliseconds")}')
    console.print(f'duration     {(info.end - info.start) * 1e-9:.3f} s')
    console.print(f'size         {info.size_bytes / 1e6:.1f} MB, {info.scan.compression}')
    console.print(table)
    _damage(info.scan.problems, console)
    if not info.complete:
        console.print('unfinished: "ps_session recover" makes it complete', style='yellow')
    return {
        'file': str(info.path), 'complete': info.complete, 'size_bytes': info.size_bytes,
        'start_ns': info.start, 'end_ns': info.end, 'messages': info.counts,
        'stacks': info.stacks,
        'metadata': info.scan.metadata, 'problems': info.scan.problems}


def _recover(options: argparse.Namespace, console: Console) -> Report:
    result = recover(Session(options.session))
    _damage(result.problems, console)
    console.print(f'{"recovered" if result.changed else "nothing to do"}: {result.messages} '
                  f'messages, {result.stacks} stacks, {result.lost_bytes} bytes given up')
    return asdict(result)


def _play(options: argparse.Namespace, console: Console) -> Report:
    # rclpy takes a second to import, which info and recover need not wait for
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from ps_inspection.session_player import Player, PlayOptions

    paused = False

    def is_paused() -> bool:
        nonlocal paused
        if sys.stdin.isatty() and select.select([sys.stdin], [], [], 0)[0]:
            sys.stdin.readline()
            paused = not paused
            console.print('paused, Enter goes on' if paused else 'playing')
        return paused

    session = Session(options.session)
    # Ctrl-C must end the sleep between two messages, not only the context; and so must SIGTERM:
    # who dies in the graph leaves a dead listener in shared memory that disturbs those who live
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('ps_session_player')
    try:
        player = Player(
            node, session,
            PlayOptions(options.rate, options.start, options.loop, options.all,
                        options.namespace),
            is_paused,
            lambda message: console.print(f'{message.log_time * 1e-9:.3f} {message.topic.name}'),
        )
        sent = player.play()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    _damage(player.problems, console)
    console.print(f'{sent} messages played')
    return {'messages': sent}


def _export(options: argparse.Namespace, console: Console) -> Report:
    from ps_inspection.session_export import export_session
    return _said(asdict(export_session(Session(options.session), options.out,
                                 console.print)),
                 options.out, console)


def _reconstruct(options: argparse.Namespace, console: Console) -> Report:
    from ps_inspection.session_reconstruct import Workers, reconstruct_session
    outcome = reconstruct_session(
        Session(options.session), options.out, options.method,
        Workers(options.workers, options.scheduler), console.print)
    return _said(asdict(outcome), options.out, console)


def _report(options: argparse.Namespace, console: Console) -> Report:
    from ps_inspection.session_report import write_report
    outcome = write_report(Session(options.session), options.out, options.pictures,
                           console.print)
    _damage(outcome.problems, console)
    console.print(f'{options.out}: {outcome.stacks} stacks, {outcome.pictures} with pictures, '
                  f'{outcome.faults} faults')
    return asdict(outcome)


def _said(report: Report, out: Path, console: Console) -> Report:
    _damage(report['problems'], console)
    console.print(f'{out}: {report["done"]} stacks written, {report["skipped"]} were there, '
                  f'{len(report["failed"])} failed')
    return report


if __name__ == '__main__':
    main()
