"""Sessions to stack folders with an index, for learning and for other software."""
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ps_head_driver.conversions import message_to_stack
from ps_head_driver.stack import Stack
from ps_head_driver.stack_folder import write_stack
from ps_inspection.session_output import (
    IDENTITY_FIELDS,
    Outcome,
    claim,
    finish,
    identity,
    reason,
    stack_folder_name,
    whole_folder,
)
from ps_reconstruction.session_format import STACK_TYPE, stack_id_of
from ps_reconstruction.session_reader import Scan, Session, decode

INDEX_FIELDS = ('folder', *IDENTITY_FIELDS, 'images', 'width', 'height', 'files')


def export_session(session: Session, out: Path,
                   progress: Callable[[str], None] = lambda _: None) -> Outcome:
    """Write every stack as a stack folder, and index.csv with one row a stack.

    :param out: new or empty, or left by an interrupted export of the same session.
    :raises PsError: SESSION_BAD_REQUEST if ``out`` holds something else.
    :raises OSError: if the disk fails, as the cause of a PsError perhaps; a bad stack is reported
        and skipped.
    """
    claim(out, session)
    outcome, scan = Outcome(), Scan()
    rows: list[dict[str, Any]] = []
    for number, message in enumerate(session.stack_messages(scan)):
        name = stack_folder_name(number, stack_id_of(message.data))
        try:
            stack = message_to_stack(decode(message.data, STACK_TYPE))
            if (out / name).is_dir():
                outcome.skipped += 1
            else:
                with whole_folder(out / name) as part:
                    write_stack(stack, part)
                outcome.done += 1
            rows.append(_row(stack, out / name))
            progress(name)
        except Exception as error:      # a foreign or hostile stack can be wrong in any way
            if isinstance(error, OSError) or isinstance(error.__cause__, OSError):
                raise                   # the disk, not the stack
            outcome.failed[name] = reason(error)
            progress(f'{name}: {outcome.failed[name]}')
    finish(out, INDEX_FIELDS, rows)
    outcome.problems = scan.problems
    return outcome


def _row(stack: Stack, folder: Path) -> dict[str, Any]:
    height, width = stack.shape
    files = sorted(str(file.relative_to(folder)) for file in folder.rglob('*') if file.is_file())
    return {'folder': folder.name, **identity(stack), 'images': len(stack.images),
            'width': width, 'height': height, 'files': ' '.join(files)}
