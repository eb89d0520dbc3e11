"""Whether the reconstruction is there, and whether it is still the one that a stack was sent to.

A stack is sent once, to who is there. Nodes discover each other one by one: a reconstruction that
this process knows may still be unknown to the camera, and one that was killed stays known to all
until its lease has run out. So a new one is given time before a picture is taken for it, and one
that appears after the stack was sent is not waited for as long as one that has it.
"""
from collections.abc import Callable, Collection, Hashable
import time

SETTLE_S = 1.0      # nodes announce themselves four times a second
GRACE_S = 5.0       # for the result of one that was new to us but not to the camera


class ReconstructionWatch:
    """Follows the processes that publish results. All methods may be called from any thread.

    :param publishers: the identities of those there are now.
    :param clock: s.
    """

    def __init__(self, publishers: Callable[[], Collection[Hashable]],
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._publishers, self._clock = publishers, clock
        self._seen: dict[Hashable, float] = {}      # since when, of those there are

    def look(self) -> dict[Hashable, float]:
        """Those there are now and since when; to be called now and then."""
        now, before = self._clock(), self._seen
        self._seen = {each: before.get(each, now) for each in self._publishers()}
        return self._seen

    def ready(self) -> bool:
        """Whether there is one, and the newest has been there long enough for all to know it."""
        since = self.look().values()
        return bool(since) and self._clock() - max(since) >= SETTLE_S

    def follow(self) -> Callable[[], bool]:
        """To be called when a stack has been sent; returns whether its result may still come."""
        had_it = set(self.look())

        def alive() -> bool:
            current = self.look()
            new = [since for each, since in current.items() if each not in had_it]
            return bool(current) and not (new and self._clock() - max(new) >= GRACE_S)
        return alive
