"""Convergence radius: forward CR(m) and inverse m*(CR*) (paper, Eq. 1-4).

CR is the diameter of the circle fitted to the four points in which the bright-field panel axes
meet the measurement plane. CR(m) is not monotone: once the axes cross over the optical axis before
they reach the plane, the points move outwards again.
"""
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.circle_fit import fit_circle, fit_circles
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import DIRECTIONS, HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, axes, tilts

# motor positions at which the inverse looks first; it refines between them
_SAMPLES = 129
# positions tried inside each of the intervals that the samples leave, until single counts
_TRIES = 17
# a fit with a larger residual (over the radius) may have a rival that fits as well
_POOR = 0.05
# an axis flatter than this does not meet the plane anywhere near the head
_FLATTEST_AXIS = 1e-4


class Branch(IntEnum):
    """Which side of the crossing; values of ps_interfaces/SolveConvergenceRadius."""

    ANY = 0
    UNCROSSED = 1
    CROSSED = 2
    MIXED = 3


# compiled code knows plain numbers only
_UNCROSSED, _CROSSED, _MIXED = int(Branch.UNCROSSED), int(Branch.CROSSED), int(Branch.MIXED)


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


@nb.njit(cache=True)
def _intersections(center, axis, radial, plane_z):  # type: ignore[no-untyped-def]
    """Points (n, 4, 2) in which axes meet the plane, and their radial components (n, 4)."""
    points, distance = np.empty((len(center), 4, 2)), np.empty((len(center), 4))
    for i in range(len(center)):
        for k in range(4):
            along = np.nan
            if axis[i, k, 2] < -_FLATTEST_AXIS and center[i, k, 2] > plane_z:
                along = (plane_z - center[i, k, 2]) / axis[i, k, 2]
            distance[i, k] = 0.0
            for c in range(2):
                points[i, k, c] = center[i, k, c] + along * axis[i, k, c]
                distance[i, k] += points[i, k, c] * radial[k, c]
    return points, distance


@nb.njit(cache=True)
def _branches(radial):  # type: ignore[no-untyped-def]
    """Branch of each row; 0 where an axis does not meet the plane."""
    branch = np.empty(len(radial), np.int64)
    for i in range(len(radial)):
        outward = inward = 0
        missing = False
        for k in range(4):
            missing |= np.isnan(radial[i, k])
            outward += radial[i, k] >= 0
            inward += radial[i, k] <= 0
        branch[i] = 0 if missing else (
            _UNCROSSED if outward == 4 else (_CROSSED if inward == 4 else _MIXED))
    return branch


@nb.njit(cache=True)
def _circles(points, radial):  # type: ignore[no-untyped-def]
    """CR, branch, and rms distance from the circle over its radius, each (n,)."""
    branch = _branches(radial)
    cr, poorness = np.full(len(points), np.nan), np.full(len(points), np.nan)
    x, y = np.empty(4), np.empty(4)
    for i in range(len(points)):
        if branch[i] > 0:
            _, _, radius, residual = fit_circle(points[i], x, y)
            cr[i] = 2 * radius
            poorness[i] = residual / max(radius, 1e-12)
    return cr, branch, poorness


@nb.njit(cache=True)
def _evaluate(m, motor):  # type: ignore[no-untyped-def]
    """CR, branch and poorness of the circle at motor positions, each (n,)."""
    loop, ring, radial, plane_z = motor
    center, axis = axes(tilts(m, loop), *ring)
    points, distance = _intersections(center, axis, radial, plane_z)
    return _circles(points, distance)


@nb.njit(cache=True)
def _branches_at(m, motor):  # type: ignore[no-untyped-def]
    """Branches alone, (n,): near a crossing circles take long to fit."""
    loop, ring, radial, plane_z = motor
    center, axis = axes(tilts(m, loop), *ring)
    return _branches(_intersections(center, axis, radial, plane_z)[1])


@nb.njit(cache=True)
def _narrowed(below, above, side, motor):  # type: ignore[no-untyped-def]
    """Close in on the end of a branch between two counts; all positions tried, (n,)."""
    tried = np.empty(0)
    while above - below > 1:
        tries = np.round(np.linspace(below, above, _TRIES))
        branch = _branches_at(tries, motor)
        last = 0
        while branch[last + 1] == side:
            last += 1
        below, above = tries[last], tries[last + 1]
        tried = np.concatenate((tried, tries))
    return tried


@nb.njit(cache=True)
def _closest(low, high, branch, goal, motor):  # type: ignore[no-untyped-def]
    """Count of a branch whose CR is nearest to a goal, on ever finer grids; the count, its CR."""
    while True:
        tries = np.round(np.linspace(low, high, _TRIES))
        cr, there, _ = _evaluate(tries, motor)
        best = -1
        for i in range(_TRIES):
            if there[i] == branch and (best < 0 or abs(cr[i] - goal) < abs(cr[best] - goal)):
                best = i
        if high - low < _TRIES or best < 0:
            return (tries[best], cr[best]) if best >= 0 else (low, np.inf)
        low, high = tries[max(best - 1, 0)], tries[min(best + 1, _TRIES - 1)]


class CrSolver:
    """Forward and inverse for one head and one plane."""

    def __init__(self, head: HeadModel, light_height: float | None = None) -> None:
        if light_height is not None and not (np.isfinite(light_height) and light_height >= 0):
            raise PsError(ErrorCode.CR_BAD_REQUEST,
                          f'light_height: {light_height} is not a positive length in metres')
        self._motor = BrightFieldKinematics(head)
        at_home = self._axes(np.array([float(head.bright_field.slider.m0_counts)]))[0]
        self._reachable: dict[Branch, tuple[float, float]] = {}
        # the paper's h is C_z at m_0: it says where the plane is, and the plane stays there
        self.plane_z = float(at_home[0, :, 2].mean()) - light_height if light_height else 0.0
        # what the compiled functions want to know
        self._compiled = (self._motor.loop, self._motor.ring.arrays, self._motor.ring.radial,
                          self.plane_z)

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
        return _intersections(*self._axes(m), self._motor.ring.radial, self.plane_z)

    def evaluate(self, m: NDArray) -> tuple[NDArray, NDArray]:
        """CR (NaN without intersection) and branch at motor positions."""
        self._motor.check_counts(m)
        cr, branch, _ = _evaluate(np.asarray(m, np.float64), self._compiled)
        return cr, branch

    # ------------------------------------------------------------------ forward

    def forward(self, m_counts: int) -> CrSolution:
        """See :func:`forward`."""
        solution = self._at(m_counts)
        lowest, highest = self.reachable(solution.branch)
        return replace(solution, reachable=(lowest, highest))

    def _at(self, m_counts: int) -> CrSolution:
        """Everything but the reachable interval."""
        self._motor.check_counts(m_counts)
        low, high = self._motor.limits_counts
        m = np.unique(np.clip(np.array([m_counts - 1.0, m_counts, m_counts + 1.0]), low, high))
        here = int(np.searchsorted(m, m_counts))
        points, radial = self.intersections(m)
        missing = [name for name, r in zip(DIRECTIONS, radial[here], strict=True) if np.isnan(r)]
        if missing:
            raise PsError(ErrorCode.CR_NO_INTERSECTION,
                          f'the axis of panel {", ".join(missing)} does not meet the plane '
                          f'at m = {m_counts} (tilt {np.degrees(self._motor.tilt(m_counts)):.2f} '
                          'deg)')
        branches = _branches(radial)
        center, radius, residual = fit_circles(points[branches == branches[here]])
        # Of the changes to both neighbours on the branch the smaller one: four points of a very
        # asymmetric head may have two circles that fit equally well, and CR jumps between them.
        change = 2 * np.diff(radius)
        own = int(np.count_nonzero((branches == branches[here])[:here]))
        tilt = float(self._motor.tilt(m_counts))
        return CrSolution(
            motor_counts=int(m_counts), tilt=tilt, convergence_radius=2 * float(radius[own]),
            light_height=float(self._motor.ring.axes(tilt)[0][:, 2].mean()) - self.plane_z,
            residual=float(residual[own]), center=(float(center[own, 0]), float(center[own, 1])),
            branch=Branch(int(branches[here])), reachable=(np.nan, np.nan),
            dcr_dm=float(change[np.argmin(np.abs(change))]) if len(change) else 0.0)

    # ------------------------------------------------------------------ inverse

    @cached_property
    def sampled(self) -> tuple[NDArray, NDArray, NDArray]:
        """Motor positions (ascending whole counts), CR and branch there, branch ends included."""
        low, high = self._motor.limits_counts
        m = np.unique(np.linspace(low, high, _SAMPLES).round())
        branch = _branches_at(m, self._compiled)
        ends = [_narrowed(m[i], m[i + 1], branch[i], self._compiled)
                for i in np.flatnonzero(branch[:-1] != branch[1:])]
        m = np.unique(np.concatenate([m, *ends]))
        return self._with_jumps(m, *_evaluate(m, self._compiled))

    def _with_jumps(self, m: NDArray, cr: NDArray, branch: NDArray, poorness: NDArray,
                    ) -> tuple[NDArray, NDArray, NDArray]:
        """Samples, with more of them where CR jumps within a branch.

        Four points far from any circle may have two that fit about equally well; where the better
        one changes CR jumps. The samples close in on such places down to neighbouring counts.
        """
        while True:
            poor = poorness > _POOR
            if not poor.any():
                return m, cr, branch
            slope = np.diff(cr) / np.diff(m)
            slope[branch[:-1] != branch[1:]] = np.nan
            lower = np.fmin(slope[:-2], slope[2:])
            upper = np.fmax(slope[:-2], slope[2:])
            margin = 0.5 * (upper - lower) + 0.1 * np.maximum(abs(lower), abs(upper))
            jumps = (slope[1:-1] > upper + margin) | (slope[1:-1] < lower - margin)
            jumps &= (np.diff(m)[1:-1] > 1) & (poor[1:-2] | poor[2:-1])
            if not jumps.any():
                return m, cr, branch
            between = np.linspace(m[1:-2][jumps], m[2:-1][jumps], 10).round().ravel()
            added = _evaluate(between, self._compiled)
            m, first = np.unique(np.concatenate([m, between]), return_index=True)
            cr, branch, poorness = (np.concatenate([old, new])[first] for old, new in zip(
                (cr, branch, poorness), added, strict=True))

    def reachable(self, branch: Branch) -> tuple[float, float]:
        """Smallest and largest CR on a branch, m; NaN if the branch does not exist.

        For ANY the interval of the uncrossed branch, or the first of the others that exists.
        """
        if branch is Branch.ANY:
            exists = [b for b in (Branch.UNCROSSED, Branch.CROSSED, Branch.MIXED)
                      if (self.sampled[2] == b).any()]
            return self.reachable(exists[0]) if exists else (float('nan'), float('nan'))
        if branch not in self._reachable:
            self._reachable[branch] = (float('nan'), float('nan'))
            if (self.sampled[2] == branch).any():
                lowest, highest = self._nearest(branch, [0.0, np.inf])[1]   # CR is never negative
                self._reachable[branch] = lowest, highest
        return self._reachable[branch]

    def _nearest(self, branch: Branch, goals: list[float]) -> tuple[list[int], list[float]]:
        """Motor counts of a branch that exists, and CR there, nearest to each wanted CR.

        The distance may have several minima. Each lies beside a sample that is a local minimum, so
        the neighbourhoods of the best few are searched down to single counts.
        """
        m, cr, branches = self.sampled
        # nearest to infinity: the same order as nearest to more than any CR there is
        wanted = np.minimum(goals, np.nanmax(cr) * 2 + 1)
        found = [self._nearest_one(m, np.where(branches == branch, np.abs(cr - goal), np.inf),
                                   branch, float(goal)) for goal in wanted]
        return [int(count) for count, _ in found], [value for _, value in found]

    def _nearest_one(self, m: NDArray, distance: NDArray, branch: Branch, goal: float,
                     ) -> tuple[float, float]:
        """Count and CR nearest to a goal, from the distances of the samples to it."""
        is_minimum = np.isfinite(distance)
        is_minimum[1:] &= distance[1:] <= distance[:-1]
        is_minimum[:-1] &= distance[:-1] <= distance[1:]
        places = np.flatnonzero(is_minimum)
        places = places[np.argsort(distance[places], kind='stable')[:3]]
        tried: list[tuple[float, float]] = [
            _closest(m[max(i - 1, 0)], m[min(i + 1, len(m) - 1)], int(branch), goal,
                     self._compiled) for i in map(int, places)]
        return min(tried, key=lambda one: abs(one[1] - goal))

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
            # the ends of the interval are searched once
            goals = [wanted] if candidate in self._reachable else [wanted, 0.0, np.inf]
            counts, found = self._nearest(candidate, goals)
            if len(goals) > 1:
                self._reachable[candidate] = found[1], found[2]
            intervals[candidate] = self._reachable[candidate]
            solution = self._at(counts[0])
            # farther off than one count moves it lies beyond an end or in a gap of the branch
            if abs(solution.convergence_radius - wanted) <= abs(solution.dcr_dm) + 1e-9:
                return replace(solution, reachable=intervals[candidate])
        where = '; '.join(f'{name.name.lower()} {lowest * 1e3:.2f} to {highest * 1e3:.2f} mm'
                          for name, (lowest, highest) in intervals.items())
        raise PsError(ErrorCode.CR_UNREACHABLE,
                      f'CR {wanted * 1e3:.2f} mm cannot be reached'
                      + (f' on the {branch.name.lower()} branch' if branch != Branch.ANY else '')
                      + f'; reachable: {where or "nothing on that branch"}')
