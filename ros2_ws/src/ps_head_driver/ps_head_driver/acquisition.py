"""One capture: programs for the board, frames from the camera, matched, checked and merged.

Two ways. Hardware-sequenced: the board runs a whole program and triggers the camera, the host
collects. Host-stepped, where no trigger cable leads to the camera: for each light the board
switches the panel on, the host triggers the camera, and the frame must have ended before the light
did.
"""
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
import math
import time
from typing import Protocol

from ps_head_driver import bracketing, frame_motion, sequence
from ps_head_driver.cameras.base import Camera, Frame
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.recipes import Recipe
from ps_head_driver.sequence import Program, Shot
from ps_head_driver.stack import Light, Panel, exposure
from ps_head_driver.strobe_program import StrobeStep


class Stage(IntEnum):
    """Where an acquisition is; values of AcquireStack's feedback."""

    MOVING = 0
    ARMING = 1
    EXPOSING = 2
    COLLECTING = 3
    PUBLISHED = 4


# stage, frames taken, whether the last exposure has ended
Progress = Callable[[Stage, int, bool], None]


@dataclass(frozen=True)
class Settings:
    """How captures are made; times in s.

    :param hardware: the board triggers the camera; False: the host does.
    :param exposure: of steps that state none.
    :param gain: of steps that state none, dB.
    :param settle: panels on before a trigger.
    :param frame_period: shortest time between two triggers.
    :param frame_timeout: longest wait for the frames of a finished program.
    :param time_tolerance: of the times between frames and between strobes.
    :param host_margin: a light that the host steps stays on this much longer than the exposure.
    :param max_motion: largest shift between two frames, px; 0: it is not measured.
    :param max_motor_motion: largest movement of the panels within a program, counts.
    """

    hardware: bool = True
    exposure: float = 0.004
    gain: float = 0.0
    settle: float = 0.002
    frame_period: float = 1 / 60
    frame_timeout: float = 5.0
    time_tolerance: float = 0.002
    host_margin: float = 0.2
    max_motion: float = 3.0
    max_motor_motion: int = 4


class RunningProgram(Protocol):
    """A program of one step whose light is on."""

    @property
    def lit_until_ns(self) -> int:
        """The light stays on at least until then, host time."""

    def finish(self) -> Light:
        """Wait for its end; the light as it really was.

        :raises PsError: SEQUENCER_HEAD_FAILED or _HEAD_UNAVAILABLE.
        """


class Head(Protocol):
    """What an acquisition wants of the head; all raise SEQUENCER_HEAD_FAILED or _UNAVAILABLE."""

    def set_convergence_radius(self, radius: float) -> None:
        """Move the bright-field panels to a CR, m."""

    def run(self, steps: Sequence[StrobeStep]) -> list[Light]:
        """Run a program; the lights as they really were."""

    def start(self, step: StrobeStep) -> RunningProgram:
        """Run a program of one step; returns when its light is on."""

    def stop(self) -> None:
        """Panels off and motor stopped; does not wait."""


@dataclass(frozen=True)
class Acquisition:
    """What one recipe has yielded: frames and lights in its order, matched.

    :param duration: first strobe to end of last exposure of each program, summed, s.
    :param stamp_ns: middle between start of the first and end of the last exposure, host time.
    :param motion_px: largest shift between frames; NaN where they show too little to tell.
    """

    frames: list[Frame]
    lights: list[Light]
    ambient: Frame | None
    duration: float
    stamp_ns: int
    motion_px: float


class Acquirer:
    """Takes the frames of recipes.

    :param settings: asked for at the start of each acquisition.
    :param cancelled: whether to give up.
    """

    def __init__(self, camera: Camera, head: Head, settings: Callable[[], Settings],
                 cancelled: Callable[[], bool] = lambda: False) -> None:
        self._camera, self._head = camera, head
        self._read_settings, self._cancelled = settings, cancelled

    def acquire(self, recipe: Recipe, progress: Progress = lambda *_: None) -> Acquisition:
        """Take one recipe.

        :raises PsError: SEQUENCER_FRAME_MISSING, _FRAME_MISMATCH, _MOTION, _BAD_IMAGE,
            _CANCELLED, _HEAD_FAILED, _HEAD_UNAVAILABLE or _CAMERA_LOST.
        """
        try:
            return self._acquire(recipe, progress)
        except PsError:
            self.check_cancelled()      # that is why something failed
            raise

    def _acquire(self, recipe: Recipe, progress: Progress) -> Acquisition:
        settings = self._read_settings()
        take = self._by_board if settings.hardware else self._by_host
        programs = sequence.plan(recipe, settings.exposure, settings.gain)
        shots: list[Shot] = []
        frames: list[Frame] = []
        lights: list[Light] = []
        duration = 0.0
        for program in programs:
            if program.convergence_radius > 0:
                progress(Stage.MOVING, len(frames), False)
                self._head.set_convergence_radius(program.convergence_radius)
            self.check_cancelled()
            last = program is programs[-1]
            before = len(frames)

            def report(stage: Stage, taken: int, ended: bool = False) -> None:
                progress(stage, before + taken, ended and last)      # noqa: B023

            taken, lit = take(program, settings, report)
            _check_motor(lit, settings.max_motor_motion)
            duration += (lit[-1].device_time_ns - lit[0].device_time_ns) * 1e-9
            duration += taken[-1].exposure_time
            shots += program.shots
            frames += taken
            lights += [
                replace(light, exposure_time=frame.exposure_time, gain=frame.gain,
                        frame_counter=frame.frame_counter)
                for light, frame in zip(lit, taken, strict=True)]
        sequence.check_images(frames)
        motion_px = _check_motion(frames, lights, settings.max_motion)
        start_ns = min(frame.host_time_ns for frame in frames)
        end_ns = max(frame.host_time_ns + round(frame.exposure_time * 1e9) for frame in frames)
        frames, lights = _merged(shots, frames, lights)
        ambient = None
        if recipe.ambient:
            ambient, frames, lights = frames[-1], frames[:-1], lights[:-1]
        return Acquisition(frames, lights, ambient, duration, (start_ns + end_ns) // 2, motion_px)

    def check_cancelled(self) -> None:
        """Give up if that was asked for.

        :raises PsError: SEQUENCER_CANCELLED.
        """
        if self._cancelled():
            raise PsError(ErrorCode.SEQUENCER_CANCELLED, 'cancelled; no stack was published')

    # ------------------------------------------------------------------ the two ways

    def _by_board(self, program: Program, settings: Settings, report: Callable[..., None],
                  ) -> tuple[list[Frame], list[Light]]:
        """The board runs the program and triggers the camera."""
        count = len(program.shots)
        report(Stage.ARMING, 0)
        self._arm(program.shots, software_trigger=False)
        try:
            self.check_cancelled()
            report(Stage.EXPOSING, 0)
            lights = self._head.run([
                _strobe_step(shot, settings.settle, shot.exposure,
                             max(settings.frame_period, shot.exposure))
                for shot in program.shots])
            report(Stage.COLLECTING, 0, True)
            arrived = self._camera.collect(count, settings.frame_timeout)
            self.check_cancelled()
            return sequence.match(arrived, lights, settings.time_tolerance), lights
        finally:
            self._camera.disarm()

    def _by_host(self, program: Program, settings: Settings, report: Callable[..., None],
                 ) -> tuple[list[Frame], list[Light]]:
        """One shot after the other: light on, software trigger, frame, light off."""
        frames: list[Frame] = []
        lights: list[Light] = []
        for shot in program.shots:
            report(Stage.ARMING, len(frames))
            self._arm([shot], software_trigger=True)
            try:
                self.check_cancelled()
                report(Stage.EXPOSING, len(frames))
                frame, light = self._step_by_host(shot, settings)
            except PsError:
                self._head.stop()
                raise
            finally:
                self._camera.disarm()
            frames.append(frame)
            lights.append(light)
        report(Stage.COLLECTING, len(frames), True)
        return frames, lights

    def _step_by_host(self, shot: Shot, settings: Settings) -> tuple[Frame, Light]:
        running = self._head.start(_strobe_step(
            shot, settings.settle, shot.exposure + settings.host_margin, 0.0))
        time.sleep(settings.settle)
        self._camera.trigger()
        arrived = self._camera.collect(1, settings.frame_timeout)
        self.check_cancelled()
        light = running.finish()
        frame, = sequence.match(arrived, [light], settings.time_tolerance)
        late_ns = frame.host_time_ns + round(frame.exposure_time * 1e9) - running.lit_until_ns
        if late_ns > 0:
            raise PsError(ErrorCode.SEQUENCER_FRAME_MISMATCH,
                          f'frame {frame.frame_counter} may have ended {late_ns * 1e-6:.0f} ms '
                          f'after light {light.name}; raise parameter host_margin')
        return frame, light

    def _arm(self, shots: Sequence[Shot], software_trigger: bool) -> None:
        self._camera.arm([shot.exposure for shot in shots],
                         panels=[(shot.mode, shot.panel) for shot in shots], gain=shots[0].gain,
                         software_trigger=software_trigger)


def _strobe_step(shot: Shot, settle: float, strobe: float, period: float) -> StrobeStep:
    return StrobeStep(shot.mode, shot.panel, shot.intensity, settle, strobe, period)


def _check_motor(lights: Sequence[Light], most_counts: int) -> None:
    """Refuse a program during which the panels moved."""
    counts = [light.motor_counts for light in lights]
    if max(counts) - min(counts) > most_counts:
        raise PsError(ErrorCode.SEQUENCER_MOTION,
                      f'the panels moved by {max(counts) - min(counts)} counts during the '
                      f'sequence (allowed: {most_counts}); is the motor held, and settle_time '
                      'of head_driver long enough?')


def _check_motion(frames: Sequence[Frame], lights: Sequence[Light], most_px: float) -> float:
    """Largest shift between frames, px; NaN if not wanted, or if they show too little to tell."""
    lit = [i for i, light in enumerate(lights) if light.panel is not Panel.NONE]
    if len(lit) < 2 or not most_px:
        return math.nan
    motion = frame_motion.measure([frames[i].image for i in lit], [lights[i] for i in lit])
    if motion > most_px:
        raise PsError(ErrorCode.SEQUENCER_MOTION,
                      f'the picture moved by {motion:.1f} px during the sequence (allowed: '
                      f'{most_px:g}); wait until robot and part stand still, or raise max_motion')
    return motion


def _merged(shots: Sequence[Shot], frames: Sequence[Frame], lights: Sequence[Light],
            ) -> tuple[list[Frame], list[Light]]:
    """One frame for each light, in the order of the recipe."""
    groups: dict[int, list[int]] = {}
    for i, shot in enumerate(shots):
        groups.setdefault(shot.light, []).append(i)
    chosen_frames, chosen_lights = [], []
    for _, group in sorted(groups.items()):
        exposures = [exposure(lights[i]) for i in group]
        shortest = group[exposures.index(min(exposures))]
        frame = frames[shortest]
        if len(group) > 1:
            frame = replace(frame, image=bracketing.merge(
                [frames[i].image for i in group], exposures))
        chosen_frames.append(frame)
        chosen_lights.append(lights[shortest])
    return chosen_frames, chosen_lights
