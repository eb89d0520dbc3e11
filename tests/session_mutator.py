"""Hostile sessions: real ones, changed where it hurts. One seed makes one input.

session_attack.py uses them.
"""
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import random
import re
import struct
from typing import Any
import zlib

import lz4.frame
from matplotlib import colormaps  # noqa: F401   makes its configuration folder when imported
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
import zstandard

from ps_head_driver.conversions import stack_to_message
from ps_interfaces.msg import PhotometricStack
from ps_reconstruction.session_reader import MAGIC

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA = 1, 2, 3, 4, 5, 6, 12
NUMBERS = (0, 1, 2, 3, 4, 7, 8, 255, 256, 65535, 1 << 16, 1 << 20, 1 << 24, (1 << 31) - 1, 1 << 31,
           (1 << 32) - 1, 1 << 32, (1 << 63) - 1, (1 << 64) - 1)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-300, 1e300, -1e300, 1e-3, float('inf'), float('-inf'),
          float('nan'))
TEXTS = ('', '.', '..', '../../outside/x', '/outside', '~/outside', 'a/../../outside', 'x' * 5000,
         'a\0b', '\n', '\x1b[2J', '%s%n', '{0.__class__}', '$(touch outside)', '<script>', '=1+1',
         '\U0001f4a5', '..\\..\\outside', 'CON', '-rf', '!!python/object:os.system', '&a [*a]',
         '[' * 3000, '\ud7ff', 'None', '000000')

Records = list[tuple[int, bytes]]


# ---------------------------------------------------------------------------- MCAP

def records_of(data: bytes) -> Records:
    """Records of a file without its magic, as (opcode, content); chunks opened."""
    found, place = [], len(MAGIC)
    while place + 9 <= len(data):
        opcode, length = struct.unpack_from('<BQ', data, place)
        content = data[place + 9:place + 9 + length]
        if opcode == CHUNK:
            size, = struct.unpack_from('<I', content, 28)       # of the compression's name
            inner = content[32 + size + 8:]
            found += records_of(MAGIC + inner)
        elif opcode in (HEADER, SCHEMA, CHANNEL, MESSAGE, METADATA):
            found.append((opcode, content))
        place += 9 + length
    return found


def text(value: str | bytes) -> bytes:
    """A string as MCAP and CDR (without the zero) have it."""
    data = value.encode('utf-8', 'surrogatepass') if isinstance(value, str) else value
    return struct.pack('<I', len(data)) + data


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    """One record; ``length`` is what it says of itself."""
    return struct.pack('<BQ', opcode, (len(content) if length is None else length) % (1 << 64)
                       ) + content


def chunk(content: bytes, compression: str = '', size: int | None = None,
          crc: int | None = None, data: bytes | None = None) -> bytes:
    """A chunk of records; what is given is said wrongly."""
    if data is None:
        data = {'lz4': lz4.frame.compress, 'zstd': zstandard.compress}.get(
            compression, bytes)(content)
    size = len(content) if size is None else size
    crc = zlib.crc32(content) if crc is None else crc
    return record(CHUNK, struct.pack('<QQQI', 0, 1, size % (1 << 64), crc) + text(compression)
                  + struct.pack('<Q', len(data)) + data)


def whole(records: Records, chunks: Callable[[bytes], bytes] = chunk) -> bytes:
    """A file of these records, all but the header in one chunk."""
    head = b''.join(record(*r) for r in records if r[0] == HEADER)
    body = b''.join(record(*r) for r in records if r[0] not in (HEADER, METADATA))
    metadata = b''.join(record(*r) for r in records if r[0] == METADATA)
    return MAGIC + head + metadata + chunks(body) + record(FOOTER, bytes(20)) + MAGIC


# ---------------------------------------------------------------------------- mutations

class Mutator:
    """Makes hostile sessions of a real one.

    :param session: folder of a session with a stack or two.
    """

    def __init__(self, session: Path) -> None:
        self.file = next(session.glob('*.mcap')).read_bytes()
        self.metadata = (session / 'metadata.yaml').read_bytes()
        self.records = records_of(self.file)
        self.stack = max((content[22:] for opcode, content in self.records if opcode == MESSAGE),
                         key=len)
        self.kinds: tuple[Callable[[random.Random], bytes], ...] = (
            self.bytes_changed, self.cut, self.record_length, self.record_order, self.bad_chunk,
            self.bad_cdr, self.bad_cdr, self.bad_content, self.bad_content, self.bad_content,
            self.bad_channel, self.bad_metadata, self.foreign)

    def write(self, seed: int, folder: Path) -> str:
        """Make the session of a seed in a new folder; returns the kind of mutation."""
        chance = random.Random(seed)
        kind = chance.choice(self.kinds)
        folder.mkdir()
        (folder / 'hostile_0.mcap').write_bytes(kind(chance))
        what = chance.randrange(6)
        if what == 0:       # a crash leaves none
            return kind.__name__
        metadata = self.metadata
        if what == 1:
            metadata = b'a: &a [x, x]\nb: [*a, *a]\n' + b'[' * 2000 + chance.randbytes(50)
        if what == 2:
            for name in ('metadata.yaml', 'metadata.yaml.tmp', 'hostile_0.mcap.recovering'):
                (folder / name).symlink_to(folder.parent.parent / 'outside' / name)
        else:
            (folder / 'metadata.yaml').write_bytes(metadata)
        return kind.__name__

    def bytes_changed(self, chance: random.Random) -> bytes:
        data = bytearray(self.file)
        for _ in range(chance.randint(1, 16)):
            data[chance.randrange(len(MAGIC), len(data))] = chance.randrange(256)
        return bytes(data)

    def cut(self, chance: random.Random) -> bytes:
        data = self.file[:chance.randrange(len(self.file))]
        return data + chance.randbytes(chance.choice((0, 0, 5, 100)))

    def record_length(self, chance: random.Random) -> bytes:
        chosen = chance.randrange(len(self.records))
        return MAGIC + b''.join(
            record(opcode, content, chance.choice((*NUMBERS, len(content) - 1, len(content) + 1))
                   if number == chosen else None)
            for number, (opcode, content) in enumerate(self.records)) + record(FOOTER, bytes(20))

    def record_order(self, chance: random.Random) -> bytes:
        records = list(self.records)
        for _ in range(chance.randint(1, 5)):
            place = chance.randrange(len(records))
            what = chance.randrange(4)
            if what == 0 and len(records) > 1:
                del records[place]
            elif what == 1:
                records.insert(chance.randrange(len(records)), records[place])
            elif what == 2:
                chance.shuffle(records)
            else:
                records.insert(place, (chance.randrange(256), chance.randbytes(30)))
        return whole(records)

    def bad_chunk(self, chance: random.Random) -> bytes:
        compression = chance.choice(('', 'lz4', 'zstd', 'gzip', '../x'))
        bomb = {'lz4': lz4.frame.compress, 'zstd': zstandard.compress}.get(compression, bytes)
        return whole(self.records, chance.choice((
            lambda body: chunk(body, compression, size=chance.choice(NUMBERS)),
            lambda body: chunk(body, compression, size=chance.choice((10, 3 << 30)), crc=0,
                               data=bomb(bytes(8 << 20))),
            lambda body: chunk(body, compression, crc=chance.randrange(1, 1 << 32)),
            lambda body: chunk(body, compression, data=chance.randbytes(200)),
            lambda body: chunk(record(CHUNK, chunk(body)[9:]), compression),
            lambda body: chunk(body[:-chance.randint(1, 500)], compression),
            lambda body: chunk(body, compression))))

    def _with_stack(self, data: bytes) -> bytes:
        return whole([(opcode, content[:22] + data if opcode == MESSAGE else content)
                      for opcode, content in self.records])

    def bad_cdr(self, chance: random.Random) -> bytes:
        data = bytearray(self.stack)
        for _ in range(chance.randint(1, 4)):
            # lengths lie on multiples of four behind the encapsulation
            place = 4 * chance.randrange(1, min(len(data), 4000) // 4 - 2)
            struct.pack_into('<I', data, place, chance.choice(NUMBERS) % (1 << 32))
        if chance.random() < 0.2:
            data[chance.randrange(4)] = chance.randrange(256)
        if chance.random() < 0.2:
            data += bytes(chance.choice((1, 1000, 1 << 20)))
        if chance.random() < 0.2:
            del data[chance.randrange(len(data)):]
        return self._with_stack(bytes(data))

    def bad_content(self, chance: random.Random) -> bytes:
        message = deserialize_message(self.stack, PhotometricStack)
        for _ in range(chance.randint(1, 4)):
            self._spoil(message, chance)
        return self._with_stack(bytes(serialize_message(message)))

    def _spoil(self, message: Any, chance: random.Random) -> None:
        """Put a hostile value into some field of a message."""
        names = list(message.get_fields_and_field_types())
        name = chance.choice(names)
        value = getattr(message, name)
        if hasattr(value, 'get_fields_and_field_types'):
            self._spoil(value, chance)
        elif isinstance(value, list) and value and hasattr(value[0], 'SLOT_TYPES'):
            what = chance.randrange(5)
            if what == 0:
                value.pop()
            elif what == 1:
                value.append(value[0])
            elif what == 2:
                value.clear()
            else:
                self._spoil(chance.choice(value), chance)
        elif isinstance(value, bool):
            setattr(message, name, not value)
        elif isinstance(value, str):
            setattr(message, name, chance.choice(TEXTS).replace('\0', chance.choice('\0 ')))
        elif isinstance(value, int):
            kind = message.get_fields_and_field_types()[name]
            bits = int(re.sub(r'\D', '', kind) or 8)
            number = chance.choice(NUMBERS) % (1 << bits)
            signed = kind.startswith('int') and number >= 1 << (bits - 1)
            setattr(message, name, number - (1 << bits) if signed else number)
        elif isinstance(value, float):
            setattr(message, name, chance.choice(FLOATS))
        elif isinstance(value, np.ndarray):
            value[chance.randrange(len(value))] = chance.choice(FLOATS)
        elif hasattr(value, 'frombytes'):
            setattr(message, name, value[:chance.randrange(len(value) + 1)] if len(value)
                    else type(value)(value.typecode, [1] * 5))

    def bad_channel(self, chance: random.Random) -> bytes:
        records = []
        for opcode, content in self.records:
            if opcode == CHANNEL:
                topic = chance.choice((*TEXTS, '/ps_head/stack'))
                qos = chance.choice((*TEXTS, '- durability: 1', '- [', '{}', '- 5', '42',
                                     '&a [' + '[' * 900))
                metadata = text('offered_qos_profiles') + text(qos)
                number = chance.choice((content[:2], bytes(2)))
                content = (number + content[2:4] + text(topic) + text('cdr')
                           + struct.pack('<I', len(metadata)) + metadata)
            elif opcode == SCHEMA and chance.random() < 0.3:
                content = content[:2] + text(chance.choice((*TEXTS, 'os/msg/system'))) + text(
                    'ros2msg') + text('string data')
            records.append((opcode, content))
        return whole(records)

    def bad_metadata(self, chance: random.Random) -> bytes:
        pairs = b''.join(text(key) + text(chance.choice((*TEXTS, '1e999', 'nan', '-1')))
                         for key in ('session_id', 'namespace', 'part_id', 'notes', 'method',
                                     'l_filter', 'height_rounds', 'smoothness', 'pixel_pitch',
                                     'form', chance.choice(TEXTS)))
        name = chance.choice(('session', 'parameters/reconstruction', *TEXTS))
        return whole([*self.records, (METADATA, text(name) + text(pairs))])

    def foreign(self, chance: random.Random) -> bytes:
        return chance.choice((b'', MAGIC, MAGIC[:5], b'SQLite format 3\0', b'#ROSBAG V2.0\n',
                              b'\x89PNG\r\n\x1a\n')) + chance.randbytes(chance.randrange(200))


def small_session(folder: Path, make: Callable[..., Path], stack: Any) -> Path:
    """A small session to mutate: two stacks with everything a stack can have."""
    full = replace(stack, ambient=np.zeros_like(stack.images[0]),
                   mask=np.ones(stack.shape, bool),
                   gain_maps=[np.ones((3, 4), np.float32) for _ in stack.images])
    assert stack_to_message(full).gain_maps
    return make(folder, [full], {'session': {'session_id': 's', 'namespace': '/ps_head'}})
