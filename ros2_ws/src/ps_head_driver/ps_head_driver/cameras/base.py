"""What the trigger sequence asks of a camera, whatever its make."""
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType

from numpy.typing import NDArray

from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.stack import Mode, Panel, Stack

#: Which panels light one frame. Only a camera that plays pictures needs to know.
Light = tuple[Mode, Panel]


@dataclass(frozen=True)
class Frame:
    """One triggered picture and what the camera says about it.

    :param image: (H, W) or (H, W, 3), uint8 or uint16, linear, RGB order; nobody writes to it.
    :param frame_counter: the camera's own count, one more for each frame that it exposed.
    :param trigger_counter: count of triggers since the board's power-up; None if not reported.
    :param device_time_ns: start of exposure on the camera's clock; None if not reported.
    :param host_time_ns: start of exposure on this host's clock (Unix time), as far as known.
    :param exposure_time: s.
    :param gain: dB.
    """

    image: NDArray
    frame_counter: int
    trigger_counter: int | None
    device_time_ns: int | None
    host_time_ns: int
    exposure_time: float
    gain: float


class Camera(ABC):
    """A camera that takes one picture for each trigger.

    The trigger is a pulse from the board, or :meth:`trigger` where the host steps the sequence.
    Use: open, then for each strobe program arm, collect; close. One thread does this;
    :meth:`cancel` may come from another.
    """

    @abstractmethod
    def open(self) -> None:
        """Connect.

        :raises PsError: SEQUENCER_CAMERA_LOST, or SEQUENCER_BAD_REQUEST for wrong settings.
        """

    @abstractmethod
    def close(self) -> None:
        """Disconnect; does no harm when not open. A waiting collect returns."""

    @property
    @abstractmethod
    def camera_geometry(self) -> CameraGeometry | None:
        """Intrinsics for the frames as they come; None if the camera does not know them."""

    @property
    def source_stack(self) -> Stack | None:
        """The stack whose pictures are played, with the light geometry that belongs to them.

        None for a camera that looks at this head.
        """
        return None

    @abstractmethod
    def arm(self, exposures: Sequence[float], panels: Sequence[Light] | None = None,
            gain: float = 0.0, software_trigger: bool = False) -> None:
        """Forget old frames and get ready for one triggered frame per exposure time.

        :param exposures: s, in the order of the triggers.
        :param panels: what lights each frame, same length; only the folder camera looks at it.
        :param gain: dB.
        :param software_trigger: wait for :meth:`trigger` and not for the board's pulses.
        :raises PsError: SEQUENCER_CAMERA_LOST, or SEQUENCER_BAD_REQUEST.
        """

    @abstractmethod
    def trigger(self) -> None:
        """Take a picture now; the camera is armed with ``software_trigger``.

        :raises PsError: SEQUENCER_CAMERA_LOST.
        """

    @abstractmethod
    def collect(self, count: int, timeout: float) -> list[Frame]:
        """Wait for frames of the armed sequence.

        :param count: frames wanted.
        :param timeout: s.
        :returns: what came since arming, in the order of arrival; fewer than count after the
            timeout or after :meth:`cancel`.
        :raises PsError: SEQUENCER_CAMERA_LOST or SEQUENCER_BAD_IMAGE.
        """

    @abstractmethod
    def disarm(self) -> None:
        """Ignore triggers until armed again; does no harm when not armed."""

    @abstractmethod
    def cancel(self) -> None:
        """Make a waiting collect return with what came so far; holds until armed again."""

    def __enter__(self) -> 'Camera':
        self.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()
