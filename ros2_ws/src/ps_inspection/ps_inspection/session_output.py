"""Folders made from sessions: one a stack and an index.csv, safe to interrupt and run again."""
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass, field
import math
from pathlib import Path
import re
import shutil
import tempfile
from typing import Any

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack
from ps_reconstruction.session_reader import Session

# what says which stack it is; empty where not known
IDENTITY_FIELDS = (
    'stack_id', 'part_id', 'session_id', 'stamp_ns', 'calibration_id', 'geometry',
    'convergence_radius_m', 'light_height_m', 'pose_frame',
    'pose_x', 'pose_y', 'pose_z', 'pose_qx', 'pose_qy', 'pose_qz', 'pose_qw')
_PART = '.part'


@dataclass
class Outcome:
    """What became of the stacks of a session.

    :param skipped: already there from an earlier, interrupted run.
    :param failed: stack folder name to reason.
    :param problems: damage of the session file.
    """

    done: int = 0
    skipped: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


def identity(stack: Stack) -> dict[str, Any]:
    """Values of IDENTITY_FIELDS."""
    pose = stack.head_pose
    return dict(zip(IDENTITY_FIELDS, (
        stack.stack_id, stack.part_id, stack.session_id, stack.stamp_ns, stack.calibration_id,
        stack.geometry.name, known(stack.convergence_radius), known(stack.light_height),
        pose.frame_id, *pose.position, *pose.quaternion), strict=True))


def known(value: float) -> float | None:
    """None for NaN, which neither JSON nor a table knows."""
    return float(value) if math.isfinite(value) else None


def reason(error: Exception) -> str:
    """Why a stack failed, on one line."""
    text = error.message if isinstance(error, PsError) else f'{type(error).__name__}: {error}'
    return ' '.join(text.split())


def stack_folder_name(number: int, stack_id: str) -> str:
    """Name that sorts in order of capture and cannot leave the output folder."""
    return f'{number:06d}_' + (re.sub(r'[^A-Za-z0-9_-]', '_', stack_id)[:60] or 'stack')


def claim(out: Path, session: Session) -> None:
    """Make ``out`` the output folder of this session, and of no other.

    :raises PsError: SESSION_BAD_REQUEST if it holds something else, SESSION_NO_PERMISSION.
    """
    marker, name = out / '.session', str(session.file.resolve())
    try:
        out.mkdir(parents=True, exist_ok=True)
        if marker.is_file():
            if marker.read_text() != name:
                raise PsError(ErrorCode.SESSION_BAD_REQUEST,
                              f'{out} holds the output of {marker.read_text()}')
        elif any(out.iterdir()):
            raise PsError(ErrorCode.SESSION_BAD_REQUEST, f'{out} is not empty')
        else:
            marker.write_text(name)
    except OSError as error:
        raise PsError(ErrorCode.SESSION_NO_PERMISSION, f'cannot write {out}: {error}') from error


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A folder to fill, which gets its name only when the block ends well.

    Of several that fill the same one, the first wins: a worker that was given up for dead may
    still finish.
    """
    part = Path(tempfile.mkdtemp(prefix=f'.{path.name}.', suffix=_PART, dir=path.parent))
    try:
        yield part
        part.chmod(0o755)
        try:
            part.rename(path)
        except OSError:
            if not path.is_dir():
                raise
    finally:
        shutil.rmtree(part, ignore_errors=True)


def finish(out: Path, fields: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write index.csv and remove what dead workers left."""
    part = out / '.index.csv'
    with part.open('w', newline='', encoding='utf-8') as stream:
        writer = csv.DictWriter(stream, fields)
        writer.writeheader()
        writer.writerows(rows)
    part.replace(out / 'index.csv')
    for left in out.glob(f'.*{_PART}'):
        shutil.rmtree(left, ignore_errors=True)
