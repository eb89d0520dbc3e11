"""Check serialized messages from files before they are decoded.

The decoder of the middleware reserves memory for every length a message claims; a small file
could so take hundreds of times its size. Here the message is walked through first: each length
must fit into the bytes that are there.
"""
from functools import cache
from importlib import import_module
import re
import struct
from typing import Any

MAX_PARTS = 10_000      # messages and texts in the lists of one message
MAX_DEPTH = 16

_SIZES = {
    'boolean': 1, 'octet': 1, 'char': 1, 'int8': 1, 'uint8': 1, 'int16': 2, 'uint16': 2,
    'int32': 4, 'uint32': 4, 'float': 4, 'int64': 8, 'uint64': 8, 'double': 8}


def check(data: bytes, message_type: str) -> None:
    """Check that a message can be decoded in memory of the order of its own size.

    :param data: serialized with its 4 bytes of encapsulation (plain CDR).
    :param message_type: as in 'std_msgs/msg/String'; must be installed.
    :raises ValueError: saying which field does not fit.
    """
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        raise ValueError('the message is not plain CDR')
    _Walk(data).message(message_type, 0)


class _Walk:
    def __init__(self, data: bytes) -> None:
        self._data = data
        self._order = '<' if data[1] else '>'
        self._place = 4
        self._parts = 0

    def message(self, message_type: str, depth: int) -> None:
        if depth > MAX_DEPTH:
            raise ValueError('the message is nested too deeply')
        for name, kind, count in _fields(message_type):
            try:
                self._field(kind, count, depth)
            except ValueError as error:
                raise ValueError(f'{name}: {error}') from None

    def _field(self, kind: str, count: int | None, depth: int) -> None:
        listed = count != 1
        if count is None:
            count = self._length()
        size = _SIZES.get(kind)
        if size is not None:
            if count:
                self._skip(count * size, size)
            return
        if listed:
            self._parts += count
            if self._parts > MAX_PARTS:
                raise ValueError(f'{count} entries, the limit is {MAX_PARTS}')
        for _ in range(count):
            if kind == 'string':
                self._skip(self._length(), 1)
            else:
                self.message(kind, depth + 1)

    def _length(self) -> int:
        self._skip(4, 4)
        return int(struct.unpack_from(self._order + 'I', self._data, self._place - 4)[0])

    def _skip(self, size: int, alignment: int) -> None:
        # alignment counts from the end of the encapsulation
        self._place += -(self._place - 4) % alignment
        if size > len(self._data) - self._place:
            raise ValueError(f'{size} bytes claimed, {len(self._data) - self._place} are there')
        self._place += size


@cache
def _fields(message_type: str) -> list[tuple[str, str, int | None]]:
    """(name, type of one entry, entries or None for a sequence) of every field."""
    package, _, name = message_type.split('/')
    kind: Any = getattr(import_module(f'{package}.msg'), name)
    return [(field, *_parsed(text)) for field, text in kind.get_fields_and_field_types().items()]


def _parsed(text: str) -> tuple[str, int | None]:
    count: int | None = 1
    sequence = re.fullmatch(r'sequence<(.+?)(, \d+)?>', text)
    array = re.fullmatch(r'(.+)\[(\d+)\]', text)
    if sequence:
        text, count = sequence[1], None
    elif array:
        text, count = array[1], int(array[2])
    if text.startswith('string'):
        text = 'string'         # bounded or not
    elif '/' in text:
        package, name = text.split('/')
        text = f'{package}/msg/{name}'
    elif text not in _SIZES:
        raise ValueError(f'fields of type {text} are not supported')
    return text, count
