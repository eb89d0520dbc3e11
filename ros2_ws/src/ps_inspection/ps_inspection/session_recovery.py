"""Making a session complete that a crash cut off."""
from dataclasses import dataclass

from ps_head_driver.errors import ErrorCode, PsError
from ps_inspection.bag_file import BagFile
from ps_reconstruction.session_format import (
    METADATA_FILE,
    error_of,
    rosbag2_metadata,
    write_atomically,
)
from ps_reconstruction.session_reader import Scan, Session


@dataclass(frozen=True)
class Recovery:
    """What ``recover`` did."""

    changed: bool
    messages: int
    stacks: int
    lost_bytes: int
    problems: list[str]


def recover(session: Session) -> Recovery:
    """Make a session that was cut off a complete one, losing nothing that can be read.

    The file is written anew beside the old one and put in its place at the end, so an interrupted
    recovery does no harm. A session that is whole is left alone.

    :raises PsError: SESSION_DISK_FULL, SESSION_NO_PERMISSION or SESSION_WRITE_FAILED;
        SESSION_BAD_REQUEST for a file without its folder.
    """
    if not session.is_folder:
        raise PsError(ErrorCode.SESSION_BAD_REQUEST,
                      f'{session.file} is a file; name the session folder it is in')
    info = session.info()
    scan = info.scan
    result = Recovery(not info.complete or bool(scan.problems), sum(info.counts.values()),
                      info.stacks, scan.lost_bytes, scan.problems)
    custom = scan.metadata.get('session', {})
    try:
        if not scan.complete or scan.problems:
            _rewrite(session, scan, custom)
        elif result.changed:      # only metadata.yaml is missing
            write_atomically(session.folder / METADATA_FILE, rosbag2_metadata(
                session.file.name,
                [(topic, info.counts[topic.name]) for topic in scan.topics],
                info.start, info.end, custom))
    except OSError as error:
        raise error_of(error, session.file) from error
    return result


def _rewrite(session: Session, scan: Scan, custom: dict[str, str]) -> None:
    new = session.file.with_name(session.file.name + '.recovering')
    new.unlink(missing_ok=True)
    bag = BagFile(new, scan.topics, scan.compression)
    try:
        for name, values in scan.metadata.items():
            bag.add_metadata(name, values)
        for message in session.messages():
            bag.write(message.topic.name, message.data, message.log_time, message.publish_time)
        bag.finish(custom, session.file)
    except BaseException:
        bag.abandon()
        new.unlink(missing_ok=True)
        raise
