"""What calibration files there are, and which of them can be used."""
from dataclasses import dataclass
from pathlib import Path

from ps_head_driver.calibration_file import HeadCalibration, read_calibration
from ps_head_driver.errors import ErrorCode, PsError


@dataclass(frozen=True)
class Entry:
    """One file of a folder of calibrations.

    :param calibration: None if the file is refused, and then
    :param reason: why.
    """

    path: Path
    calibration: HeadCalibration | None
    reason: str = ''

    @property
    def text(self) -> str:
        """One line for people."""
        made = self.calibration
        if made is None:
            return f'{self.path.name}  refused: {self.reason}'
        return (f'{self.path.name}  {made.verdict}  {made.calibration_id}  '
                f'{made.created:%Y-%m-%d %H:%M}  head {made.head_serial or "?"}  '
                f'target {made.target_name or "?"}')


def list_calibrations(folder: Path) -> list[Entry]:
    """The folder's YAML files, newest calibration first, refused ones last.

    :raises PsError: CALIBRATION_FILE_NOT_FOUND if there is no such folder.
    """
    if not folder.is_dir():
        raise PsError(ErrorCode.CALIBRATION_FILE_NOT_FOUND, f'{folder}: no such folder')
    good, refused = [], []
    for path in sorted(folder.glob('*.yaml')):
        try:
            good.append(Entry(path, read_calibration(path)))
        except PsError as error:
            refused.append(Entry(path, None, error.message.removeprefix(f'{path}: ')))
    good.sort(key=lambda entry: entry.calibration.created,  # type: ignore[union-attr]
              reverse=True)
    return good + refused
