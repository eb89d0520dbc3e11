"""Sessions to files: stack folders with an index for learning, and reconstructions."""
from collections.abc import Callable, Iterator
import csv
from dataclasses import dataclass, field
import math
from pathlib import Path
import re
import shutil
from typing import Any

import numpy as np

from ps_head_driver.conversions import message_to_stack
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack
from ps_head_driver.stack_folder import write_stack
from ps_reconstruction.pipeline import Options, Reconstruction, reconstruct
from ps_reconstruction.session_reader import Scan, Session

INDEX_FIELDS = (
    'folder', 'stack_id', 'part_id', 'session_id', 'stamp_ns', 'calibration_id', 'geometry',
    'convergence_radius_m', 'light_height_m', 'images', 'width', 'height',
    'pose_frame', 'pose_x', 'pose_y', 'pose_z', 'pose_qx', 'pose_qy', 'pose_qz', 'pose_qw')


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


def export_session(session: Session, out: Path,
                   progress: Callable[[str], None] = lambda _: None) -> Outcome:
    """Write every stack as a stack folder, and index.csv with one row a stack.

    :param out: new or empty, or left by an interrupted export of the same session.
    :raises PsError: SESSION_BAD_REQUEST if ``out`` holds something else.
    """
    rows: list[dict[str, Any]] = []

    def export(stack: Stack, folder: Path) -> None:
        write_stack(stack, folder)

    outcome = _each_stack(session, out, export, progress,
                          lambda stack, name: rows.append(_row(stack, name)))
    with (out / 'index.csv').open('w', newline='', encoding='utf-8') as stream:
        writer = csv.DictWriter(stream, INDEX_FIELDS)
        writer.writeheader()
        writer.writerows(rows)
    return outcome


def reconstruct_session(session: Session, out: Path, options: Options,
                        progress: Callable[[str], None] = lambda _: None) -> Outcome:
    """Reconstruct every stack into ``<out>/<stack>/result.npz``; a bad stack is skipped.

    :param out: new or empty, or left by an interrupted run: what is done is not done again.
    :raises PsError: SESSION_BAD_REQUEST if ``out`` holds something else.
    """
    def process(stack: Stack, folder: Path) -> None:
        folder.mkdir()
        _save(reconstruct(stack, options), folder / 'result.npz')

    return _each_stack(session, out, process, progress)


def stack_folder_name(number: int, stack: Stack) -> str:
    """Name that sorts in order of capture and cannot leave the output folder."""
    return f'{number:06d}_' + (re.sub(r'[^A-Za-z0-9_-]', '_', stack.stack_id)[:60] or 'stack')


def _each_stack(
    session: Session, out: Path, action: Callable[[Stack, Path], None],
    progress: Callable[[str], None], on_stack: Callable[[Stack, str], None] = lambda *_: None,
) -> Outcome:
    _claim(out, session)
    outcome, scan = Outcome(), Scan()
    for number, stack in enumerate(_stacks(session, scan, outcome)):
        name = stack_folder_name(number, stack)
        unfinished = out / f'{name}.part'
        if (out / name).is_dir():
            outcome.skipped += 1
        else:
            shutil.rmtree(unfinished, ignore_errors=True)
            try:
                action(stack, unfinished)
                unfinished.rename(out / name)
                outcome.done += 1
            except OSError:
                raise                       # the disk, not the stack
            except Exception as error:
                shutil.rmtree(unfinished, ignore_errors=True)
                reason = error.message if isinstance(error, PsError) else (
                    f'{type(error).__name__}: {error}')
                outcome.failed[name] = reason
                progress(f'{name}: {reason}')
                continue
        on_stack(stack, name)
        progress(name)
    outcome.problems = scan.problems
    return outcome


def _stacks(session: Session, scan: Scan, outcome: Outcome) -> Iterator[Stack]:
    for number, message in enumerate(session.stacks(scan)):
        try:
            stack = message_to_stack(message)
        except Exception as error:      # a foreign or hostile message can be wrong in any way
            outcome.failed[f'{number:06d}'] = f'no valid stack: {type(error).__name__}: {error}'
        else:
            yield stack


def _claim(out: Path, session: Session) -> None:
    """Make ``out`` the output folder of this session, and of no other."""
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


def _row(stack: Stack, name: str) -> dict[str, Any]:
    height, width = stack.shape
    pose = dict(zip(
        ('pose_x', 'pose_y', 'pose_z', 'pose_qx', 'pose_qy', 'pose_qz', 'pose_qw'),
        (*stack.head_pose.position, *stack.head_pose.quaternion), strict=True))
    return {
        'folder': name, 'stack_id': stack.stack_id, 'part_id': stack.part_id,
        'session_id': stack.session_id, 'stamp_ns': stack.stamp_ns,
        'calibration_id': stack.calibration_id, 'geometry': stack.geometry.name,
        'convergence_radius_m': _known(stack.convergence_radius),
        'light_height_m': _known(stack.light_height), 'images': len(stack.images),
        'width': width, 'height': height, 'pose_frame': stack.head_pose.frame_id, **pose}


def _known(value: float) -> float | str:
    return value if math.isfinite(value) else ''


def _save(result: Reconstruction, path: Path) -> None:
    arrays = {name: getattr(result, name) for name in (
        'normal', 'slope', 'albedo', 'height', 'shape', 'confidence', 'mask')}
    np.savez_compressed(path, **{name: a for name, a in arrays.items() if a is not None})
