"""The target as a closed triangle mesh, and as a binary STL file for printing or machining."""
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from ps_calibration.ring_target import RingTarget

# points along outlines: this dense, their segments are sure to be edges of the triangulation, and
# a chord of the ring is off its arc by less than a micrometre
_SPACING = 2e-4
_MM = 1e3


def outlines(target: RingTarget) -> list[NDArray]:
    """The pieces of wall between the slits, seen from above.

    :returns: for each piece (N, 2) points, m, counter-clockwise, closed without repetition.
    """
    radii = (target.inner_radius, target.outer_radius)
    half = [math.asin(target.slits.width / 2 / radius) for radius in radii]
    slits = sorted(target.slits.azimuths)
    pieces = []
    for first, last in zip([None, *slits], [*slits, None], strict=True):
        begin, end = ([target.arc[side] if slit is None else slit + sign * angle
                       for angle in half]
                      for side, slit, sign in ((0, first, 1), (1, last, -1)))
        corners = [radii[i] * np.array([math.cos(angle), math.sin(angle)])
                   for i, angle in ((0, begin[0]), (1, begin[1]), (1, end[1]), (0, end[0]))]
        pieces.append(np.concatenate([
            _line(corners[0], corners[1]), _arc(radii[1], begin[1], end[1]),
            _line(corners[2], corners[3]), _arc(radii[0], end[0], begin[0])]))
    return pieces


def target_mesh(target: RingTarget) -> NDArray:
    """Base plate and wall as one closed surface.

    :returns: (T, 3, 3) corners of triangles, m, target frame, counter-clockwise from outside.
    """
    pieces = outlines(target)
    width, depth = target.base.size
    plate = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, depth / 2]
    flat = np.concatenate([plate, *pieces])
    triangles = Delaunay(flat).simplices
    a, b, c = (flat[triangles[:, i]] for i in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    triangles[turn < 0] = triangles[turn < 0][:, ::-1]
    middle = flat[triangles].mean(axis=1)
    raised = np.any([_inside(middle, piece) for piece in pieces], axis=0)

    def level(z: float) -> NDArray:
        return np.column_stack([flat, np.full(len(flat), z)])

    bottom, base, crown = level(-target.base.thickness), level(0.0), level(target.height)
    faces = [crown[triangles[raised]], base[triangles[~raised]], bottom[triangles][:, ::-1],
             _sides(bottom, base, np.arange(4))]
    start = 4
    for piece in pieces:
        faces.append(_sides(base, crown, start + np.arange(len(piece))))
        start += len(piece)
    return np.concatenate(faces)


def is_closed(mesh: NDArray) -> bool:
    """Whether every edge borders exactly two triangles, in opposite directions."""
    _, index = np.unique(mesh.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    corner = index.reshape(-1, 3)
    edges = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    forward = {(int(a), int(b)) for a, b in edges}
    return len(forward) == len(edges) and all((b, a) in forward for a, b in forward)


def volume(mesh: NDArray) -> float:
    """Volume inside a closed mesh, m^3."""
    return float(np.einsum('ij,ij->i', mesh[:, 0], np.cross(mesh[:, 1], mesh[:, 2])).sum() / 6)


def write_stl(mesh: NDArray, path: str | Path, name: str) -> None:
    """Write a binary STL file in millimetres, as slicers expect."""
    normals = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    record = np.dtype([('normal', '<f4', 3), ('corners', '<f4', (3, 3)), ('spare', '<u2')])
    records = np.zeros(len(mesh), record)
    records['normal'], records['corners'] = normals, mesh * _MM
    header = f'{name}, millimetres'.encode('ascii', 'replace')[:80].ljust(80)
    Path(path).write_bytes(header + np.uint32(len(mesh)).tobytes() + records.tobytes())


def _line(start: NDArray, end: NDArray) -> NDArray:
    """Points from start to just before end."""
    count = max(round(float(np.linalg.norm(end - start)) / _SPACING), 1)
    return start + np.arange(count)[:, None] / count * (end - start)


def _arc(radius: float, begin: float, end: float) -> NDArray:
    """Points from begin to just before end."""
    count = max(round(radius * abs(end - begin) / _SPACING), 1)
    angle = begin + np.arange(count) / count * (end - begin)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _inside(points: NDArray, outline: NDArray) -> NDArray:
    """Whether points lie inside a polygon: a ray along +x leaves it an odd number of times."""
    x, y = points.T[:, :, None]
    (x0, y0), (x1, y1) = outline.T, np.roll(outline, -1, axis=0).T
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide='ignore', invalid='ignore'):
        right = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray((crosses & right).sum(axis=1) % 2 == 1)


def _sides(low: NDArray, high: NDArray, loop: NDArray) -> NDArray:
    """Vertical faces over a loop that runs counter-clockwise."""
    after = np.roll(loop, -1)
    return np.concatenate([np.stack([low[loop], low[after], high[after]], axis=1),
                           np.stack([low[loop], high[after], high[loop]], axis=1)])
