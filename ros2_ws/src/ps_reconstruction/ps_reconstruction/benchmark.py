"""The DiLiGenT benchmark: errors of least squares and STV, as the paper's Table 1 has them."""
from collections.abc import Iterator
from dataclasses import asdict, dataclass
import json
from pathlib import Path
import time

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.stack import Stack, Truth, angular_error_deg
from ps_head_driver.stack_folder import read_stack, select_lights
from ps_reconstruction.pipeline import METHODS, Options, reconstruct

# Paper, Table 1: mean, median, p90 of LS, then of STV, degrees; its light subset is not stated
PAPER = {
    'ballPNG': ((4.705, 3.108, 10.927), (3.451, 2.629, 6.536)),
    'catPNG': ((8.781, 6.990, 15.159), (8.020, 6.262, 13.330)),
    'pot1PNG': ((10.288, 8.419, 17.294), (9.401, 7.113, 15.691)),
    'bearPNG': ((9.154, 6.894, 18.023), (7.571, 5.517, 14.389)),
    'pot2PNG': ((16.708, 13.652, 33.520), (14.602, 11.564, 30.235)),
    'buddhaPNG': ((15.448, 11.202, 32.521), (14.466, 9.762, 31.896)),
    'gobletPNG': ((18.868, 16.321, 36.269), (17.339, 14.484, 32.952)),
    'cowPNG': ((26.794, 27.941, 43.464), (24.846, 25.195, 41.424)),
    'harvestPNG': ((31.568, 26.319, 60.882), (29.214, 22.509, 63.034)),
    'readingPNG': ((19.194, 11.305, 47.032), (15.212, 8.882, 38.373)),
}


@dataclass(frozen=True)
class Error:
    """Angular error over the mask, degrees; pixels without a normal count 90."""

    mean: float
    median: float
    p90: float

    @classmethod
    def of(cls, degrees: NDArray) -> 'Error':
        """Summary of the errors of all pixels of a mask; NaN is a missing normal."""
        values = np.where(np.isfinite(degrees), degrees, 90.0)
        return cls(float(np.mean(values)), float(np.median(values)),
                   float(np.percentile(values, 90)))


@dataclass(frozen=True)
class Result:
    """One object under one choice of lights.

    :param errors: by method, 'ls' and 'stv'.
    :param rank_correlation: Spearman's, between the confidence of STV and minus its error.
    :param seconds: by method, solving only, the first call included.
    """

    name: str
    subset: str
    lights: int
    errors: dict[str, Error]
    rank_correlation: float
    seconds: dict[str, float]
    paper: dict[str, Error] | None

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Maps:
    """Pictures of one object: normals and errors (H, W), degrees, by method; NaN outside."""

    truth: NDArray
    normal: dict[str, NDArray]
    error: dict[str, NDArray]


def find_objects(folder: Path) -> list[Path]:
    """Object folders (with pictures list and ground truth) in ``folder``, or itself.

    :raises PsError: RECONSTRUCTION_BAD_STACK if there is none.
    """
    candidates = [folder, *sorted(p for p in folder.glob('*') if p.is_dir())]
    found = [p for p in candidates if (p / 'filenames.txt').is_file()
             and any((p / name).is_file() for name in ('Normal_gt.mat', 'normal.txt'))]
    if not found:
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK,
                      f'{folder}: no object with filenames.txt and Normal_gt.mat or normal.txt; '
                      'FOLDER is the pmsData folder of DiLiGenT')
    return found


def subsets_of(folder: Path) -> list[str]:
    """'all' and the names that subsets.json, beside or above the object, lists for it."""
    for file in (folder / 'subsets.json', folder.parent / 'subsets.json'):
        if file.is_file():
            try:
                return ['all', *json.loads(file.read_text(encoding='utf-8')).get(folder.name, {})]
            except (AttributeError, ValueError) as error:
                raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK,
                              f'{file}: not a table of light subsets') from error
    return ['all']


def run(folder: Path, subsets: list[str] | None = None) -> Iterator[tuple[Result, Maps]]:
    """Evaluate one object for each subset of lights (by default all that there are)."""
    stack, truth = read_stack(folder)
    if truth is None:
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK, f'{folder}: no ground truth')
    for subset in subsets or subsets_of(folder):
        yield evaluate(select_lights(stack, subset, folder), truth, folder.name, subset)


def evaluate(stack: Stack, truth: Truth, name: str, subset: str) -> tuple[Result, Maps]:
    """Solve one stack with every method and compare it with its truth."""
    mask = np.isfinite(truth.normal[..., 2])
    if stack.mask is not None:
        mask &= stack.mask
    normals, maps, errors, seconds = {}, {}, {}, {}
    correlation = float('nan')
    for method in METHODS:
        start = time.perf_counter()
        result = reconstruct(stack, Options(method=method), outputs={'normal', 'confidence'})
        seconds[method] = time.perf_counter() - start
        degrees = angular_error_deg(result.normal, truth.normal)
        normals[method] = result.normal
        maps[method] = np.where(mask, degrees, np.nan)
        errors[method] = Error.of(degrees[mask])
        if method == 'stv' and result.confidence is not None:
            correlation = rank_correlation(result.confidence[mask], -degrees[mask])
    paper = PAPER.get(name)
    return Result(
        name, subset, len(stack.images), errors, correlation, seconds,
        None if paper is None else {m: Error(*v) for m, v in zip(METHODS, paper, strict=True)},
    ), Maps(truth.normal, normals, maps)


def rank_correlation(a: NDArray, b: NDArray) -> float:
    """Spearman's rank correlation of two samples; pairs with NaN are left out."""
    from scipy.stats import spearmanr
    good = np.isfinite(a) & np.isfinite(b)
    return float(spearmanr(a[good], b[good]).statistic) if good.sum() > 2 else float('nan')


def average(results: list[Result], method: str, paper: bool = False) -> Error | None:
    """Mean over objects of each column of the table; None if there is nothing to average."""
    sources = [result.paper if paper else result.errors for result in results]
    rows = [source[method] for source in sources if source is not None]
    if not rows:
        return None
    return Error(*(float(np.mean([getattr(row, column) for row in rows]))
                   for column in ('mean', 'median', 'p90')))
