"""Output images of the reconstruction for whoever wants files of a stack."""
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
import threading
import time

from numpy.typing import NDArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image

from ps_head_driver import ros_support
from ps_head_driver.conversions import message_to_image
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.frames import optical_to_plane
from ps_reconstruction.conversions import IMAGE_TOPICS

_KEPT = 4              # images of each quantity that nobody has fetched
_IDLE_S = 30.0         # until a subscription that is not used ends
_DISCOVERY_S = 0.3     # until the publisher knows its new subscriber
_POLL_S = 0.05

Stamp = tuple[int, int]


class OutputImages:
    """Subscribes to images only while they are wanted: nobody computes them otherwise."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = ReentrantCallbackGroup()
        self._subscriptions: dict[str, Subscription] = {}
        self._users: Counter[str] = Counter()
        self._used: dict[str, float] = {}      # when the last user went
        self._images: dict[str, OrderedDict[Stamp, Image]] = {}
        self._change = threading.Condition()
        node.create_timer(5.0, self._end_idle)

    @contextmanager
    def wanted(self, names: Iterable[str], timeout: float = 5.0) -> Iterator[None]:
        """Inside, images of stacks to come arrive, for :meth:`fetch`.

        :raises PsError: INSPECTION_RECONSTRUCTION_LOST if nobody publishes them.
        """
        names = sorted(set(names))
        with self._change:
            new = [name for name in names if name not in self._subscriptions]
            for name in new:
                self._images[name] = OrderedDict()
                self._subscriptions[name] = self._node.create_subscription(
                    Image, IMAGE_TOPICS[name], partial(self._on_image, name),
                    ros_support.RELIABLE, callback_group=self._group)
            self._users.update(names)
        try:
            deadline = time.monotonic() + timeout
            for topic in (IMAGE_TOPICS[name] for name in names):
                while not self._node.count_publishers(topic):
                    if time.monotonic() > deadline:
                        raise PsError(
                            ErrorCode.INSPECTION_RECONSTRUCTION_LOST,
                            f'nobody publishes {topic}; is the reconstruction running?')
                    time.sleep(_POLL_S)
            if new:
                time.sleep(_DISCOVERY_S)
            yield
        finally:
            with self._change:
                self._users.subtract(names)
                self._used |= dict.fromkeys(names, time.monotonic())

    def _on_image(self, name: str, message: Image) -> None:
        with self._change:
            images = self._images[name]
            images[message.header.stamp.sec, message.header.stamp.nanosec] = message
            if len(images) > _KEPT:
                images.popitem(last=False)
            self._change.notify_all()

    def fetch(self, names: Iterable[str], stamp: Stamp, timeout: float,
              cancelled: Callable[[], bool]) -> dict[str, NDArray]:
        """Images of one stack; normals in ps_head_plane axes.

        :param stamp: seconds and nanoseconds of the stack.
        :param timeout: s, from the end of the reconstruction.
        :raises PsError: INSPECTION_OUTPUT_MISSING or INSPECTION_CANCELLED.
        """
        deadline, found = time.monotonic() + timeout, {}
        for name in names:
            with self._change:
                while stamp not in self._images[name]:
                    if cancelled():
                        raise PsError(ErrorCode.INSPECTION_CANCELLED, 'cancelled')
                    if time.monotonic() > deadline:
                        raise PsError(ErrorCode.INSPECTION_OUTPUT_MISSING,
                                      f'{IMAGE_TOPICS[name]} did not arrive within {timeout:g} s '
                                      'after the reconstruction')
                    self._change.wait(_POLL_S)
                message = self._images[name].pop(stamp)
            image = message_to_image(message)
            found[name] = optical_to_plane(image) if name == 'normal' else image
        return found

    def _end_idle(self) -> None:
        # not at once: the next part will want the same
        with self._change:
            for name in list(self._subscriptions):
                if not self._users[name] and time.monotonic() - self._used[name] > _IDLE_S:
                    self._node.destroy_subscription(self._subscriptions.pop(name))
                    self._images[name].clear()
