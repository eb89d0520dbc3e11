"""Model of the linear motor of the fake head and of the slider that it pushes.

Positions are in counts. Three of them differ: what the controller wants, where the motor is (the
encoder), and where the slider is (backlash and load behind the motor).
"""
from enum import Enum, auto
import math

TICK_S = 1e-3
HOME_SWITCH = -1000.0            # closed below
HARD_LIMITS = (-1600.0, 66000.0)
MAX_SPEED = 120_000.0            # counts/s: 75 mm/s on the nominal head
ACCELERATION = 1_200_000.0       # counts/s^2
HOMING_SPEED = 80_000.0
HOMING_SLOW = 8_000.0
FOLLOWING_ERROR = 600.0          # counts between wanted and measured position that mean a stall


class Phase(Enum):
    """What the motor is doing."""

    IDLE = auto()
    MOVING = auto()
    HOMING_DOWN = auto()         # towards the switch
    HOMING_UP = auto()           # slowly off it: the edge is the reference
    HOMING_ZERO = auto()         # up to count 0
    STOPPING = auto()


class Motor:
    """Motor, encoder, home switch and slider.

    :param start: where the slider stands at power-up, in counts of the homed system.
    :param backlash: free play between motor and slider, counts. The slider stands where the
        encoder says after a motion up, and ``backlash`` above it after a motion down.
    """

    def __init__(self, start: float = 9000.0, backlash: float = 0.0) -> None:
        self.backlash = backlash
        self.load_counts = 0.0           # elastic lag of the slider under load
        self.stalled = False             # fault knob: the motor is blocked
        self.phase = Phase.IDLE
        self.homed = False
        self.speed = 0.0                 # of the motor, counts/s
        self._motor = start              # true position of the motor
        self._slider = start
        self._offset = start             # encoder 0 stands here
        self._wanted = start
        self._target = start
        self._limit = MAX_SPEED

    @property
    def counts(self) -> int:
        """Measured position, counts; relative to power-up until homed."""
        return round(self._motor - self._offset)

    @property
    def slider(self) -> float:
        """Where the slider really stands, in counts of the homed system."""
        return self._slider - self.load_counts

    @property
    def at_switch(self) -> bool:
        """Whether the home switch is closed."""
        return self._motor <= HOME_SWITCH

    @property
    def busy(self) -> bool:
        """Whether it moves or is about to."""
        return self.phase is not Phase.IDLE

    def home(self) -> None:
        """Start homing; ends at count 0, coming from below."""
        self.homed = False
        self._begin(Phase.HOMING_DOWN, -math.inf, HOMING_SPEED)

    def move(self, target: int, speed: float = 0.0) -> None:
        """Start moving to a count.

        :param speed: counts/s; 0 is the fastest.
        """
        self._begin(Phase.MOVING, target + self._offset, min(speed or MAX_SPEED, MAX_SPEED))

    def stop(self) -> None:
        """Slow down as fast as allowed."""
        if self.busy:
            self.phase = Phase.STOPPING

    def kill(self) -> None:
        """Power off: stands still at once and does not know where it is."""
        self.phase, self.speed, self.homed = Phase.IDLE, 0.0, False
        self._offset = self._motor

    def tick(self) -> str:
        """Advance by TICK_S.

        :returns: '' or why the motor has stopped by itself: 'done', 'stall', 'limit'.
        """
        if self.phase is Phase.IDLE:
            return ''
        self._advance_wanted()
        if not self.stalled:
            self._motor = min(max(self._wanted, HARD_LIMITS[0]), HARD_LIMITS[1])
        # the slider is pushed by either end of the play
        self._slider = min(max(self._slider, self._motor), self._motor + self.backlash)
        if abs(self._wanted - self._motor) > FOLLOWING_ERROR:
            self._halt()
            self.homed = False
            return 'stall'
        if self._motor in HARD_LIMITS:
            self._halt()
            return 'limit'
        return self._next_phase()

    def _begin(self, phase: Phase, target: float, limit: float) -> None:
        self.phase, self._target, self._limit = phase, target, limit
        self._wanted = self._motor

    def _advance_wanted(self) -> None:
        distance = self._target - self._wanted
        change = ACCELERATION * TICK_S
        goal = 0.0
        if self.phase is not Phase.STOPPING:
            # the speed from which steps that shrink by `change` end at the target
            braking = math.sqrt(change**2 / 4 + 2 * ACCELERATION * abs(distance)) - change / 2
            goal = math.copysign(min(self._limit, braking), distance)
        self.speed += min(max(goal - self.speed, -change), change)
        step = self.speed * TICK_S
        if self.phase is not Phase.STOPPING and abs(distance - step) < 0.5:
            self._wanted, self.speed = self._target, 0.0
        else:
            self._wanted += step

    def _next_phase(self) -> str:
        if self.phase is Phase.HOMING_DOWN and self.at_switch:
            self._begin(Phase.HOMING_UP, math.inf, HOMING_SLOW)
            self.speed = 0.0
        elif self.phase is Phase.HOMING_UP and not self.at_switch:
            self._offset = 0.0           # the edge of the switch is HOME_SWITCH by definition
            self._begin(Phase.HOMING_ZERO, 0.0, HOMING_SPEED)
        elif self.phase is Phase.STOPPING and self.speed == 0.0:
            self._halt()
            return 'stopped'
        elif self.phase in (Phase.MOVING, Phase.HOMING_ZERO) and (
                self.speed == 0.0 and self._wanted == self._target):
            self.homed = self.homed or self.phase is Phase.HOMING_ZERO
            self._halt()
            return 'done'
        return ''

    def _halt(self) -> None:
        self.phase, self.speed = Phase.IDLE, 0.0
