"""ps_cell: the whole cell as processes, where ROS launch does not exist."""
import argparse
from collections.abc import Sequence
import json
from pathlib import Path
import signal
import sys
import time
from typing import Any

from rich.console import Console

from ps_head_driver.errors import PsError
from ps_head_driver.graph import arguments_of
from ps_inspection.graph import NODES
from ps_inspection.runner import Cell, NodeProcess
from ps_interfaces.msg import HeadStatus

_STATES = {getattr(HeadStatus, name): name for name in (
    'DISCONNECTED', 'CONNECTED', 'HOMING', 'READY', 'MOVING', 'STROBING', 'FAULT')}


def _parser() -> argparse.ArgumentParser:
    lines = [f'  {argument.name}:={argument.default or "..."}\n      {argument.description}'
             for argument in arguments_of(NODES)]
    parser = argparse.ArgumentParser(
        prog='ps_cell', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Start the whole inspection cell and run it until Ctrl-C.',
        epilog='arguments, as of "ros2 launch ps_inspection inspection.launch.py":\n'
               + '\n'.join(lines)
               + '\n\nexample: ps_cell fake_hardware:=true camera:=fake scene:=dome')
    parser.add_argument('arguments', nargs='*', metavar='NAME:=VALUE')
    parser.add_argument('--log-folder', type=Path, metavar='DIR',
                        help='one log file a node (default: a new temporary folder)')
    parser.add_argument('--ready-timeout', type=float, default=60.0, metavar='S',
                        help='longest wait until all nodes are ready (default: %(default)s s)')
    parser.add_argument('--check', action='store_true',
                        help='stop again as soon as all nodes are ready')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write what happened as JSON')
    return parser


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = _parser()
    options = parser.parse_args(argv)
    values = {}
    for word in options.arguments:
        name, separator, value = word.partition(':=')
        if not separator:
            parser.error(f'{word!r} is not NAME:=VALUE')
        values[name] = value
    console = Console(highlight=False)

    def show(node: NodeProcess) -> None:
        console.print(f'[green]ready[/] {node.name:20} {node.ready_s:5.1f} s   '
                      f'pid {node.process.pid}')

    try:
        cell = Cell(values, log_folder=options.log_folder, ready_timeout=options.ready_timeout,
                    on_ready=show)
    except ValueError as error:
        parser.error(str(error))
    signal.signal(signal.SIGTERM, lambda *_: _interrupt())
    report: dict[str, Any] = {'nodes': [], 'head_state': None, 'killed': [], 'error': None}
    try:
        cell.start()
        _show(console, cell, report)
        while not options.check:
            time.sleep(0.2)
            cell.check()
    except KeyboardInterrupt:
        pass
    except (PsError, OSError) as error:
        report['error'] = str(error)
    finally:
        # a second Ctrl-C must not leave nodes behind
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        report['killed'] = cell.stop()
    if report['killed'] and report['error'] is None:
        report['error'] = f'did not stop in time and was killed: {", ".join(report["killed"])}'
    if options.json:
        options.json.write_text(json.dumps(report, indent=2) + '\n')
    if report['error']:
        print(f'ps_cell: {report["error"]}', file=sys.stderr)
        sys.exit(1)


def _interrupt() -> None:
    raise KeyboardInterrupt


def _show(console: Console, cell: Cell, report: dict[str, Any]) -> None:
    for node in cell.processes:
        report['nodes'].append({'name': node.name, 'pid': node.process.pid,
                                'ready_s': node.ready_s, 'log': str(node.log)})
    if cell.head_status is not None:
        report['head_state'] = _STATES[cell.head_status.state]
        kind = 'emulated head' if cell.head_status.fake else 'head'
        console.print(f'{kind}: {report["head_state"]} {cell.head_status.message}')
    console.print(f'logs: {cell.log_folder}', soft_wrap=True)
    console.print('Ctrl-C stops the cell')


if __name__ == '__main__':
    main()
