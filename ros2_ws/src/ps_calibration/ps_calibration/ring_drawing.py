"""Drawings of the target as SVG at 1:1: one with dimensions, and the sheet of dots to print."""
from html import escape
import math

import numpy as np
from numpy.typing import NDArray

from ps_calibration.ring_mesh import outlines
from ps_calibration.ring_target import RingTarget

_MM = 1e3
_STYLE = ('text{font-family:sans-serif;font-size:3px;fill:#000}.small{font-size:2.2px}'
          '.big{font-size:5px}.part{fill:#e4e4e4;stroke:#000;stroke-width:.3}'
          '.plate{fill:#fff;stroke:#000;stroke-width:.3}.dot{fill:#000}'
          '.place{fill:none;stroke:#bbb;stroke-width:.1}'
          '.dim{stroke:#06c;stroke-width:.18;fill:none}.dimtext{fill:#06c}'
          '.axis{stroke:#888;stroke-width:.13;stroke-dasharray:3 1 .6 1}')
_ARROW = ('<marker id="a" viewBox="0 0 10 10" refX="10" refY="5" markerWidth="9" markerHeight="9" '
          'orient="auto-start-reverse"><path d="M0,2 L10,5 L0,8z" fill="#06c"/></marker>')


class _View:
    """Draws points of the target frame (mm, y up) at a place of the sheet."""

    def __init__(self, x: float, y: float, scale: float) -> None:
        self.x, self.y, self.scale = x, y, scale

    def at(self, point: tuple[float, float] | NDArray) -> tuple[float, float]:
        """Place on the sheet, mm."""
        return self.x + self.scale * float(point[0]), self.y - self.scale * float(point[1])

    def polygon(self, points: NDArray, kind: str) -> str:
        """Closed outline of points in mm."""
        path = ' '.join('{:.3f},{:.3f}'.format(*self.at(point)) for point in points)
        return f'<polygon class="{kind}" points="{path}"/>'

    def dimension(self, start: tuple[float, float], end: tuple[float, float], offset: float,
                  text: str) -> str:
        """Dimension line beside start-end; the offset (mm on the sheet) is to its left."""
        a, b = np.array(self.at(start)), np.array(self.at(end))
        along = (b - a) / np.linalg.norm(b - a)
        left = np.array([along[1], -along[0]])
        c, d = a + offset * left, b + offset * left
        beyond = math.copysign(1.0, offset) * left
        lines = [_segment(a, c + beyond), _segment(b, d + beyond), _segment(c, d, arrows=True)]
        angle = math.degrees(math.atan2(along[1], along[0]))
        if not -90.1 < angle < 89.9:        # to be read from below or from the right
            angle += 180
        turned = math.radians(angle)
        place = (c + d) / 2 + [math.sin(turned), -math.cos(turned)]
        return ''.join(lines) + (
            f'<text class="dimtext" text-anchor="middle" transform="translate({place[0]:.2f},'
            f'{place[1]:.2f}) rotate({angle:.1f})">{escape(text)}</text>')

    def leader(self, point: tuple[float, float], to: tuple[float, float], text: str) -> str:
        """Arrow to a point, with text at its other end."""
        tip, end = np.array(self.at(point)), np.array(self.at(to))
        anchor = 'start' if end[0] >= tip[0] else 'end'
        shift = 1 if anchor == 'start' else -1
        return _segment(end, tip, arrow=True) + (
            f'<text class="dimtext" text-anchor="{anchor}" x="{end[0] + shift:.2f}" '
            f'y="{end[1] + 1:.2f}">{escape(text)}</text>')


def _segment(a: NDArray, b: NDArray, arrows: bool = False, arrow: bool = False) -> str:
    ends = ' marker-start="url(#a)"' if arrows else ''
    ends += ' marker-end="url(#a)"' if arrows or arrow else ''
    return (f'<line class="dim" x1="{a[0]:.2f}" y1="{a[1]:.2f}" x2="{b[0]:.2f}" '
            f'y2="{b[1]:.2f}"{ends}/>')


def _text(x: float, y: float, text: str, kind: str = '') -> str:
    return f'<text class="{kind}" x="{x:.2f}" y="{y:.2f}">{escape(text)}</text>'


def _number(metres: float) -> str:
    return f'{metres * _MM:.3f}'.rstrip('0').rstrip('.')


def _sheet(width: float, height: float, title: str, body: list[str]) -> str:
    return (f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
            f'viewBox="0 0 {width:g} {height:g}"><title>{escape(title)}</title>'
            f'<style>{_STYLE}</style><defs>{_ARROW}</defs>'
            f'<rect width="{width:g}" height="{height:g}" fill="#fff"/>'
            + '\n'.join(body) + '</svg>\n')


def _scale_bar(x: float, y: float) -> list[str]:
    bars = [f'<rect x="{x + 10 * i:g}" y="{y:g}" width="10" height="2" stroke="#000" '
            f'stroke-width=".2" fill="{"#000" if i % 2 == 0 else "#fff"}"/>' for i in range(5)]
    return [*bars, _text(x, y + 5.5, '50 mm: measure after printing; print at 100 %', 'small')]


def _plan(target: RingTarget, view: _View) -> list[str]:
    """Plate, wall and dots from above."""
    half = np.array(target.base.size) / 2 * _MM
    plate = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    parts = [view.polygon(plate, 'plate')]
    parts += [view.polygon(piece * _MM, 'part') for piece in outlines(target)]
    radius = target.fiducials.radius * _MM * view.scale
    for centre in target.fiducials.centres:
        x, y = view.at(np.array(centre) * _MM)
        parts.append(f'<circle class="dot" cx="{x:.3f}" cy="{y:.3f}" r="{radius:.3f}"/>')
    return parts


def drawing(target: RingTarget) -> str:
    """Dimensioned drawing on A4, landscape."""
    width, depth = (side * _MM for side in target.base.size)
    inner, outer, height = (value * _MM for value in (
        target.inner_radius, target.outer_radius, target.height))
    thickness, slit = target.base.thickness * _MM, target.slits.width * _MM
    plan = _View(62, 62, 1.0)
    side = _View(62, 124, 1.0)
    large = _View(205, 99, 5.0)
    body = [_text(20, 18, 'Plan, 1:1'), *_plan(target, plan)]
    body += [plan.dimension((-width / 2, depth / 2), (width / 2, depth / 2), 8, f'{width:g}'),
             plan.dimension((-width / 2, -depth / 2), (-width / 2, depth / 2), 8, f'{depth:g}')]
    # the origin of the target frame
    for tip in (np.array([width / 2 + 3, 0.0]), np.array([0.0, depth / 2 + 3])):
        (x0, y0), (x1, y1) = plan.at(-tip), plan.at(tip)
        body.append(f'<line class="axis" x1="{x0}" y1="{y0}" x2="{x1}" y2="{y1}"/>')
    body += [_text(plan.x + width / 2 + 4, plan.y + 1, 'x'),
             _text(plan.x + 1.5, plan.y - depth / 2 - 2, 'y')]
    body += [_text(20, 110, 'Side, 1:1'),
             side.polygon(np.array([[-width / 2, -thickness], [width / 2, -thickness],
                                    [width / 2, 0], [-width / 2, 0]]), 'plate'),
             side.polygon(np.array([[-outer, 0], [outer, 0], [outer, height], [-outer, height]]),
                          'part'),
             side.dimension((-outer, 0), (-outer, height), 8, f'{height:g}'),
             side.dimension((width / 2, -thickness), (width / 2, 0), -6, f'{thickness:g}')]
    body += [_text(145, 18, 'Wall, 5:1; the slits go through its full height')]
    body += [large.polygon(piece * _MM, 'part') for piece in outlines(target)]
    middle = (target.arc[0] + target.arc[1]) / 2
    for radius, name, angle in ((inner, 'inner', middle + 0.42), (outer, 'outer', middle - 0.42)):
        end = (radius * math.cos(angle), radius * math.sin(angle))
        body.append(large.leader(end, (0.25 * end[0], 0.25 * end[1]) if name == 'inner' else
                                 (1.13 * end[0], 1.13 * end[1]), f'R{radius:g}'))
    for azimuth in target.slits.azimuths:
        tip = np.array([math.cos(azimuth), math.sin(azimuth)])
        a, b = large.at(tip * outer * 1.02), large.at(tip * outer * 1.1)
        body.append(f'<line class="dim" x1="{a[0]:.2f}" y1="{a[1]:.2f}" x2="{b[0]:.2f}" '
                    f'y2="{b[1]:.2f}"/>')
        x, y = large.at(tip * outer * 1.2)
        body.append(f'<text class="dimtext" text-anchor="middle" x="{x:.2f}" y="{y + 1:.2f}">'
                    f'{math.degrees(azimuth):.2f}°</text>')
    body.append(_text(large.x - 30, large.y + 8, f'{len(target.slits.azimuths)} slits, each '
                      f'{slit:g} wide, with parallel faces'))
    body.append(_text(large.x - 30, large.y + 12.5, 'wall from '
                      f'{math.degrees(target.arc[0]):.2f}° to {math.degrees(target.arc[1]):.2f}°; '
                      'azimuths from x towards y'))
    body += _table(target, 20, 142)
    body += _scale_bar(20, 192)
    body += _title_block(target, 150, 152)
    return _sheet(297, 210, f'Target {target.name}', body)


def _table(target: RingTarget, x: float, y: float) -> list[str]:
    """Places of the dots."""
    rows = [_text(x, y, f'Printed dots, diameter {_number(2 * target.fiducials.radius)}; '
                        "centres from the ring's centre")]
    for i, (cx, cy) in enumerate(target.fiducials.centres):
        column, row = divmod(i, 8)
        rows.append(_text(x + 42 * column, y + 5 + 4.4 * row,
                          f'{i + 1}:  x {_number(cx)}  y {_number(cy)}'))
    return rows


def _title_block(target: RingTarget, x: float, y: float) -> list[str]:
    """Name, finish, units."""
    lines = [
        'Half-ring calibration target. All dimensions in mm.',
        f'Matt. Reflectance: base {target.base.reflectance:g}, wall '
        f'{target.wall_reflectance:g}, dots {target.fiducials.reflectance:g}.',
        'Edges sharp, no chamfers. Wall perpendicular to the base.',
        'The calibration takes these dimensions as true: measure the part',
        'and write what was measured into its YAML file.']
    return [f'<rect x="{x}" y="{y}" width="130" height="48" class="plate"/>',
            _text(x + 4, y + 9, target.name, 'big'),
            *(_text(x + 4, y + 17 + 5 * i, line) for i, line in enumerate(lines)),
            _text(x + 4, y + 45, 'A4, scale 1:1 where not stated otherwise', 'small')]


def dot_sheet(target: RingTarget) -> str:
    """The base with its dots at 1:1, to be printed and glued on; the wall's outline places it."""
    width, depth = (side * _MM for side in target.base.size)
    page = (max(width + 30, 90), depth + 45)
    view = _View(page[0] / 2, 15 + depth / 2, 1.0)
    body = _plan(target, view)
    body = [part.replace('class="part"', 'class="place"') for part in body]
    return _sheet(*page, f'Dots of target {target.name}',
                  [*body, _text(5, 8, target.name), *_scale_bar(15, depth + 24)])
