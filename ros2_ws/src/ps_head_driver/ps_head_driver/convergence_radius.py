"""Convergence radius: forward CR(m) and inverse m*(CR*) (paper, Eq. 1-4).

CR is the diameter of the circle fitted to the four points in which the bright-field panel axes
meet the measurement plane. CR(m) is not monotone: once the axes cross over the optical axis before
they reach the plane, the points move outwards again.
"""
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import DIRECTIONS, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics

# motor positions at which the inverse looks first; it refines between them
_SAMPLES = 257
# an axis flatter than this does not meet the plane anywhere near the head
_FLATTEST_AXIS = 1e-4


class Branch(IntEnum):
    """Which side of the crossing; values of ps_interfaces/SolveConvergenceRadius."""

    ANY = 0
    UNCROSSED = 1
    CROSSED = 2
    MIXED = 3


@dataclass(frozen=True)
class CrSolution:
    """One position of the motor and the circle that belongs to it.

    :param convergence_radius: achieved CR, a diameter, m.
    :param light_height: h(m), mean height of the panel centres above the plane, m.
    :param residual: rms distance of the four points from the circle, m.
    :param center: of the circle, ps_head_plane x and y, m.
    :param dcr_dm: sensitivity, m per count.
    :param reachable: smallest and largest CR on this branch, m.
    """

    motor_counts: int
    tilt: float
    convergence_radius: float
    light_height: float
    residual: float
    center: tuple[float, float]
    branch: Branch
    dcr_dm: float
    reachable: tuple[float, float]


def forward(head: HeadModel, m_counts: int, light_height: float | None = None) -> CrSolution:
    """CR at a motor position.

    :param light_height: the paper's h at m_0, m; None or 0 is the head's own (plane z = 0).
    :raises PsError: CR_NO_INTERSECTION naming the panel, CR_OUT_OF_LIMITS, CR_BAD_REQUEST.
    """
    return CrSolver(head, light_height).forward(m_counts)


def inverse(head: HeadModel, convergence_radius: float, light_height: float | None = None,
            branch: Branch = Branch.ANY) -> CrSolution:
    """Motor position whose CR is nearest to the wanted one.

    :param convergence_radius: CR*, a diameter, m.
    :param branch: ANY is uncrossed if it can be reached, else crossed, else mixed.
    :raises PsError: CR_UNREACHABLE with the reachable interval, CR_BAD_REQUEST.
    """
    return CrSolver(head, light_height).inverse(convergence_radius, branch)


class CrSolver:
    """Forward and inverse for one head and one plane."""

    def __init__(self, head: HeadModel, light_height: float | None = None) -> None:
        if light_height is not None and not (np.isfinite(light_height) and light_height >= 0):
            raise PsError(ErrorCode.CR_BAD_REQUEST,
                          f'light_height: {light_height} is not a positive length in metres')
        self._intervals: dict[Branch, tuple[float, float]] = {}
        self._motor = BrightFieldKinematics(head)
        at_home = self._axes(np.array([float(head.bright_field.slider.m0_counts)]))[0]
        # the paper's h is C_z at m_0: it says where the plane is, and the plane stays there
        self.plane_z = float(at_home[0, :, 2].mean()) - light_height if light_height else 0.0

    # ------------------------------------------------------------------ geometry

    def _axes(self, m: NDArray) -> tuple[NDArray, NDArray]:
        """Panel centres and axes, each (n, 4, 3), at motor positions (n,)."""
        return self._motor.ring.axes(self._motor.tilt(m))

    def intersections(self, m: NDArray) -> tuple[NDArray, NDArray]:
        """Where the axes meet the plane (paper, Eq. 2).

        :param m: (n,) motor positions, float.
        :returns: points (n, 4, 2), NaN where an axis does not meet the plane in front of its
            panel, and radial components (n, 4), m.
        """
        center, axis = self._axes(m)
        falls = axis[..., 2] < -_FLATTEST_AXIS
        above = center[..., 2] > self.plane_z
        along = np.divide(self.plane_z - center[..., 2], axis[..., 2],
                          out=np.full(falls.shape, np.nan), where=falls & above)
        points = center[..., :2] + along[..., None] * axis[..., :2]
        return points, (points * self._motor.ring.radial[:, :2]).sum(axis=-1)

    @staticmethod
    def _branches(radial: NDArray) -> NDArray:
        """Branch of each row; 0 where an axis does not meet the plane."""
        branch = np.full(len(radial), Branch.MIXED, np.int64)
        branch[np.all(radial >= 0, axis=1)] = Branch.UNCROSSED
        branch[np.all(radial <= 0, axis=1)] = Branch.CROSSED
        branch[np.isnan(radial).any(axis=1)] = 0
        return branch

    def evaluate(self, m: NDArray) -> tuple[NDArray, NDArray]:
        """CR (NaN without intersection) and branch at motor positions."""
        points, radial = self.intersections(m)
        branch = self._branches(radial)
        cr = np.full(len(m), np.nan)
        good = branch > 0
        if good.any():
            cr[good] = 2 * fit_circles(points[good])[1]
        return cr, branch

    # ------------------------------------------------------------------ forward

    def forward(self, m_counts: int) -> CrSolution:
        """See :func:`forward`."""
        solution = self._at(m_counts)
        lowest, highest = self.reachable(solution.branch)
        return CrSolution(**{**vars(solution), 'reachable': (lowest, highest)})

    def _at(self, m_counts: int) -> CrSolution:
        m = np.array([float(m_counts)])
        self._motor.check_counts(m)
        points, radial = self.intersections(m)
        missing = [name for name, r in zip(DIRECTIONS, radial[0], strict=True) if np.isnan(r)]
        if missing:
            raise PsError(ErrorCode.CR_NO_INTERSECTION,
                          f'the axis of panel {", ".join(missing)} does not meet the plane '
                          f'at m = {m_counts} (tilt {np.degrees(self._motor.tilt(m_counts)):.2f} '
                          'deg)')
        center, radius, residual = fit_circles(points)
        branch = Branch(int(self._branches(radial)[0]))
        return CrSolution(
            motor_counts=int(m_counts), tilt=float(self._motor.tilt(m_counts)),
            convergence_radius=2 * float(radius[0]),
            light_height=float(self._axes(m)[0][0, :, 2].mean()) - self.plane_z,
            residual=float(residual[0]), center=(float(center[0, 0]), float(center[0, 1])),
            branch=branch, dcr_dm=self._sensitivity(m[0], branch), reachable=(np.nan, np.nan))

    def _sensitivity(self, m: float, branch: Branch) -> float:
        """Change of CR to the next count on the branch, m per count.

        Of the two neighbours the one with the smaller change: four points of a very asymmetric
        head may have two circles that fit equally well, and CR jumps where the better one changes.
        """
        low, high = self._motor.limits_counts
        at = np.clip(m + np.array([-1.0, 0.0, 1.0]), low, high)
        cr, branches = self.evaluate(at)
        changes = np.diff(cr)[(np.diff(at) > 0) & (branches[:-1] == branches[1:])]
        return float(changes[np.argmin(np.abs(changes))]) if len(changes) else 0.0

    # ------------------------------------------------------------------ inverse

    @cached_property
    def sampled(self) -> tuple[NDArray, NDArray, NDArray]:
        """Motor positions (ascending whole counts), CR and branch there, branch ends included."""
        low, high = self._motor.limits_counts
        m = np.unique(np.linspace(low, high, _SAMPLES).round())
        branch = self._branches(self.intersections(m)[1])
        below, above = m[:-1][branch[:-1] != branch[1:]], m[1:][branch[:-1] != branch[1:]]
        side = branch[:-1][branch[:-1] != branch[1:]]
        while len(below) and np.any(above - below > 1):      # bisect every change of branch
            middle = np.floor((below + above) / 2)
            same = self._branches(self.intersections(middle)[1]) == side
            below, above = np.where(same, middle, below), np.where(same, above, middle)
        m = np.union1d(m, np.concatenate([below, above]))
        cr, branch = self.evaluate(m)
        return m, cr, branch

    def reachable(self, branch: Branch) -> tuple[float, float]:
        """Smallest and largest CR on a branch, m; NaN if the branch does not exist.

        For ANY the interval of the uncrossed branch, or the first of the others that exists.
        """
        if branch is Branch.ANY:
            exists = [b for b in (Branch.UNCROSSED, Branch.CROSSED, Branch.MIXED)
                      if (self.sampled[2] == b).any()]
            return self.reachable(exists[0]) if exists else (float('nan'), float('nan'))
        if branch not in self._intervals:
            ends = (float('nan'), float('nan'))
            if (self.sampled[2] == branch).any():
                best = np.array([self._refine(branch, lambda cr: cr),
                                 self._refine(branch, lambda cr: -cr)])
                lowest, highest = self.evaluate(best)[0]
                ends = (float(lowest), float(highest))
            self._intervals[branch] = ends
        return self._intervals[branch]

    def _refine(self, branch: Branch, cost: Callable[[NDArray], NDArray]) -> float:
        """Whole motor counts of the branch with the smallest cost(CR).

        The cost may have several minima. Each lies beside a sample that is a local minimum, so the
        neighbourhoods of the best few are searched on ever finer grids down to single counts.
        """
        def costs(cr: NDArray, branches: NDArray) -> NDArray:
            return np.where(branches == branch, cost(np.nan_to_num(cr)), np.inf)

        m, cr, branches = self.sampled
        values = costs(cr, branches)
        padded = np.concatenate([[np.inf], values, [np.inf]])
        minima = np.flatnonzero((values <= padded[:-2]) & (values <= padded[2:])
                                & np.isfinite(values))
        minima = minima[np.argsort(values[minima], kind='stable')][:3]
        best, best_value = float(m[minima[0]]), float(values[minima[0]])
        for index in minima:
            low, high = m[max(int(index) - 1, 0)], m[min(int(index) + 1, len(m) - 1)]
            while True:
                tries = np.unique(np.linspace(low, high, 33).round())
                there = costs(*self.evaluate(tries))
                at = int(np.argmin(there))
                if there[at] < best_value:
                    best, best_value = float(tries[at]), float(there[at])
                if high - low <= 32:
                    break
                low, high = tries[max(at - 1, 0)], tries[min(at + 1, len(tries) - 1)]
        return best

    def inverse(self, convergence_radius: float, branch: Branch = Branch.ANY) -> CrSolution:
        """See :func:`inverse`."""
        wanted = convergence_radius
        if not (np.isfinite(wanted) and wanted >= 0):
            raise PsError(ErrorCode.CR_BAD_REQUEST,
                          f'convergence_radius: {wanted} is not a length in metres')
        tried = [branch] if branch != Branch.ANY else [
            Branch.UNCROSSED, Branch.CROSSED, Branch.MIXED]
        intervals = {}
        for candidate in tried:
            if not (self.sampled[2] == candidate).any():
                continue
            lowest, highest = self.reachable(candidate)
            intervals[candidate] = (lowest, highest)
            best = self._refine(candidate, lambda cr: np.abs(cr - wanted))
            solution = self._at(int(best))
            # farther off than one count moves it lies beyond an end or in a gap of the branch
            if abs(solution.convergence_radius - wanted) <= abs(solution.dcr_dm) + 1e-9:
                return CrSolution(**{**vars(solution), 'reachable': (lowest, highest)})
        where = '; '.join(f'{name.name.lower()} {lowest * 1e3:.2f} to {highest * 1e3:.2f} mm'
                          for name, (lowest, highest) in intervals.items())
        raise PsError(ErrorCode.CR_UNREACHABLE,
                      f'CR {wanted * 1e3:.2f} mm cannot be reached'
                      + (f' on the {branch.name.lower()} branch' if branch != Branch.ANY else '')
                      + f'; reachable: {where or "nothing on that branch"}')


def fit_circles(points: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Least-squares circles: algebraic start, then Gauss-Newton on the geometric distance.

    :param points: (n, k, 2), k >= 3.
    :returns: centres (n, 2), radii (n,), rms distances (n,).
    """
    mean = points.mean(axis=1, keepdims=True)
    local = points - mean
    scale = np.sqrt((local**2).sum(axis=2).mean(axis=1))[:, None, None]
    scale = np.where(scale > 0, scale, 1.0)
    local = local / scale                      # well conditioned for any size of circle
    x, y = local[..., 0], local[..., 1]

    # algebraic (Kasa): x^2 + y^2 = 2 a x + 2 b y + c
    a, b, c = _solve(2 * x, 2 * y, x**2 + y**2)
    radius = np.sqrt(np.maximum(c + a**2 + b**2, 0))
    for _ in range(60):
        dx, dy = x - a[:, None], y - b[:, None]
        distance = np.hypot(dx, dy)
        safe = np.where(distance > 0, distance, 1.0)
        step_a, step_b, step_radius = _solve(dx / safe, dy / safe, distance - radius[:, None])
        a, b, radius = a + step_a, b + step_b, radius + step_radius
        if max(np.abs(step_a).max(), np.abs(step_b).max(), np.abs(step_radius).max()) < 1e-11:
            break
    distance = np.hypot(x - a[:, None], y - b[:, None])
    residual = np.sqrt(((distance - radius[:, None])**2).mean(axis=1))
    size = scale[:, 0, 0]
    return mean[:, 0] + size[:, None] * np.stack([a, b], axis=1), radius * size, residual * size


def _solve(u: NDArray, v: NDArray, target: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Least squares of many systems a u + b v + c = target; (n, k) each to (n,) each."""
    mean_u, mean_v, mean_t = u.mean(axis=1), v.mean(axis=1), target.mean(axis=1)
    du, dv, dt = u - mean_u[:, None], v - mean_v[:, None], target - mean_t[:, None]
    uu, uv, vv = (du * du).sum(axis=1), (du * dv).sum(axis=1), (dv * dv).sum(axis=1)
    ut, vt = (du * dt).sum(axis=1), (dv * dt).sum(axis=1)
    # points on a line have no circle: a tiny ridge keeps the system solvable, the residual tells
    uu, vv = uu + 1e-13, vv + 1e-13
    determinant = uu * vv - uv * uv
    a = (vv * ut - uv * vt) / determinant
    b = (uu * vt - uv * ut) / determinant
    return a, b, mean_t - a * mean_u - b * mean_v
