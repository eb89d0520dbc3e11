"""A session as one HTML page to look at: works offline, needs nothing but a browser."""
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from operator import itemgetter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.conversions import message_to_stack
from ps_inspection.height_view import colours, relief, script
from ps_inspection.session_output import reason
from ps_inspection.session_reconstruct import figures, recorded_options
from ps_inspection.session_summary import Entry, Event, Summary, summarize
from ps_reconstruction.html_report import data_uri, render_page, shrink
from ps_reconstruction.pipeline import Options, reconstruct
from ps_reconstruction.preview import normal_preview
from ps_reconstruction.session_format import STACK_TYPE, error_of
from ps_reconstruction.session_reader import Session, decode

PICTURE_WIDTH = 800
JPEG_QUALITY = 88
OUTPUTS = {'normal', 'height', 'shape', 'roughness'}
MICRO, MILLI = 1e6, 1e3


@dataclass(frozen=True)
class ReportOutcome:
    """What went into a report.

    :param failed: stack_id to the reason why it has no pictures.
    """

    stacks: int
    pictures: int
    faults: int
    failed: dict[str, str]
    problems: list[str]


def write_report(session: Session, path: Path, pictures: int = 60,
                 progress: Callable[[str], None] = lambda _: None) -> ReportOutcome:
    """Write the report of a session.

    :param pictures: stacks that are reconstructed and shown, evenly chosen if there are more; the
        tables have all.
    :raises PsError: SESSION_* if the session cannot be read or the file not be written.
    """
    summary = summarize(session)
    options = recorded_options(summary.scan)
    chosen = _evenly(summary.entries, pictures)
    parts, failed = [], {}
    for number, entry in enumerate(chosen, 1):
        try:
            parts.append(_part(session, entry, options))
            progress(f'{number}/{len(chosen)} {entry.facts["stack_id"]}')
        except Exception as error:      # a foreign or hostile stack can be wrong in any way
            failed[entry.facts['stack_id']] = reason(error)
            parts.append({**_caption(entry, entry.result), 'error': reason(error), 'relief': None})
            progress(f'{number}/{len(chosen)} {entry.facts["stack_id"]}: {reason(error)}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        render_page('ps_inspection', 'session.html', path, **_content(summary, parts, session),
                    script=script('height_view.js', 'session.js'))
    except OSError as error:
        raise error_of(error, path) from error
    return ReportOutcome(len(summary.entries), len(parts) - len(failed),
                         sum(event.kind == 'fault' for event in summary.events), failed,
                         summary.scan.problems)


def _evenly(entries: Sequence[Entry], most: int) -> list[Entry]:
    if len(entries) <= most:
        return list(entries)
    return [entries[i] for i in np.linspace(0, len(entries) - 1, most).round().astype(int)]


# ---------------------------------------------------------------------------- one part

def _part(session: Session, entry: Entry, options: Options) -> dict[str, Any]:
    """Pictures and figures of one stack."""
    stack = message_to_stack(decode(session.read(entry.place), STACK_TYPE))
    result = reconstruct(stack, options, OUTPUTS)
    assert result.shape is not None
    assert result.height is not None
    return {
        **_caption(entry, entry.result or {}, figures(result)), 'error': '',
        'shape': _jpeg(result.shape), 'normal': _jpeg(normal_preview(result.normal)),
        'relief': relief(result.height, result.shape, result.pixel_pitch, result.metric)}


def _caption(entry: Entry, *results: dict[str, Any] | None) -> dict[str, Any]:
    """What is said of a stack: figures of the first result that has them."""
    def figure(name: str, factor: float = 1.0) -> float | None:
        values = (result.get(name) for result in results if result)
        return next((value * factor for value in values if value is not None), None)

    facts = entry.facts
    cr = facts['convergence_radius_m']
    return {
        'part': entry.name, 'stack_id': facts['stack_id'],
        'time': entry.received, 'cr_mm': None if cr is None else cr * MILLI,
        'position_mm': [facts[f'pose_{axis}'] * MILLI for axis in 'xyz'],
        'frame': facts['pose_frame'], 'calibration_id': facts['calibration_id'],
        'lights': ' '.join(entry.lights), 'sa_um': figure('sa', MICRO),
        'sq_um': figure('sq', MICRO), 'valid': figure('valid_fraction')}


def _jpeg(image: NDArray[np.uint8]) -> str:
    image = shrink(image, PICTURE_WIDTH)
    if image.ndim == 3:
        image = image[..., ::-1]
    _, data = cv2.imencode('.jpg', np.ascontiguousarray(image),
                           [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data_uri(data.tobytes(), 'jpeg')


# ---------------------------------------------------------------------------- the whole

def _content(summary: Summary, parts: list[dict[str, Any]], session: Session) -> dict[str, Any]:
    entries, scan = summary.entries, summary.scan
    about = scan.metadata.get('session', {})
    results = [entry.result for entry in entries if entry.result]
    faults = sum(event.kind == 'fault' for event in summary.events)
    waits = [entry.reconstructed - entry.acquired for entry in entries
             if entry.reconstructed is not None and entry.acquired is not None]
    start = datetime.fromtimestamp(summary.start_ns * 1e-9).astimezone()
    return {
        'title': about.get('session_id') or session.folder.name, 'about': about,
        'start': f'{start:%d %B %Y, %H:%M:%S}', 'duration': _clock(summary.duration),
        'tiles': [
            _counted(len({entry.name for entry in entries}), 'part'),
            _counted(len(entries), 'stack'), _counted(faults, 'fault'),
            ('valid pixels, median', _median(
                [r['valid_fraction'] * 100 for r in results], '{:.1f} %')),
            ('last exposure to result, median', _median(waits, '{:.2f} s'))],
        'faults': faults, 'parts': parts, 'left_out': len(entries) - len(parts),
        'roughness': _columns(parts, [('Sa', itemgetter('sa_um')), ('Sq', itemgetter('sq_um'))]),
        'rows': [_caption(entry, entry.result) for entry in entries],
        'timings': _timings(entries), 'timeline': _timeline(summary),
        'events': [_event(event) for event in summary.events],
        'calibrations': summary.calibrations,
        'parameters': {name.removeprefix('parameters/'): values
                       for name, values in sorted(scan.metadata.items())
                       if name.startswith('parameters/')},
        'problems': scan.problems, 'complete': scan.complete,
        'size_mb': session.file.stat().st_size / 1e6, 'messages': summary.messages,
        'compression': scan.compression, 'reliefs': [
            {'name': part['part'], 'stack_id': part['stack_id'], **part['relief']}
            for part in parts if part.get('relief')],
        'colours': colours()}


def _timings(entries: Sequence[Entry]) -> dict[str, Any]:
    """Seconds of every stage of the reconstructions."""
    timed = [(entry, entry.result['durations']) for entry in entries if entry.result]
    stages = list(dict.fromkeys(stage for _, durations in timed for stage in durations))
    rows = []
    for stage in stages:
        values = np.array([durations.get(stage, 0.0) for _, durations in timed]) * MILLI
        rows.append((stage, float(np.median(values)), float(values.max())))
    chart = _columns(
        [{'part': entry.name,
          **{stage: durations.get(stage, 0.0) * MILLI for stage in stages}}
         for entry, durations in timed],
        [(stage, itemgetter(stage)) for stage in stages], stacked=True)
    return {'rows': sorted(rows, key=lambda row: -row[1]), 'chart': chart}


def _columns(rows: Sequence[dict[str, Any]],
             series: Sequence[tuple[str, Callable[[dict[str, Any]], float | None]]],
             stacked: bool = False) -> dict[str, Any]:
    """A column chart: the share of its full scale that every value of every row takes."""
    values = [[value(row) or 0.0 for _, value in series] for row in rows]
    tops = [sum(row) if stacked else max(row) for row in values] if series else []
    full = _round_up(max(tops, default=0.0))
    return {
        'series': [name for name, _ in series], 'full': full, 'half': full / 2,
        'stacked': stacked,
        'columns': [{'name': row['part'], 'values': own, 'shares': [v / full for v in own]}
                    for row, own in zip(rows, values, strict=True)] if any(tops) else []}


def _round_up(value: float) -> float:
    """A round number that is not less, by a half at most; 1 for 0."""
    if value <= 0:
        return 1.0
    power = 10 ** np.floor(np.log10(value))
    return float(next(m * power for m in (1, 1.2, 1.5, 2, 3, 4, 6, 8, 10)
                      if m * power >= value * 0.999))


def _timeline(summary: Summary) -> dict[str, Any]:
    """Shares of the duration at which things happened."""
    whole = summary.duration or 1.0
    begins = [begin for begin, _ in summary.states]
    return {
        'states': [{'left': begin / whole, 'width': (end - begin) / whole, 'name': state}
                   for (begin, state), end in zip(
                       summary.states, [*begins[1:], whole], strict=False)],
        'stacks': [{'left': entry.received / whole, 'name': entry.name}
                   for entry in summary.entries],
        'events': [{'left': event.time / whole, **_event(event)} for event in summary.events],
        'ticks': [{'left': share, 'name': _clock(share * whole)}
                  for share in (0, 0.25, 0.5, 0.75, 1)]}


def _event(event: Event) -> dict[str, Any]:
    return {'time': _clock(event.time), 'kind': event.kind, 'source': event.source,
            'text': event.text}


def _counted(count: int, noun: str) -> tuple[str, str]:
    return (noun if count == 1 else f'{noun}s'), str(count)


def _median(values: Sequence[float], form: str) -> str:
    return form.format(float(np.median(values))) if len(values) else '–'


def _clock(seconds: float) -> str:
    """As in 3.4 s, 2:03.4 min or 1:02:03 h."""
    tenths = round(seconds * 10)
    if tenths < 600:
        return f'{tenths / 10:.1f} s'
    if tenths < 36000:
        return f'{tenths // 600}:{tenths % 600 / 10:04.1f} min'
    return f'{tenths // 36000}:{tenths // 600 % 60:02d}:{tenths % 600 // 10:02d} h'
