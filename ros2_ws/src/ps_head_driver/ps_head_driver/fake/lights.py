"""Model of the panels of the fake head and of the part of the firmware that strobes them.

Times are microseconds on the board's clock; panels are numbered bright field E N W S, dark field
E N W S.
"""
from collections.abc import Callable, Sequence
from enum import Enum, auto
import math

from ps_head_driver.protocol import (
    FULL_LEVEL,
    PANELS,
    TEMPERATURE_UNIT,
    TILT_UNIT,
    Step,
    StepRecord,
)

MAX_STEPS = 32
MAX_ON_US = 4_000_000             # of one step
MAX_PERIOD_US = 60_000_000
ON_BUDGET_US = 2_000_000          # at full level, refilled at DUTY
DUTY = 0.25
SERVO_RAD_PER_S = 4.0
MAX_TILT_UNITS = round(math.pi / TILT_UNIT)
AMBIENT_K = 296.0
HOT_K = 353.0
HEATING_K_PER_S = 8.0             # of a panel at full level
COOLING_S = 60.0                  # time constant


class Phase(Enum):
    """Part of a step."""

    WAIT = auto()                 # panels off, until it is time to switch them on
    SETTLE = auto()               # panels on, before the trigger
    STROBE = auto()               # panels on, after the trigger


class Lights:
    """Panels, dark-field servo and strobe program.

    :param on_strobe: called when a strobe has ended, also by an abort.
    :param counts: the motor counts of this moment, for the records.
    """

    def __init__(self, on_strobe: Callable[[StepRecord], None],
                 counts: Callable[[], int]) -> None:
        self._on_strobe, self._counts = on_strobe, counts
        self.open_panels = 0                       # fault knob: bit mask of broken LEDs
        self.extra_heat = [0.0] * PANELS           # fault knob, K
        self._rise = [0.0] * PANELS                # above AMBIENT_K
        self._used_us = [0.0] * PANELS             # of ON_BUDGET_US
        self.reset()

    def reset(self) -> None:
        """Power-up. Heat and used on-time stay: they are physics."""
        self.gains: tuple[int, ...] = (FULL_LEVEL,) * PANELS
        self.program: list[Step] = []
        self.records: list[StepRecord] = []
        self.strobe_counter = 0
        self.trigger_counter = 0
        self.running = False
        self.levels: tuple[int, ...] = (0,) * PANELS      # electrically on
        self._phase = Phase.WAIT
        self._index = 0
        self._next_us = 0
        self._trigger_us = 0
        self._updated_us = 0
        self._servo = (0, 1.3, 1.3)                       # set at, from, to

    # ------------------------------------------------------------------ servo and heat

    def set_tilt(self, units: int, now_us: int) -> None:
        """Send the dark-field servo to a tilt in TILT_UNIT."""
        self._servo = (now_us, self.tilt(now_us), units * TILT_UNIT)

    def tilt(self, now_us: int) -> float:
        """Dark-field tilt, rad."""
        since, start, end = self._servo
        reach = SERVO_RAD_PER_S * (now_us - since) * 1e-6
        return start + min(max(end - start, -reach), reach)

    def temperatures(self, now_us: int) -> tuple[int, ...]:
        """Of each panel, in TEMPERATURE_UNIT."""
        self._update(now_us)
        return tuple(round((AMBIENT_K + rise + extra) / TEMPERATURE_UNIT)
                     for rise, extra in zip(self._rise, self.extra_heat, strict=True))

    def hot_panels(self, now_us: int) -> int:
        """Bit mask of the panels that are too hot."""
        limit = HOT_K / TEMPERATURE_UNIT
        return sum(1 << i for i, t in enumerate(self.temperatures(now_us)) if t > limit)

    # ------------------------------------------------------------------ program

    def acceptable(self, steps: int, now_us: int) -> bool:
        """Whether the program is complete and stays within on-time and duty limits."""
        if steps != len(self.program) or not steps:
            return False
        self._update(now_us)
        used = list(self._used_us)
        for step in self.program:
            on_us = step.settle_us + step.strobe_us
            if step.period_us > MAX_PERIOD_US or not step.strobe_us:
                return False
            if step.panels and on_us > MAX_ON_US:
                return False
            level = self._levels_of(step)
            idle_us = max(step.period_us - on_us, 0)
            for i in range(PANELS):
                used[i] = max(used[i] + on_us * (level[i] / FULL_LEVEL - DUTY), 0.0)
                if used[i] > ON_BUDGET_US:
                    return False
                used[i] = max(used[i] - idle_us * DUTY, 0.0)
        return True

    def start(self, now_us: int) -> None:
        """Begin the program."""
        self.records = []
        self.running = True
        self._index = 0
        self._phase, self._next_us = Phase.WAIT, now_us

    def next_us(self) -> int | None:
        """When the next thing happens; None when not running."""
        return self._next_us if self.running else None

    def step(self) -> int:
        """Do what is due at next_us().

        :returns: bit mask of panels that draw no current; then the program has ended.
        """
        now_us, step = self._next_us, self.program[self._index]
        if self._phase is Phase.WAIT:
            self._switch(self._levels_of(step), now_us)
            if step.panels & self.open_panels:
                self.abort(now_us)
                return step.panels & self.open_panels
            self._phase, self._next_us = Phase.SETTLE, now_us + step.settle_us
        elif self._phase is Phase.SETTLE:
            self.strobe_counter += 1
            self.trigger_counter += step.trigger
            self._trigger_us = now_us
            self._phase, self._next_us = Phase.STROBE, now_us + step.strobe_us
        else:
            self._end_strobe(now_us)
            self._index += 1
            if self._index == len(self.program):
                self.running = False
            else:
                settle_us = self.program[self._index].settle_us
                self._phase = Phase.WAIT
                self._next_us = max(now_us, self._trigger_us + step.period_us - settle_us)
        return 0

    def abort(self, now_us: int) -> None:
        """Panels off, program ended. A strobe cut short is announced but is not a step done."""
        if self.running and self._phase is Phase.STROBE:
            self._end_strobe(now_us)
            self.records.pop()
        self._switch((0,) * PANELS, now_us)
        self.running = False

    def _end_strobe(self, now_us: int) -> None:
        record = StepRecord(
            self._index, self.strobe_counter, self.trigger_counter, self._trigger_us,
            now_us - self._trigger_us, self._counts(), self.levels)
        self._switch((0,) * PANELS, now_us)
        self.records.append(record)
        self._on_strobe(record)

    def _levels_of(self, step: Step) -> tuple[int, ...]:
        return tuple(
            step.level * gain // FULL_LEVEL if step.panels >> i & 1 else 0
            for i, gain in enumerate(self.gains))

    def _switch(self, levels: Sequence[int], now_us: int) -> None:
        self._update(now_us)
        self.levels = tuple(levels)

    def _update(self, now_us: int) -> None:
        """Bring heat and used on-time up to now."""
        duration_us, self._updated_us = now_us - self._updated_us, now_us
        decay = math.exp(-duration_us * 1e-6 / COOLING_S)
        for i, level in enumerate(self.levels):
            relative = level / FULL_LEVEL
            steady = HEATING_K_PER_S * COOLING_S * relative
            self._rise[i] = steady + (self._rise[i] - steady) * decay
            self._used_us[i] = max(self._used_us[i] + duration_us * (relative - DUTY), 0.0)
