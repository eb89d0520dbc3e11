"""The demo: one part through the whole cell, from homing to a report.

Uses only the public interfaces of a cell that it starts itself. With fake hardware the part is
rendered, so its true shape is
known and the result is measured against it; with an input folder real pictures go through the same
graph.
"""
from collections.abc import Callable
from dataclasses import dataclass, field
import json
import os
from pathlib import Path
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.conversions import message_to_image, message_to_stack
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.fake.renderer import make_renderer
from ps_head_driver.frames import optical_to_plane
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_head_driver.stack import Geometry, Stack, angular_error_deg
from ps_inspection.cell_client import CellClient
from ps_inspection.height_view import colours, relief, script
from ps_inspection.runner import Cell
from ps_interfaces import msg as ps
from ps_interfaces import srv
from ps_reconstruction.html_report import data_uri, png_bytes, render_page, shrink
from ps_reconstruction.integration import remove_plane
from ps_reconstruction.preview import height_view, normal_preview, slope_preview
from ps_reconstruction.session_reader import Session

OUTPUTS = ('slope', 'normal', 'albedo', 'height', 'shape', 'confidence')

# what a healthy demo must reach on the rendered disc; the figures it does reach are in the report
LARGEST_MEDIAN_ERROR_DEG = 3.0
SMALLEST_VALID_FRACTION = 0.9


CAPTIONS = {
    'shape': 'Raised bright, sunk dark.',
    'normal': 'Red to the right, green up, blue to the viewer.',
    'slope': 'Hue is the direction, strength the steepness.',
    'albedo': 'What remains when the light is taken out.',
    'confidence': 'White where all lights agree.',
    'normal_error': 'Angle to the true normal, from black at 0 to white at 5 degrees.',
}


@dataclass
class DemoOptions:
    """What the demo does.

    :param convergence_radius: CR to set, m.
    :param input_folder: real pictures; None: the rendered scene.
    """

    out: Path
    scene: str = 'disc'
    input_folder: Path | None = None
    convergence_radius: float = 0.060
    # its own: the demo must never meet a real head that is running under the default name
    namespace: str = field(default_factory=lambda: f'ps_demo_{os.getpid()}')


@dataclass
class DemoResult:
    """What came out: files and figures, for the report and for --json."""

    files: dict[str, str] = field(default_factory=dict)
    timings_s: dict[str, float] = field(default_factory=dict)
    error_deg: dict[str, float] | None = None
    height_error_m: dict[str, float] | None = None
    setting: dict[str, Any] = field(default_factory=dict)
    valid_fraction: float = float('nan')
    residual_rms: float = float('nan')
    wrong: list[str] = field(default_factory=list)


def run(options: DemoOptions, progress: Callable[[str], None]) -> DemoResult:
    """Run the demo and write its folder.

    :param progress: called with a line at the start of each step.
    :raises PsError: if a step fails; figures beyond their limits are in ``DemoResult.wrong``.
    """
    options.out.mkdir(parents=True, exist_ok=True)
    result = DemoResult()
    arguments = {
        'fake_hardware': 'true', 'namespace': options.namespace,
        'session_folder': str(options.out / 'sessions')}
    if options.input_folder:
        arguments |= {'camera': 'folder', 'input_folder': str(options.input_folder.absolute())}
    else:
        arguments |= {'camera': 'fake', 'scene': options.scene}

    def step(name: str) -> 'Stopwatch':
        progress(name)
        return Stopwatch(result.timings_s, name)

    cell = Cell(arguments, log_folder=options.out / 'logs')
    try:
        with step('start the cell'):
            cell.start()
        with CellClient(options.namespace, OUTPUTS) as client:
            stack_message, info, images = _inspect(client, options, result, step)
        cell.check()
    finally:
        with step('stop the cell'):
            unclean = cell.stop()
    if unclean:
        result.wrong.append(f'did not stop cleanly: {", ".join(unclean)}')

    progress('write pictures and report')
    _write(options, result, stack_message, info, images)
    return result


class Stopwatch:
    """Adds the time inside a ``with`` block to a table."""

    def __init__(self, table: dict[str, float], name: str) -> None:
        self._table, self._name = table, name

    def __enter__(self) -> None:
        self._start = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._table[self._name] = time.monotonic() - self._start


def _inspect(
    client: CellClient, options: DemoOptions, result: DemoResult,
    step: Callable[[str], Stopwatch],
) -> tuple[ps.PhotometricStack, ps.ReconstructionInfo, dict[str, NDArray]]:
    with step('home the motor'):
        client.home()
        client.wait_for_outputs()
    with step('solve the convergence radius'):
        solution = client.solve(options.convergence_radius)
    with step('move the panels'):
        reached = client.illuminate(options.convergence_radius)
    with step('start recording'):
        session = client.call(srv.StartSession, 'session/start', srv.StartSession.Request(
            name='demo', part_id='demo-part', notes='written by the demo'))
    with step('capture' if options.input_folder else 'capture, rendering of the scene included'):
        begin = time.monotonic()
        stack_id = client.capture(part_id='demo-part')
        stack = client.stack(stack_id)
    with step('reconstruct'):
        info, messages = client.reconstruction(stack_id)
    with step('stop recording'):
        stopped = client.call(srv.StopSession, 'session/stop')

    arrived = client.stacks[stack_id][1]
    stamp = (info.header.stamp.sec, info.header.stamp.nanosec)
    result.timings_s |= {
        'request to acquisition_done': client.done[stack_id][1] - begin,
        'stack received to slope image received': client.images['slope'][stamp][1] - arrived,
        'stack received to last image received':
            max(by_stamp[stamp][1] for by_stamp in client.images.values()) - arrived,
        **{f'reconstruction: {d.stage}': d.duration for d in info.durations}}
    result.setting = {
        'convergence radius asked, mm': solution.convergence_radius * 1e3,
        'convergence radius reached, mm': reached.convergence_radius * 1e3,
        'tilt, deg': float(np.degrees(reached.tilt)),
        'motor, counts': reached.motor_counts,
        'light height h, mm': reached.light_height * 1e3,
        'method': info.method, 'light geometry': ('nominal', 'calibrated', 'assumed')[
            info.geometry],
        'stacks recorded': int(stopped.stacks)}
    result.valid_fraction = info.valid_fraction
    result.residual_rms = info.residual_rms
    if sum(1 for _ in Session(session.uri).stacks()) != 1:
        result.wrong.append(f'the session {session.uri} does not hold the one stack')
    result.files['session'] = session.uri
    return stack, info, {name: message_to_image(image) for name, image in messages.items()}


# ---------------------------------------------------------------------------- results

def _write(
    options: DemoOptions, result: DemoResult, message: ps.PhotometricStack,
    info: ps.ReconstructionInfo, images: dict[str, NDArray],
) -> None:
    stack = message_to_stack(message)
    normal = optical_to_plane(images['normal'])
    pitch, metric = _pixel_pitch(stack), stack.geometry is not Geometry.ASSUMED
    height = height_view(images['height'], pitch, metric=metric)
    pictures = {
        'shape': images['shape'], 'normal': normal_preview(normal),
        'slope': slope_preview(images['slope']), 'height': height,
        'albedo': _to_byte(images['albedo']), 'confidence': images['confidence']}
    if options.input_folder is None:
        pictures['normal_error'] = _measure(options, result, normal, images['height'], stack)
    if result.valid_fraction < SMALLEST_VALID_FRACTION:
        result.wrong.append(f'only {result.valid_fraction:.1%} of the pixels are valid')

    entries = []
    for name, picture in pictures.items():
        path = options.out / f'{name}.png'
        path.write_bytes(png_bytes(picture))
        result.files[name] = str(path)
        if name != 'height':        # the page has it as a solid that can be turned
            entries.append({'name': name.replace('_', ' ').capitalize(), 'caption': CAPTIONS[name],
                            'uri': data_uri(png_bytes(shrink(picture, 900)))})
    frames = [{'name': light.name, 'uri': data_uri(png_bytes(shrink(_to_byte(image), 420)))}
              for light, image in zip(stack.lights, stack.images, strict=True)]

    solid = relief(images['height'], images['shape'], pitch, metric)
    report = options.out / 'report.html'
    source = str(options.input_folder or f'rendered scene: {options.scene}')
    render_page('ps_inspection', 'demo.html', report, title='Photometric stereo inspection',
                subtitle=f'{source}; stack {info.stack_id}', pictures=entries, frames=frames,
                tables=_tables(result), reliefs=[{'name': info.part_id, 'stack_id': '', **solid}]
                if solid else [], colours=colours(), script=script('height_view.js'))
    result.files['report'] = str(report)
    (options.out / 'results.json').write_text(json.dumps(vars(result), indent=2))


def _measure(
    options: DemoOptions, result: DemoResult, normal: NDArray, height: NDArray, stack: Stack,
) -> NDArray:
    """Compare with the rendered truth; returns a picture of the angular error."""
    head = load_head(nominal_head_path())
    if stack.camera is not None:
        head = head.model_copy(update={'camera': stack.camera})
    true = make_renderer(options.scene, head).truth()
    error = angular_error_deg(normal, true.normal)
    result.error_deg = _statistics(error)
    if true.height is not None:
        offset = np.abs(remove_plane(height - true.height))
        result.height_error_m = _statistics(offset)
    if not result.error_deg['median'] <= LARGEST_MEDIAN_ERROR_DEG:
        result.wrong.append(f'median normal error {result.error_deg["median"]:.2f} deg is above '
                            f'{LARGEST_MEDIAN_ERROR_DEG} deg')
    return (np.clip(np.nan_to_num(error, nan=5.0) / 5.0, 0, 1) * 255).astype(np.uint8)


def _statistics(values: NDArray) -> dict[str, float]:
    known = values[np.isfinite(values)]
    if known.size == 0:
        raise PsError(ErrorCode.RECONSTRUCTION_INTERNAL, 'nothing was reconstructed')
    return {'mean': float(known.mean()), 'median': float(np.median(known)),
            'p90': float(np.percentile(known, 90))}


def _pixel_pitch(stack: Stack) -> float:
    """Metres per pixel on the plane; 1 where the camera is not known."""
    return stack.camera.camera_standoff / stack.camera.fx if stack.camera else 1.0


def _to_byte(image: NDArray) -> NDArray:
    """For looking: the 99.5th percentile becomes white."""
    values = np.nan_to_num(np.asarray(image, np.float32))
    white = float(np.percentile(values, 99.5)) or 1.0
    return (np.clip(values / white, 0, 1) * 255).astype(np.uint8)


def _tables(result: DemoResult) -> list[dict[str, Any]]:
    def text(value: Any) -> str:
        return f'{value:.3g}' if isinstance(value, float) else str(value)

    tables = [
        {'caption': 'Setting', 'rows': [(k, text(v)) for k, v in result.setting.items()]},
        {'caption': 'Times, first stack after the start', 'rows': [
            (k, f'{v * 1e3:.1f} ms' if v < 1 else f'{v:.2f} s')
            for k, v in result.timings_s.items()]}]
    quality = [('valid pixels', f'{result.valid_fraction:.1%}'),
               ('residual, relative', f'{result.residual_rms:.2%}')]
    if result.error_deg:
        quality += [(f'normal error, {k}', f'{v:.2f}°') for k, v in result.error_deg.items()]
    if result.height_error_m:
        quality += [(f'height error, {k}', f'{v * 1e6:.1f} µm')
                    for k, v in result.height_error_m.items()]
    quality += [('checks', '; '.join(result.wrong) if result.wrong else 'all passed')]
    tables.insert(1, {'caption': 'Against the truth' if result.error_deg else 'Quality',
                      'rows': quality})
    return tables
