"""Stacks out of a recorded session (MCAP), for ps_reconstruct."""
from collections.abc import Iterator
from pathlib import Path

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack


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
    from mcap.reader import NonSeekingReader
    from rclpy.serialization import deserialize_message

    from ps_head_driver.conversions import message_to_stack
    from ps_interfaces.msg import PhotometricStack
    found = 0
    with path.open('rb') as stream:
        try:
            for schema, _, message in NonSeekingReader(stream).iter_messages(
                    log_time_order=False):
                if schema is not None and schema.name == 'ps_interfaces/msg/PhotometricStack':
                    found += 1
                    yield message_to_stack(deserialize_message(message.data, PhotometricStack))
        except (McapError, EOFError, ValueError) as error:
            # a session that was cut off is good up to there
            if not found:
                raise PsError(ErrorCode.SESSION_NOT_A_SESSION, f'{path}: {error}') from error
    if not found:
        raise PsError(ErrorCode.SESSION_NOT_A_SESSION, f'{path}: no stack was recorded')
