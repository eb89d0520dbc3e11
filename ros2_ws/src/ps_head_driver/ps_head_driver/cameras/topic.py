"""Topic camera: any ROS camera driver that is triggered by the board and stamps its frames."""
from collections.abc import Sequence
import threading
import time

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from ps_head_driver.cameras.base import Camera, Frame, Light
from ps_head_driver.conversions import message_to_camera, message_to_image, time_to_ns
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import CameraGeometry
from ps_head_driver.pixel_formats import use_all_bits
from ps_head_driver.ros_support import OVERRIDABLE


class TopicCamera(Camera):
    """Collects the pictures that a camera driver publishes while it is armed.

    The driver must run the camera with the exposure that the recipe states, and stamp every
    picture with the start of its exposure: the stamps are what frames are matched by. It runs the
    camera in hardware-trigger mode, or, where the host steps the sequence, freely: then the first
    picture is taken that was begun, by its stamp on this host's clock, after the trigger.
    A camera_info topic beside the image topic is used if there is one.

    :param node: subscribes on it.
    :param topic: of the pictures; camera_info is looked for beside it.
    :param standoff: camera centre above the origin of ps_head_plane, m.
    :param significant_bits: of 16-bit pictures whose driver fills in the lowest bits only: 12 for
        values up to 4095. They are shifted up, so that full scale is full scale.
    """

    def __init__(self, node: Node, topic: str, standoff: float,
                 significant_bits: int = 16) -> None:
        self._node, self._topic, self._standoff = node, topic, standoff
        self._bits = significant_bits
        self._arrived = threading.Condition()
        self._frames: list[Frame] = []
        self._exposures: list[float] = []
        self._gain = 0.0
        self._counter = 0
        self._armed = self._cancelled = False
        self._software_trigger = False
        self._not_before_ns: int | None = None      # None: no picture counts before trigger()
        self._error: PsError | None = None
        self._geometry: CameraGeometry | None = None
        self._subscriptions: list = []

    def open(self) -> None:
        """Subscribe."""
        # a driver may offer either reliability; best effort accepts both
        qos = QoSProfile(depth=32, reliability=ReliabilityPolicy.BEST_EFFORT)
        group = MutuallyExclusiveCallbackGroup()
        info_topic = self._topic.rsplit('/', 1)[0] + '/camera_info'
        self._subscriptions = [
            self._node.create_subscription(
                Image, self._topic, self._on_image, qos, callback_group=group,
                qos_overriding_options=OVERRIDABLE),
            self._node.create_subscription(
                CameraInfo, info_topic, self._on_info, qos, callback_group=group)]

    def close(self) -> None:
        """Unsubscribe."""
        self.cancel()
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []

    @property
    def camera_geometry(self) -> CameraGeometry | None:
        """Intrinsics from camera_info, or None."""
        return self._geometry

    def _on_info(self, message: CameraInfo) -> None:
        try:
            self._geometry = message_to_camera(message, self._standoff)
        except PsError as error:
            self._node.get_logger().warning(error.message, throttle_duration_sec=10.0)

    def _on_image(self, message: Image) -> None:
        with self._arrived:
            index, stamp_ns = len(self._frames), time_to_ns(message.header.stamp)
            self._counter += 1
            if not self._armed or self._not_before_ns is None or stamp_ns < self._not_before_ns:
                return
            try:
                image = use_all_bits(np.array(message_to_image(message)), self._bits)
            except PsError as error:
                self._error = error
            except ValueError as error:
                self._error = PsError(ErrorCode.SEQUENCER_BAD_IMAGE,
                                      f'{error}; parameter significant_bits does not fit')
            else:
                exposure = self._exposures[min(index, len(self._exposures) - 1)]
                self._frames.append(Frame(
                    image=image, frame_counter=self._counter, trigger_counter=None,
                    device_time_ns=stamp_ns, host_time_ns=stamp_ns,
                    exposure_time=exposure, gain=self._gain))
                if self._software_trigger:
                    self._not_before_ns = None
            self._arrived.notify_all()

    def arm(self, exposures: Sequence[float], panels: Sequence[Light] | None = None,
            gain: float = 0.0, software_trigger: bool = False) -> None:
        """Forget what came before and keep what comes from now on.

        :raises PsError: SEQUENCER_CAMERA_LOST if nobody publishes the topic.
        """
        if not self._node.count_publishers(self._topic):
            raise PsError(ErrorCode.SEQUENCER_CAMERA_LOST,
                          f'nobody publishes {self._node.resolve_topic_name(self._topic)}; is the '
                          'camera driver running, and image_topic right?')
        with self._arrived:
            self._frames, self._error = [], None
            self._exposures, self._gain = list(exposures), gain
            self._armed, self._cancelled = True, False
            self._software_trigger = software_trigger
            self._not_before_ns = None if software_trigger else 0

    def trigger(self) -> None:
        """Let the first picture count that is begun from now on."""
        with self._arrived:
            self._not_before_ns = time.time_ns()

    def collect(self, count: int, timeout: float) -> list[Frame]:
        """The pictures that came since arming, in order of arrival; waits for ``count`` of them.

        :raises PsError: SEQUENCER_BAD_IMAGE if one cannot be used.
        """
        with self._arrived:
            self._arrived.wait_for(
                lambda: self._cancelled or self._error or len(self._frames) >= count, timeout)
            if self._error:
                raise self._error
            return list(self._frames)

    def disarm(self) -> None:
        """Ignore pictures until armed again."""
        with self._arrived:
            self._armed = False

    def cancel(self) -> None:
        """Make a waiting collect return with what came so far."""
        with self._arrived:
            self._cancelled = True
            self._arrived.notify_all()
