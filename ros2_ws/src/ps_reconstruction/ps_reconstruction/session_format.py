"""What a session is on disk: a rosbag2 folder ``<name>/{metadata.yaml, <name>_0.mcap}``.

Topics, their quality of service, message definitions and the metadata file; the MCAP file itself
is bag_file.py (writing) and session_reader.py (reading).
"""
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import errno
from functools import cache
import json
import os
from pathlib import Path
import re
import struct
from typing import Any

import yaml

from ps_head_driver.errors import ErrorCode, PsError

STACK_TYPE = 'ps_interfaces/msg/PhotometricStack'
METADATA_FILE = 'metadata.yaml'
_FOREVER = {'sec': 9223372036, 'nsec': 854775807}
_SEPARATOR = '=' * 80


@dataclass(frozen=True)
class Topic:
    """A recorded topic.

    :param name: absolute name, or relative to the cell's namespace.
    :param type: as in 'std_msgs/msg/String'.
    :param latched: transient local, depth 1; otherwise volatile. All are reliable.
    :param definition: text of the message and of all it contains (MCAP encoding 'ros2msg').
    :param type_hash: REP 2011 hash of the definition; empty if unknown.
    """

    name: str
    type: str
    latched: bool = False
    definition: str = ''
    type_hash: str = ''

    @property
    def depth(self) -> int:
        """Messages that a late or slow reader still gets."""
        return 1 if self.latched else 10

    def qos(self) -> list[dict[str, Any]]:
        """Offered quality of service, as rosbag2 writes it (metadata version 9)."""
        return [{
            'history': 'keep_last', 'depth': self.depth, 'reliability': 'reliable',
            'durability': 'transient_local' if self.latched else 'volatile',
            'deadline': dict(_FOREVER), 'lifespan': dict(_FOREVER),
            'liveliness': 'automatic', 'liveliness_lease_duration': dict(_FOREVER),
            'avoid_ros_namespace_conventions': False,
        }]


# what a session records, by the names of the interface contract
TOPICS = (
    Topic('stack', STACK_TYPE),
    Topic('calibration', 'ps_interfaces/msg/HeadCalibration', latched=True),
    Topic('head_status', 'ps_interfaces/msg/HeadStatus', latched=True),
    Topic('acquisition_done', 'ps_interfaces/msg/AcquisitionDone'),
    Topic('reconstruction_info', 'ps_interfaces/msg/ReconstructionInfo', latched=True),
    Topic('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray'),
)


def check_name(name: str) -> str:
    """Return the session name if it is a plain folder name.

    :raises PsError: SESSION_BAD_REQUEST for anything that could leave the session folder.
    """
    if not re.fullmatch(r'[A-Za-z0-9][A-Za-z0-9._-]{0,99}', name, re.ASCII):
        raise PsError(
            ErrorCode.SESSION_BAD_REQUEST,
            f'session name {name[:120]!r}: use letters, digits, "-", "_" and ".", at most 100, '
            'the first a letter or digit')
    return name


def stack_id_of(data: bytes) -> str:
    """Field stack_id of a serialized PhotometricStack, without decoding its pictures.

    Empty if the data are too short to have one.
    """
    order = '<' if data[1:2] == b'\x01' else '>'
    position = 4 + 8                            # encapsulation, header.stamp
    text = b''
    for _ in ('header.frame_id', 'stack_id'):
        position += -position % 4
        if position + 4 > len(data):
            return ''
        length, = struct.unpack_from(order + 'I', data, position)
        text = data[position + 4:position + 4 + length]
        position += 4 + length
    return text.rstrip(b'\0').decode('utf-8', 'replace')


@cache
def message_definition(message_type: str) -> tuple[str, str]:
    """Definition with comments, and hash, of an installed message type.

    :returns: (text of the message and of every message it contains, 'RIHS01_...').
    :raises PsError: SESSION_INTERNAL if the type is not installed.
    """
    # the one place that needs a ROS installation
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    def share(name: str) -> Path:
        package, folder, base = name.split('/')
        return Path(get_package_share_directory(package)) / folder / base

    def text(name: str) -> str:
        return share(name).with_suffix('.msg').read_text(encoding='utf-8').rstrip() + '\n'

    try:
        description = json.loads(share(message_type).with_suffix('.json').read_text())
        hashes = {entry['type_name']: entry['hash_string'] for entry in description['type_hashes']}
        parts = [text(message_type)]
        for name in sorted(set(hashes) - {message_type}):
            package, _, base = name.split('/')
            parts.append(f'{_SEPARATOR}\nMSG: {package}/{base}\n{text(name)}')
    except (PackageNotFoundError, OSError, ValueError, KeyError) as error:
        raise PsError(ErrorCode.SESSION_INTERNAL,
                      f'definition of {message_type} is not installed: {error}') from error
    return ''.join(parts), hashes[message_type]


def rosbag2_metadata(
    file_name: str, topics: Sequence[tuple[Topic, int]], start: int, end: int,
    custom: Mapping[str, str],
) -> dict[str, Any]:
    """Content of metadata.yaml, rosbag2 version 9 (Jazzy).

    :param topics: topics and how many messages each has.
    :param start: log time of the first message, ns since 1970; end: of the last.
    :param custom: provenance; shown by ``ros2 bag info --verbose``.
    """
    count = sum(messages for _, messages in topics)
    span = {
        'starting_time': {'nanoseconds_since_epoch': start},
        'duration': {'nanoseconds': end - start},
        'message_count': count,
    }
    return {'rosbag2_bagfile_information': {
        'version': 9,
        'storage_identifier': 'mcap',
        **span,
        'topics_with_message_count': [
            {'topic_metadata': {
                'name': topic.name, 'type': topic.type, 'serialization_format': 'cdr',
                'offered_qos_profiles': topic.qos(), 'type_description_hash': topic.type_hash,
            }, 'message_count': messages}
            for topic, messages in topics],
        # chunks are compressed inside the MCAP file, which rosbag2 does not call compression
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file_name],
        'files': [{'path': file_name, **span}],
        'custom_data': dict(custom) or None,
        'ros_distro': 'jazzy',
    }}


def write_atomically(path: Path, content: Mapping[str, Any]) -> None:
    """Write YAML so that a crash leaves the old file or the new one, never half of it."""
    temporary = path.with_name(path.name + '.tmp')
    temporary.unlink(missing_ok=True)       # never through a link that someone left there
    with temporary.open('x', encoding='utf-8') as stream:
        yaml.dump(content, stream, Dumper=_PlainDumper, sort_keys=False)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)


class _PlainDumper(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):    # type: ignore[misc]
    """Without anchors and aliases, which rosbag2's reader need not know."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def error_of(error: OSError, path: Path) -> PsError:
    """Session error that says what the operating system's error means here."""
    codes = {
        errno.ENOSPC: (ErrorCode.SESSION_DISK_FULL, 'the disk is full'),
        errno.EDQUOT: (ErrorCode.SESSION_DISK_FULL, 'the disk quota is used up'),
        errno.EACCES: (ErrorCode.SESSION_NO_PERMISSION, 'no permission'),
        errno.EPERM: (ErrorCode.SESSION_NO_PERMISSION, 'no permission'),
        errno.EROFS: (ErrorCode.SESSION_NO_PERMISSION, 'the file system is read-only'),
    }
    code, text = codes.get(
        error.errno or 0, (ErrorCode.SESSION_WRITE_FAILED, error.strerror or str(error)))
    return PsError(code, f'cannot write {path}: {text}')
