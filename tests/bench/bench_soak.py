"""Soak: captures with random faults against the emulated board, faster than real time.

The driver's own client, board, line and matching of frames; only the clock is virtual and a camera
is simulated whose pictures say which light they were taken under.
"""
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
import os
import random
import sys
import time
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
from rich.console import Console
from rich.table import Table

from ps_head_driver import head_client, sequence
from ps_head_driver.cameras.base import Frame
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.emulator import Board
from ps_head_driver.fake.link_faults import FaultRates, FaultyLine
from ps_head_driver.fake.motor import Motor
from ps_head_driver.fake.trigger_socket import StrobeEvent
from ps_head_driver.head_client import HeadClient, Motion
from ps_head_driver.protocol import BoardInfo, Command, FrameDecoder, Packet, encode
from ps_head_driver.serial_link import SerialLink
from ps_head_driver.stack import Light, Mode, Panel
from ps_head_driver.strobe_program import StrobeStep, encode_steps, light_of

CAPTURES = int(os.environ.get('PS_BENCH_CAPTURES', '10000'))
MS = 1_000_000
LIMITS = (0, 64000)
MOTION = Motion()
RECOVERY_S = 2.0
FAULT_SHARE = 0.3
TOLERANCE_S = 1e-3           # of the times between frames
PANELS = [Light()] * 8      # where the panels are does not matter here

LINE_FAULTS: dict[str, dict[str, float]] = {
    'line: replies lost': {'drop': 0.2}, 'line: bytes damaged': {'corrupt': 1e-3},
    'line: replies doubled': {'duplicate': 0.5},
    'line: replies late': {'delay_s': 0.15, 'delayed': 0.3}, 'line: dead for a while': {'drop': 1}}
FRAME_FAULTS = ('frame lost', 'frame doubled', 'frame late', 'frame of another program')
BOARD_FAULTS = ('board reset', 'stall', 'LED open', 'over-temperature')


class World:
    """Time, board, line and camera."""

    def __init__(self, seed: int) -> None:
        self.now_ns = 1_000_000_000
        self.chance = random.Random(seed)
        self.line = FaultyLine(seed)
        self.motor = Motor(backlash=120.0)
        self.board = Board(self.motor, lambda m: m * 1e-5, self._strobe)
        self.frames: list[Frame] = []
        self.frame_fault = ''
        self.next_frame_fault = ''           # of the program after this one
        self._late: list[Frame] = []
        self._reports_triggers = True
        self._exposed = 0
        self._scheduled: tuple[int, Callable[[], None]] | None = None

    def seconds(self) -> float:
        """Now, s."""
        return self.now_ns * 1e-9

    def sleep(self, seconds: float) -> None:
        """Let time pass for everything."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            self.now_ns = min(self.now_ns + MS, end_ns)
            if self._scheduled is not None and self._scheduled[0] <= self.now_ns:
                action, self._scheduled = self._scheduled[1], None
                action()
            self.board.advance(self.now_ns)

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something when that time has passed."""
        self._scheduled = self.now_ns + round(seconds * 1e9), action

    def collect(self) -> list[Frame]:
        """Frames that have arrived."""
        frames, self.frames = self.frames, []
        return frames

    def new_program(self) -> None:
        """Forget the frames that have arrived; a late one arrives after this."""
        self.frames = self._late
        self._late = []
        self._reports_triggers = self.chance.random() < 0.5        # not every camera does

    def _strobe(self, event: StrobeEvent) -> None:
        fault, first = self.frame_fault, self.chance.random() < 0.4
        if fault == 'frame lost' and first:
            self.frame_fault = ''
            return
        self._exposed += 1
        # the picture is the truth: which panels were on
        image = np.array([[*event.bf_levels, *event.df_levels]], np.float32)
        frame = Frame(image, self._exposed,
                      event.trigger_counter if self._reports_triggers else None,
                      event.device_time_ns + 12345, 0, event.strobe_s, 0.0)
        if fault == 'frame late' and first:
            self.frame_fault = ''
            self._late.append(frame)
            return
        self.frames.append(frame)
        if fault == 'frame doubled' and first:
            self.frame_fault = ''
            self.frames.append(frame)


class VirtualLink(SerialLink):
    """The driver's link with the wire and the clock of a World."""

    def __init__(self, world: World) -> None:
        super().__init__('virtual')
        self._world = world

    def connect(self) -> BoardInfo:
        if self.info is None:
            self._port = self
            try:
                self.info = self._hello()
            except PsError:
                self.close()
                raise
        return self.info

    def close(self) -> None:
        self._port, self.info = None, None

    def _exchange(self, command: Command, body: bytes, timeout: float, tries: int) -> bytes:
        if self._port is None:
            raise PsError(ErrorCode.HEAD_DISCONNECTED, 'not open')
        world, decoder = self._world, FrameDecoder()
        self._sequence = (self._sequence + 1) % 256
        self._awaited = Packet(command, self._sequence, self._session, body)
        self._reply = None
        wire = encode(self._awaited)
        for _ in range(tries):
            data = world.line.to_board(b'\0' + wire)
            world.line.from_board(world.board.receive(data, world.now_ns), world.now_ns)
            deadline_ns = world.now_ns + round(timeout * 1e9)
            while world.now_ns < deadline_ns:
                world.sleep(0.001)
                for packet in decoder.feed(world.line.due(world.now_ns)):
                    self._accept(packet)
                reply = self._reply
                if reply is not None:
                    return reply.body
        self._awaited = None
        raise PsError(ErrorCode.HEAD_LINK_TIMEOUT, f'no answer to {command.name}')


@dataclass
class Outcome:
    """What a soak has seen; outages in s of the emulated time, since the cause had ended."""

    captures: int = 0
    published: int = 0
    wrong: int = 0
    injected: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    longest_outage: float = 0.0
    emulated_s: float = 0.0


class Soak:
    """A cell that captures while things break."""

    def __init__(self, seed: int) -> None:
        self.world = World(seed)
        self.client = HeadClient([VirtualLink(self.world)], LIMITS)
        self.outcome = Outcome()

    def run(self, captures: int) -> Outcome:
        """Capture so many times."""
        start = self.world.seconds()
        clock = SimpleNamespace(monotonic=self.world.seconds, sleep=self.world.sleep)
        with patch.object(head_client, 'time', clock):
            self._recover()
            for _ in range(captures):
                self._one()
        self.outcome.emulated_s = self.world.seconds() - start
        return self.outcome

    def _one(self) -> None:
        fault = ''
        if self.world.chance.random() < FAULT_SHARE:
            fault = self.world.chance.choice((*LINE_FAULTS, *FRAME_FAULTS, *BOARD_FAULTS))
            self.outcome.injected[fault] += 1
            self._inject(fault)
        self.outcome.captures += 1
        try:
            self._capture(fault == 'stall')
            failed = False
        except PsError as error:
            self.outcome.refused[error.code.name] += 1
            failed = True
        self._end_of_cause()
        if failed:
            since = self.world.seconds()
            self._recover()
            self.outcome.longest_outage = max(
                self.outcome.longest_outage, self.world.seconds() - since)

    def _inject(self, fault: str) -> None:
        world = self.world
        if fault in LINE_FAULTS:
            world.line.rates = FaultRates().changed(**LINE_FAULTS[fault])
        elif fault in FRAME_FAULTS:
            world.frame_fault = fault
        if fault == 'frame of another program':      # a late one takes the place of a lost one
            world.frame_fault, world.next_frame_fault = 'frame late', 'frame lost'
        delay = world.chance.uniform(0.0, 0.15)
        if fault == 'board reset':
            world.after(delay, lambda: world.board.reset(world.now_ns))
        elif fault == 'stall':
            world.after(delay, lambda: setattr(world.motor, 'stalled', True))
        elif fault == 'LED open':
            world.board.lights.open_panels = 1 << world.chance.randrange(4)
        elif fault == 'over-temperature':
            world.after(delay, lambda: world.board.lights.extra_heat.__setitem__(2, 90.0))

    def _end_of_cause(self) -> None:
        world = self.world
        world.line.rates = FaultRates()
        world.motor.stalled = False
        world.board.lights.open_panels = 0
        world.board.lights.extra_heat[2] = 0.0
        world.frame_fault, world.next_frame_fault = world.next_frame_fault, ''
        world.after(0.0, lambda: None)

    def _capture(self, far: bool) -> None:
        world, chance = self.world, self.world.chance
        if far or chance.random() < 0.3:
            self.client.move_to(chance.randrange(*LIMITS), MOTION)
        steps = [StrobeStep(Mode.BRIGHT_FIELD, panel, 1.0, 0.002, 0.004, 0.0167)
                 for panel in chance.sample([Panel.E, Panel.N, Panel.W, Panel.S], 4)]
        world.new_program()
        result = self.client.run_program(encode_steps(steps))
        if result.error is not None:
            raise result.error
        lights = [light_of(step, record, PANELS)
                  for step, record in zip(steps, result.records, strict=True)]
        frames = sequence.match(world.collect(), lights, TOLERANCE_S)
        self.outcome.published += 1
        if any(np.flatnonzero(frame.image[0]).tolist() != [int(light.panel)]
               for frame, light in zip(frames, lights, strict=True)):
            self.outcome.wrong += 1

    def _recover(self) -> None:
        """What the head's supervisor does: connect, clear, home, as often as it takes."""
        client, give_up = self.client, self.world.seconds() + 60.0
        while True:
            try:
                if not client.connected:
                    client.connect(MOTION)
                if client.state().faults:
                    client.clear_fault()
                if not client.state().homed:
                    client.home()
                return
            except PsError as error:
                if self.world.seconds() > give_up:
                    raise
                if error.code is ErrorCode.HEAD_LINK_TIMEOUT:
                    client.disconnect()
                self.world.sleep(0.25)


def main() -> int:
    """Print the table; 1 if a wrong stack was published."""
    begin = time.perf_counter()
    outcome = Soak(seed=1).run(CAPTURES)
    table = Table('soak', 'count')
    table.add_row('captures', str(outcome.captures))
    table.add_row('stacks published', str(outcome.published))
    table.add_row('wrong stacks published', str(outcome.wrong))
    for name, count in sorted(outcome.injected.items()):
        table.add_row(f'injected: {name}', str(count))
    for name, count in sorted(outcome.refused.items()):
        table.add_row(f'refused with {name}', str(count))
    table.add_row('longest outage after its cause, s of the board',
                  f'{outcome.longest_outage:.2f}')
    table.add_row('emulated, s', f'{outcome.emulated_s:.0f}')
    table.add_row('took, s', f'{time.perf_counter() - begin:.0f}')
    Console().print(table)
    return int(outcome.wrong > 0)


if __name__ == '__main__':
    sys.exit(main())
