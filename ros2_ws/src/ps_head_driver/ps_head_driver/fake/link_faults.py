"""Faults of the serial line between host and fake board: lost, damaged, late, doubled bytes."""
from collections import deque
from dataclasses import dataclass, fields, replace
import random
from typing import Any


@dataclass(frozen=True)
class FaultRates:
    """How bad the line is.

    :param drop: share of replies that never arrive.
    :param duplicate: share of replies that arrive twice.
    :param corrupt: probability that a byte is damaged, both directions.
    :param delay_s: added to every reply.
    :param delayed: share of the replies that ``delay_s`` concerns.
    """

    drop: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0
    delay_s: float = 0.0
    delayed: float = 1.0

    def changed(self, **values: Any) -> 'FaultRates':
        """Copy with some values changed.

        :raises ValueError: unknown name or value out of range.
        """
        known = {field.name for field in fields(self)}
        for name, value in values.items():
            if name not in known:
                raise ValueError(f'{name} is not one of {", ".join(sorted(known))}')
            if not isinstance(value, (int, float)) or not 0 <= value <= 10:
                raise ValueError(f'{name}: {value!r}')
        return replace(self, **values)


class FaultyLine:
    """Both directions of the line, on an injected clock.

    :param seed: of the faults.
    """

    def __init__(self, seed: int = 1) -> None:
        self.rates = FaultRates()
        self._random = random.Random(seed)
        self._replies: deque[tuple[int, bytes]] = deque()      # due, bytes

    def to_board(self, data: bytes) -> bytes:
        """What the board gets of what the host sent."""
        return self._damaged(data)

    def from_board(self, reply: bytes, now_ns: int) -> None:
        """Take one reply of the board."""
        if not reply or self._random.random() < self.rates.drop:
            return
        late = self.rates.delay_s and self._random.random() < self.rates.delayed
        due_ns = now_ns + (round(self.rates.delay_s * 1e9) if late else 0)
        copies = 2 if self._random.random() < self.rates.duplicate else 1
        self._replies += [(due_ns, self._damaged(reply))] * copies

    def due(self, now_ns: int) -> bytes:
        """What reaches the host until now; a late reply does not hold up those after it."""
        ready = [data for due_ns, data in self._replies if due_ns <= now_ns]
        self._replies = deque(item for item in self._replies if item[0] > now_ns)
        return b''.join(ready)

    def next_event_ns(self) -> int | None:
        """When due() will have something; None if nothing is on its way."""
        return min((due_ns for due_ns, _ in self._replies), default=None)

    def clear(self) -> None:
        """Lose what is on its way, as when the cable is pulled."""
        self._replies.clear()

    def _damaged(self, data: bytes) -> bytes:
        if not self.rates.corrupt:
            return data
        return bytes(
            byte ^ self._random.randint(1, 255) if self._random.random() < self.rates.corrupt
            else byte for byte in data)
