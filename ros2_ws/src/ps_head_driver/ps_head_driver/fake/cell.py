"""A fake head and camera with the acquisition on top, without ROS: what tests of recipes need."""
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
import threading
import time
from typing import Any

from ps_head_driver import convergence_radius, strobe_program
from ps_head_driver.acquisition import Acquirer, Acquisition, Settings
from ps_head_driver.cameras.base import Camera
from ps_head_driver.cameras.fake import FakeCamera
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.bench import fake_head
from ps_head_driver.fake.renderer import Sensor
from ps_head_driver.fake.trigger_socket import ControlClient
from ps_head_driver.head_client import HeadClient, Motion
from ps_head_driver.head_model import HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at
from ps_head_driver.recipes import Recipe
from ps_head_driver.serial_link import SerialLink
from ps_head_driver.stack import Light, Plane, Stack, with_exposure_scale
from ps_head_driver.strobe_program import StrobeStep

MOTION = Motion(settle_s=0.0)


class ClientHead:
    """See acquisition.Head; over the head's client, as head_driver does it."""

    def __init__(self, client: HeadClient, head: HeadModel) -> None:
        self._client, self._head = client, head

    def set_convergence_radius(self, radius: float) -> None:
        """Move to a CR, m."""
        self._client.move_to(
            convergence_radius.inverse(self._head, radius).motor_counts, MOTION)

    def run(self, steps: Sequence[StrobeStep]) -> list[Light]:
        """Run a program."""
        state = self._client.state()
        result = self._client.run_program(strobe_program.encode_steps(steps))
        if result.error is not None:
            raise PsError(ErrorCode.SEQUENCER_HEAD_FAILED, result.error.message)
        panels = lights_at(self._head, state.motor_counts, state.df_tilt)
        return [strobe_program.light_of(step, record, panels)
                for step, record in zip(steps, result.records, strict=True)]

    def start(self, step: StrobeStep) -> 'RunningStep':
        """Run a program of one step in a thread."""
        return RunningStep(self, step)

    def stop(self) -> None:
        """Panels off, motor stopped."""
        self._client.stop()


class RunningStep:
    """See acquisition.RunningProgram."""

    def __init__(self, head: ClientHead, step: StrobeStep) -> None:
        #: host time
        self.lit_until_ns = time.time_ns() + round((step.settle + step.strobe_duration) * 1e9)
        self._answers: list[Any] = []
        self._thread = threading.Thread(target=self._run, args=(head, step))
        self._thread.start()
        time.sleep(0.05)      # the real one hears of it from head_status

    def _run(self, head: ClientHead, step: StrobeStep) -> None:
        try:
            self._answers += head.run([step])
        except PsError as error:
            self._answers.append(error)

    def finish(self) -> Light:
        """Wait for its end."""
        self._thread.join()
        answer, = self._answers
        if isinstance(answer, PsError):
            raise answer
        return answer


@dataclass
class FakeCell:
    """Emulated head and fake camera over one scene.

    :param settings: may be replaced between captures.
    """

    head: HeadModel
    camera: FakeCamera
    control: ControlClient
    client: HeadClient
    settings: Settings

    def acquire(self, recipe: dict[str, Any], camera: Camera | None = None) -> Acquisition:
        """Take a recipe."""
        acquirer = Acquirer(camera or self.camera, ClientHead(self.client, self.head),
                            lambda: self.settings)
        return acquirer.acquire(Recipe.model_validate(recipe))

    def stack(self, recipe: dict[str, Any]) -> Stack:
        """Take a recipe as the stack that camera_sequencer would publish."""
        taken = self.acquire(recipe)
        return Stack([frame.image for frame in taken.frames], with_exposure_scale(taken.lights),
                     camera=self.camera.camera_geometry, plane=Plane(),
                     ambient=taken.ambient.image if taken.ambient else None)


@contextmanager
def fake_cell(folder: Path, scene: str, scale: float, sensor: Sensor | None = None,
              ) -> Iterator[FakeCell]:
    """A homed cell at CR 60 mm."""
    head = load_head(nominal_head_path())
    with fake_head(folder) as (ports, control):
        client = HeadClient([SerialLink(ports[0])], BrightFieldKinematics(head).limits_counts)
        camera = FakeCamera(head, scene, folder / 'trigger.sock', scale=scale, sensor=sensor)
        try:
            client.connect(MOTION)
            client.home()
            client.move_to(convergence_radius.inverse(head, 0.06).motor_counts, MOTION)
            with camera:
                yield FakeCell(head, camera, control, client, Settings())
        finally:
            client.disconnect()
