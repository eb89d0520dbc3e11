"""File names that come from outside: what they may reach."""
import os
from pathlib import Path

from ps_head_driver.errors import ErrorCode, PsError


def leads_out(folder: Path, name: str | Path) -> bool:
    """Whether a name leads out of a folder: absolute, with '..', or through a link."""
    try:
        # realpath, other than Path.resolve, takes a loop of links without complaint
        real = Path(os.path.realpath(folder / name))
        return not real.is_relative_to(os.path.realpath(folder))
    except ValueError:      # a zero byte in the name
        return True


def confined(folder: Path, name: str, field: str, code: ErrorCode) -> Path:
    """File that a request names, in the folder set aside for it.

    :param name: relative to the folder, or absolute and inside it.
    :param field: of the request, for the message.
    :raises PsError: ``code`` for an empty name and for one that leads out of the folder.
    """
    if not name:
        raise PsError(code, f'{field}: empty; give a file name')
    if leads_out(folder, name):
        raise PsError(code, f'{field}: {name!r} leaves the folder {folder}')
    return folder / name
