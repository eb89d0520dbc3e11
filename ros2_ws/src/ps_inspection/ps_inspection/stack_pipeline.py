"""Which stacks are being reconstructed, and what became of them: the bookkeeping of inspections.

The reconstruction takes the newest stack that waits, an older one is dropped. Inspections must not
lose stacks to each other, so that no more of them may be on their way than it keeps: one in work
and one waiting. A stack that somebody else's capture has pushed out is found by order: stacks are
reconstructed in the order of their acquisition.
"""
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import threading
import time
from typing import Any

from ps_head_driver.errors import ErrorCode, PsError

_POLL_S = 0.05
_REMEMBERED = 200       # acquisitions


class StackPipeline:
    """Stacks on their way through the reconstruction. All methods may be called from any thread.

    :param depth: stacks at most between the start of their capture and their result.
    """

    def __init__(self, depth: int) -> None:
        self.depth = depth
        self.dropped = 0
        self._change = threading.Condition()
        self._places = 0
        self._abandoned: dict[str, float] = {}                 # stack_id: until when at most
        self._order: OrderedDict[str, int] = OrderedDict()     # acquired stacks: running number
        self._results: OrderedDict[str, Any] = OrderedDict()   # stack_id: ReconstructionInfo
        self._counter = self._newest_result = 0

    @property
    def places_taken(self) -> int:
        """Stacks that are on their way or may still be."""
        now = time.monotonic()
        return self._places + sum(until > now for until in self._abandoned.values())

    @contextmanager
    def place(self, cancelled: Callable[[], bool]) -> Iterator[None]:
        """A place for one stack; waits until there is one.

        A stack that nobody waits for any more keeps its place until the reconstruction is done
        with it.

        :raises PsError: INSPECTION_CANCELLED.
        """
        with self._change:
            while self.places_taken >= self.depth:
                _check(cancelled)
                self._change.wait(_POLL_S)
            self._places += 1
        try:
            yield
        finally:
            with self._change:
                self._places -= 1
                self._change.notify_all()

    def acquired(self, stack_id: str) -> None:
        """A capture has ended, also one that is none of ours."""
        with self._change:
            if stack_id not in self._order:
                self._counter += 1
                self._order[stack_id] = self._counter
            if len(self._order) > _REMEMBERED:
                self._order.popitem(last=False)

    def reconstructed(self, info: Any) -> None:
        """A ReconstructionInfo has come."""
        with self._change:
            self._abandoned.pop(info.stack_id, None)
            self._results[info.stack_id] = info
            self._newest_result = max(self._newest_result, self._order.get(info.stack_id, 0))
            if len(self._results) > _REMEMBERED:
                self._results.popitem(last=False)
            self._change.notify_all()

    def wait(self, stack_id: str, timeout: float, cancelled: Callable[[], bool],
             alive: Callable[[], bool]) -> Any:
        """The ReconstructionInfo of an acquired stack.

        :param timeout: s.
        :param alive: whether the reconstruction is there at all.
        :raises PsError: INSPECTION_CANCELLED, _RECONSTRUCTION_LOST or _STACK_DROPPED.
        """
        deadline = time.monotonic() + timeout
        with self._change:
            while stack_id not in self._results:
                if cancelled():
                    self._abandoned[stack_id] = deadline
                _check(cancelled)
                if self._newest_result > self._order.get(stack_id, self._newest_result):
                    self.dropped += 1
                    raise PsError(
                        ErrorCode.INSPECTION_STACK_DROPPED,
                        f'stack {stack_id} was dropped by the reconstruction for a newer one; do '
                        'not capture by other ways while inspections are running')
                if time.monotonic() > deadline:
                    raise PsError(ErrorCode.INSPECTION_RECONSTRUCTION_LOST,
                                  f'no result of the reconstruction for stack {stack_id} within '
                                  f'{timeout:g} s')
                if not alive():
                    raise PsError(ErrorCode.INSPECTION_RECONSTRUCTION_LOST,
                                  'the reconstruction node has gone; stack '
                                  f'{stack_id} has no result')
                self._change.wait(_POLL_S)
            return self._results.pop(stack_id)


def _check(cancelled: Callable[[], bool]) -> None:
    if cancelled():
        raise PsError(ErrorCode.INSPECTION_CANCELLED, 'cancelled')
