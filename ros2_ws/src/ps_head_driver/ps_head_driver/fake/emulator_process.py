"""The fake head as a process: the firmware emulator behind a real pseudo-terminal.

Prints one line when it is ready. Ends with SIGINT or SIGTERM, or a moment after its standard input
is closed, which is how it notices that the driver that started it has died: a real board goes on
then too, and its watchdog switches the light off.
"""
import argparse
from collections.abc import Callable
import contextlib
from dataclasses import asdict, dataclass
import errno
import os
from pathlib import Path
import select
import signal
import socket
import sys
import termios
import time
import tty
from typing import Any

from ps_head_driver.errors import PsError
from ps_head_driver.fake.emulator import Board
from ps_head_driver.fake.link_faults import FaultyLine
from ps_head_driver.fake.motor import Motor
from ps_head_driver.fake.trigger_socket import TriggerServer, default_path
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics
from ps_head_driver.protocol import PANELS, Capability, StatusFlag

LONGEST_SLEEP_S = 0.25
ORPHAN_LIFE_S = 1.0
MOTOR, LIGHTS = Capability.MOTOR, Capability.LIGHTS


class Pty:
    """Pseudo-terminal whose slave end is the fake serial port.

    :param link: symbolic link to the slave, so that the port keeps its name when plugged again.
    """

    def __init__(self, link: Path) -> None:
        self.link = link
        self.master = -1
        self._slave = -1

    @property
    def plugged(self) -> bool:
        """Whether the port is there."""
        return self.master >= 0

    def plug(self) -> None:
        """Make the port appear."""
        if self.plugged:
            return
        # the slave stays open here, or reading the master fails while no host has it open
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave, termios.TCSANOW)
        os.set_blocking(self.master, False)
        with contextlib.suppress(FileNotFoundError):
            self.link.unlink()
        self.link.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Make the port disappear; a host that has it open gets an error."""
        if not self.plugged:
            return
        with contextlib.suppress(FileNotFoundError):
            self.link.unlink()
        os.close(self.master)
        os.close(self._slave)
        self.master = self._slave = -1

    def read(self) -> bytes:
        """What the host has sent since."""
        try:
            return os.read(self.master, 4096) if self.plugged else b''
        except BlockingIOError:
            return b''
        except OSError as error:
            if error.errno == errno.EIO:
                return b''
            raise

    def write(self, data: bytes) -> None:
        """Send to the host; lost if nobody reads, as on a wire."""
        if data and self.plugged:
            with contextlib.suppress(BlockingIOError, OSError):
                os.write(self.master, data)


@dataclass
class Channel:
    """One board with its line and its port."""

    board: Board
    line: FaultyLine
    pty: Pty

    def serve(self, now_ns: int) -> None:
        """Let time pass and bytes flow."""
        data = self.line.to_board(self.pty.read())
        self.line.from_board(self.board.receive(data, now_ns), now_ns)
        self.pty.write(self.line.due(now_ns))


class FakeHead:
    """Boards, trigger socket, and the commands that inject faults.

    :param port: of the board with the motor, and the lights if there is no other.
    :param lights_port: of a second board with the lights; None for a single board.
    """

    def __init__(self, head: HeadModel, head_file: str, port: Path, trigger: Path,
                 serial: str = 'FAKE-0001', lights_port: Path | None = None) -> None:
        self._kinematics = BrightFieldKinematics(head)
        self.motor = Motor(backlash=head.backlash_counts)
        self.server = TriggerServer(trigger, {'head_file': head_file, 'serial': serial})
        wanted = [(port, MOTOR | LIGHTS)] if lights_port is None else [
            (port, MOTOR), (lights_port, LIGHTS)]
        self.channels = [
            Channel(Board(self.motor, self._tilt, self.server.strobe, serial, capabilities),
                    FaultyLine(), Pty(path))
            for path, capabilities in wanted]
        self.lights = self.channels[-1].board.lights
        self._commands: dict[str, Callable[..., dict[str, Any]]] = {
            'state': self._state, 'line': self._line, 'unplug': self._unplug,
            'plug': self._plug, 'reset': self._reset, 'stall': self._stall,
            'led_open': self._led_open, 'heat': self._heat, 'load': self._load}
        self._plug_at_ns: int | None = None

    def _tilt(self, counts: float) -> float:
        low, high = self._kinematics.limits_counts      # the overshoot of a move goes beyond
        return float(self._kinematics.tilt(min(max(counts, low), high)))

    # ------------------------------------------------------------------ loop

    def run(self, ended: Callable[[], bool], wake: list[Any]) -> None:
        """Serve until ended() says so.

        :param wake: further file descriptors that wake up the loop.
        """
        self.plug()
        while not ended():
            now_ns = time.monotonic_ns()
            if self._plug_at_ns is not None and now_ns >= self._plug_at_ns:
                self.plug()
            for channel in self.channels:
                channel.serve(now_ns)
            for client, message in self.server.service():
                self.server.reply(client, self._control(message))
            self._sleep(wake)

    def plug(self) -> None:
        """Make the ports appear."""
        self._plug_at_ns = None
        for channel in self.channels:
            channel.pty.plug()

    def _sleep(self, wake: list[Any]) -> None:
        times = [self._plug_at_ns]
        for channel in self.channels:
            times += [channel.board.next_event_ns(), channel.line.next_event_ns()]
        now_ns = time.monotonic_ns()
        wait_s = min([LONGEST_SLEEP_S, *(
            max(t - now_ns, 0) * 1e-9 for t in times if t is not None)])
        ports = [channel.pty.master for channel in self.channels if channel.pty.plugged]
        select.select([*self.server.sockets(), *wake, *ports], [], [], wait_s)

    def close(self) -> None:
        """Remove ports and socket."""
        for channel in self.channels:
            channel.pty.unplug()
        self.server.close()

    # ------------------------------------------------------------------ commands for tests

    def _control(self, message: dict[str, Any]) -> dict[str, Any]:
        name, arguments = message.get('command'), message.get('arguments', {})
        if name not in self._commands:
            return {'error': f'{name!r} is not one of {", ".join(sorted(self._commands))}'}
        try:
            return self._commands[name](**arguments)
        except (TypeError, ValueError) as error:
            return {'error': f'{name}: {error}'}

    def _state(self) -> dict[str, Any]:
        """The truth about motor and panels."""
        motor, lights = (channel.board.status() for channel in (
            self.channels[0], self.channels[-1]))
        return {
            'activity': (motor if motor.activity else lights).activity.name,
            'homed': StatusFlag.HOMED in motor.flags, 'faults': int(motor.faults | lights.faults),
            'panels_on': StatusFlag.PANELS_ON in lights.flags,
            'motor_counts': motor.motor_counts, 'slider_counts': self.motor.slider,
            'strobe_counter': lights.strobe_counter, 'boot': self.channels[-1].board.boot,
            'plugged': self.channels[0].pty.plugged,
            'line': asdict(self.channels[0].line.rates)}

    def _line(self, **rates: float) -> dict[str, Any]:
        """Make the serial line bad; see FaultRates."""
        for channel in self.channels:
            channel.line.rates = channel.line.rates.changed(**rates)
        return {}

    def _unplug(self, for_s: float = 0.0, power: bool = True) -> dict[str, Any]:
        """Pull the cable; for_s > 0 plugs it again after that time. power: it also powers it."""
        for channel in self.channels:
            channel.pty.unplug()
            channel.line.clear()
        if power:
            self._reset()
        self._plug_at_ns = time.monotonic_ns() + round(for_s * 1e9) if for_s > 0 else None
        return {}

    def _plug(self) -> dict[str, Any]:
        self.plug()
        return {}

    def _reset(self) -> dict[str, Any]:
        """Restart the boards, as after a brown-out."""
        for channel in self.channels:
            channel.board.reset(time.monotonic_ns())
        return {}

    def _stall(self, on: bool = True) -> dict[str, Any]:
        """Block the motor."""
        self.motor.stalled = on
        return {}

    def _led_open(self, panels: int) -> dict[str, Any]:
        """Break LEDs; a bit mask as in the protocol."""
        self.lights.open_panels = int(panels) & 0xFF
        return {}

    def _heat(self, panel: int, kelvin: float) -> dict[str, Any]:
        """Add to the temperature of one panel."""
        if not 0 <= panel < PANELS:
            raise ValueError(f'panel {panel}')
        self.lights.extra_heat[panel] = float(kelvin)
        return {}

    def _load(self, counts: float) -> dict[str, Any]:
        """Make the slider lag behind the motor."""
        self.motor.load_counts = float(counts)
        return {}


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='ps_head_emulator', description='Fake head: firmware emulator on a pseudo-terminal.',
        epilog='example: ps_head_emulator --port /tmp/ps_head, then run head_driver with '
               'port:=/tmp/ps_head')
    parser.add_argument('--port', type=Path, required=True, help='name of the fake serial port')
    parser.add_argument('--lights-port', type=Path, default=None,
                        help='second board: the lights are on it, the motor on the first')
    parser.add_argument('--trigger-socket', type=Path, default=None,
                        help='where strobes are announced to the fake camera')
    parser.add_argument('--head', default='', help='true geometry (YAML); default: the nominal')
    parser.add_argument('--serial', default='FAKE-0001', help='serial number of the head')
    parser.add_argument('--die-with-stdin', action='store_true',
                        help='end when standard input is closed')
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the fake head."""
    options = _parse(arguments)
    wake_read, wake_write = socket.socketpair()
    wake_write.setblocking(False)
    signal.set_wakeup_fd(wake_write.fileno())
    stop_at: list[float] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop_at.append(0.0))
    try:
        head_file = options.head or str(nominal_head_path())
        fake = FakeHead(load_head(head_file), head_file, options.port.absolute(),
                        options.trigger_socket or default_path(), options.serial,
                        options.lights_port)
    except (PsError, OSError) as error:
        print(f'ps_head_emulator: {error}', file=sys.stderr)
        return 1
    wake: list[Any] = [wake_read]
    if options.die_with_stdin:
        wake.append(sys.stdin)

    def ended() -> bool:
        if sys.stdin in wake and select.select([sys.stdin], [], [], 0)[0] and not os.read(0, 64):
            wake.remove(sys.stdin)
            stop_at.append(time.monotonic() + ORPHAN_LIFE_S)
        return bool(stop_at) and time.monotonic() >= min(stop_at)

    try:
        fake.plug()
        print(f'ready: {options.port}', flush=True)
        fake.run(ended, wake)
    finally:
        fake.close()
    return 0


if __name__ == '__main__':
    sys.exit(main())
