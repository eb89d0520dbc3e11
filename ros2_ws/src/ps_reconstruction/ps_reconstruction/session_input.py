"""Stacks out of a recorded session (MCAP), for ps_reconstruct."""
from collections.abc import Iterator
from pathlib import Path
import struct

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack

STACK_TYPE = 'ps_interfaces/msg/PhotometricStack'


def session_file(path: Path) -> Path | None:
    """The MCAP file that a path means: the file itself, or the one in a rosbag2 folder."""
    if path.is_file() and path.suffix == '.mcap':
        return path
    if path.is_dir():
        return next(iter(sorted(path.glob('*.mcap'))), None)
    return None


def read_session(path: Path) -> Iterator[Stack]:
    """Stacks of a session in order; what a crash cut off is left out.

    :raises PsError: SESSION_NOT_A_SESSION if there is no stack or the file is damaged.
    """
    from mcap.exceptions import McapError
    from mcap.records import Channel, Message, Schema
    from mcap.stream_reader import StreamReader
    from rclpy.serialization import deserialize_message

    from ps_head_driver.conversions import message_to_stack
    from ps_interfaces.msg import PhotometricStack
    found = 0
    schemas: set[int] = set()
    channels: set[int] = set()
    with path.open('rb') as stream:
        try:
            # record by record: the index at the end is missing after a crash
            for record in StreamReader(stream).records:
                if isinstance(record, Schema) and record.name == STACK_TYPE:
                    schemas.add(record.id)
                elif isinstance(record, Channel) and record.schema_id in schemas:
                    channels.add(record.id)
                elif isinstance(record, Message) and record.channel_id in channels:
                    found += 1
                    yield message_to_stack(deserialize_message(record.data, PhotometricStack))
        except (McapError, EOFError, ValueError, struct.error) as error:
            # a session that was cut off is good up to there
            if not found:
                raise PsError(ErrorCode.SESSION_NOT_A_SESSION,
                              f'{path}: damaged before its first stack: '
                              f'{str(error) or type(error).__name__}') from error
    if not found:
        raise PsError(ErrorCode.SESSION_NOT_A_SESSION, f'{path}: no stack was recorded')
