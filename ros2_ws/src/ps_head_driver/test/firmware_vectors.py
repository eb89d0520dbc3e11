"""Packets that the C code is tested with, made by the Python protocol module.

Writes firmware/host/vectors.txt when run.
"""
from pathlib import Path
import random

from ps_head_driver.protocol import MAX_BODY, Packet, encode

FIRMWARE = Path(__file__).resolve().parents[1] / 'firmware'
VECTORS = FIRMWARE / 'host' / 'vectors.txt'
_TITLE = '# type sequence session body wire (hexadecimal); made by test/firmware_vectors.py\n'


def vectors() -> str:
    """All lengths of body: zeros, ones, random bytes and random bytes with many zeros."""
    chance = random.Random(3)
    lines = [_TITLE]
    for length in range(MAX_BODY + 1):
        for body in (bytes(length), b'\xff' * length, chance.randbytes(length),
                     bytes(chance.choice((0, 0, 1, 255)) for _ in range(length))):
            packet = Packet(chance.randrange(256), chance.randrange(256),
                            chance.randrange(65536), body)
            lines.append(f'{packet.type:02x} {packet.sequence:02x} {packet.session:04x} '
                         f'{body.hex() or "-"} {encode(packet).hex()}\n')
    return ''.join(lines)


if __name__ == '__main__':
    VECTORS.write_text(vectors())
