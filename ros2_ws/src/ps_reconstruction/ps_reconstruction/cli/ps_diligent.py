"""ps_diligent: the paper's Table 1 over the DiLiGenT objects of a folder."""
import argparse
import json
from pathlib import Path
import sys

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ps_head_driver.errors import PsError
from ps_reconstruction.benchmark import Error, Maps, Result, average, find_objects, run
from ps_reconstruction.pipeline import METHODS

ERROR_SCALE = 30.0      # degrees, brightest in the error maps
WIDTH = 110             # columns, so that the table is not broken where there is no terminal


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    options = _parser().parse_args(arguments)
    console = Console(highlight=False, markup=False)
    console = Console(highlight=False, markup=False, width=max(console.width, WIDTH))
    results: list[Result] = []
    try:
        for folder in find_objects(options.folder):
            for result, maps in run(folder, options.lights):
                results.append(result)
                if options.figures:
                    write_figure(result, maps, options.figures)
                console.print(f'{result.name}, {result.lights} lights: done', style='dim')
        if options.json:
            options.json.write_text(json.dumps(report(results), indent=1), encoding='utf-8')
    except (PsError, OSError) as error:
        print(f'ps_diligent: {getattr(error, "message", error)}', file=sys.stderr)
        return 1
    for subset in dict.fromkeys(result.subset for result in results):
        console.print(table([r for r in results if r.subset == subset], subset))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='ps_diligent', description="Print the paper's Table 1: angular errors of LS and STV.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='example:\n  ps_diligent DiLiGenT/pmsData --figures out --json table.json')
    parser.add_argument('folder', type=Path, metavar='FOLDER',
                        help='folder with the objects, or one object')
    parser.add_argument('--lights', action='append', metavar='SET',
                        help='all, a name in subsets.json or 1-based indices; may be repeated '
                             '(default: all and every subset)')
    parser.add_argument('--figures', type=Path, metavar='DIR',
                        help='write normal and error maps of each object')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the figures as JSON')
    return parser


def table(results: list[Result], subset: str) -> Table:
    """One table: an object a row, this software and the paper side by side, and the average."""
    counts = sorted({result.lights for result in results})
    lights = ', '.join(map(str, counts))
    out = Table('object', title=f'Angular error in degrees, mean / median / p90; {subset}: '
                                f'{lights} lights')
    for column in ('LS', 'STV', 'paper LS', 'paper STV'):
        out.add_column(column, justify='right')
    for result in results:
        paper = result.paper or {}
        out.add_row(result.name, *(_cell(result.errors[m]) for m in METHODS),
                    *(_cell(paper.get(m)) for m in METHODS))
    out.add_section()
    out.add_row('average', *(_cell(average(results, m)) for m in METHODS),
                *(_cell(average(results, m, paper=True)) for m in METHODS))
    return out


def _cell(error: Error | None) -> str:
    if error is None:
        return '-'
    return f'{error.mean:.3f} / {error.median:.3f} / {error.p90:.3f}'


def report(results: list[Result]) -> dict[str, object]:
    """What --json writes: the objects, and the averages by subset and method."""
    averages = {}
    for subset in dict.fromkeys(result.subset for result in results):
        chosen = [result for result in results if result.subset == subset]
        averages[subset] = {method: vars(mean) for method in METHODS
                            if (mean := average(chosen, method)) is not None}
    return {'objects': [result.as_dict() for result in results], 'average': averages}


def write_figure(result: Result, maps: Maps, folder: Path) -> Path:
    """Write true, LS and STV normals above the error maps; returns the file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f'{result.name}_{result.lights}.png'
    if not cv2.imwrite(str(path), np.ascontiguousarray(figure_of(result, maps)[..., ::-1])):
        raise OSError(f'{path} cannot be written')
    return path


def figure_of(result: Result, maps: Maps, picture: NDArray | None = None) -> NDArray[np.uint8]:
    """True, LS and STV normals above the error maps, as RGB.

    :param picture: one of the frames, to be shown below the true normals.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    height, width = maps.truth.shape[:2]
    figure = Figure(figsize=(9.6, 0.7 + 6.2 * height / width), layout='constrained')
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    figure.suptitle(f'{result.name}, {result.lights} lights')
    panels = {'truth': maps.truth, 'LS': maps.normal['ls'], 'STV': maps.normal['stv']}
    outside = np.isnan(maps.error['ls']) & np.isnan(maps.error['stv'])
    for axis, (title, normal) in zip(axes[0], panels.items(), strict=True):
        colours = np.nan_to_num(np.clip((normal + 1) / 2, 0, 1))
        colours[outside] = 1
        axis.imshow(colours)
        axis.set_title(title)
    if picture is not None:
        axes[1, 0].imshow(picture, cmap='gray')
        axes[1, 0].set_title('one of the pictures', fontsize='medium')
    drawn = None
    for axis, method in zip(axes[1, 1:], METHODS, strict=True):
        drawn = axis.imshow(maps.error[method], vmin=0, vmax=ERROR_SCALE, cmap='inferno')
        error = result.errors[method]
        axis.set_title(f'mean {error.mean:.2f}°, p90 {error.p90:.2f}°', fontsize='medium')
    for axis in axes.flat:
        axis.set_axis_off()
    assert drawn is not None
    figure.colorbar(drawn, ax=axes[1, 0], location='left', label='angular error in degrees',
                    fraction=0.1)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


if __name__ == '__main__':
    sys.exit(main())
