"""Which stacks are being reconstructed, and what became of them: the bookkeeping of inspections.

The reconstruction works on one stack and keeps the newest that waits; an older one is dropped. So
that inspections lose no stacks to each other, no more than two may be on their way. Captures of
others and the probes of a search count as well, as soon as they are announced. A stack that one of
them has pushed out all the same is found by order: stacks are reconstructed in the order of their
acquisition.
"""
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import threading
import time
from typing import Any

from ps_head_driver.errors import ErrorCode, PsError

_POLL_S = 0.05
_REMEMBERED = 200       # acquisitions and results


@dataclass(frozen=True)
class _Acquired:
    number: int
    time: float


class StackPipeline:
    """Stacks on their way through the reconstruction. All methods may be called from any thread.

    :param depth: stacks that may be on their way, the one being captured included.
    :param patience: s, after which a stack without a result is not waited for any more.
    """

    def __init__(self, depth: int, patience: float = 60.0) -> None:
        self.depth, self.patience = depth, patience
        self.dropped = 0
        self._change = threading.Condition(threading.RLock())
        self._reserved = 0
        self._acquired: OrderedDict[str, _Acquired] = OrderedDict()
        self._results: OrderedDict[str, Any] = OrderedDict()   # stack_id: ReconstructionInfo
        self._counter = self._newest_result = 0

    @property
    def on_their_way(self) -> int:
        """Stacks being captured or reconstructed."""
        oldest = time.monotonic() - self.patience
        return self._reserved + sum(
            stack.number > self._newest_result and stack.time > oldest
            for stack in self._acquired.values())

    @contextmanager
    def place(self, cancelled: Callable[[], bool]) -> Iterator[Callable[[str], None]]:
        """A place for the stack of one capture; waits until there is one.

        Yields what is to be called with the stack's id once it has been acquired; from then on it
        counts until it has been reconstructed, whether somebody waits for it or not.

        :raises PsError: INSPECTION_CANCELLED.
        """
        with self._change:
            while self.on_their_way >= self.depth:
                _check(cancelled)
                self._change.wait(_POLL_S)
            self._reserved += 1
        reserved = True

        def taken(stack_id: str) -> None:
            nonlocal reserved
            with self._change:
                self.acquired(stack_id)
                self._reserved -= reserved
                reserved = False
        try:
            yield taken
        finally:
            with self._change:
                self._reserved -= reserved
                self._change.notify_all()

    def acquired(self, stack_id: str) -> None:
        """A capture has ended, whoever asked for it."""
        with self._change:
            if stack_id not in self._acquired:
                self._counter += 1
                self._acquired[stack_id] = _Acquired(self._counter, time.monotonic())
            if len(self._acquired) > _REMEMBERED:
                self._acquired.popitem(last=False)

    def forget(self, stack_id: str) -> None:
        """The stack of an acquired capture will not come."""
        with self._change:
            self._acquired.pop(stack_id, None)
            self._change.notify_all()

    def reconstructed(self, info: Any) -> None:
        """A ReconstructionInfo has come."""
        with self._change:
            self._results[info.stack_id] = info
            if info.stack_id in self._acquired:
                self._newest_result = max(self._newest_result,
                                          self._acquired[info.stack_id].number)
            if len(self._results) > _REMEMBERED:
                self._results.popitem(last=False)
            self._change.notify_all()

    def wait(self, stack_id: str, timeout: float, cancelled: Callable[[], bool],
             alive: Callable[[], bool]) -> Any:
        """The ReconstructionInfo of an acquired stack.

        :param timeout: s.
        :param alive: whether the reconstruction that got the stack is still there.
        :raises PsError: INSPECTION_CANCELLED, _RECONSTRUCTION_LOST or _STACK_DROPPED.
        """
        deadline = time.monotonic() + timeout
        with self._change:
            while stack_id not in self._results:
                _check(cancelled)
                stack = self._acquired.get(stack_id)
                if stack is not None and self._newest_result > stack.number:
                    self.dropped += 1
                    raise PsError(
                        ErrorCode.INSPECTION_STACK_DROPPED,
                        f'stack {stack_id} was dropped by the reconstruction for a newer one; do '
                        'not capture by other ways while inspections are running')
                late = time.monotonic() > deadline
                if late or not alive():
                    self.forget(stack_id)
                    raise PsError(
                        ErrorCode.INSPECTION_RECONSTRUCTION_LOST,
                        f'no result of the reconstruction for stack {stack_id} '
                        + (f'within {timeout:g} s' if late else 'because its node has gone or '
                           'was started again'))
                self._change.wait(_POLL_S)
            return self._results.pop(stack_id)


def _check(cancelled: Callable[[], bool]) -> None:
    if cancelled():
        raise PsError(ErrorCode.INSPECTION_CANCELLED, 'cancelled')
