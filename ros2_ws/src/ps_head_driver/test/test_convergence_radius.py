"""CR forward against an independent computation, and the inverse against exhaustive search."""
import os

from heads import NOMINAL, random_head
from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import least_squares

from ps_head_driver.circle_fit import fit_circles
from ps_head_driver.convergence_radius import Branch, CrSolver, forward, inverse
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import HeadModel
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at

seeds = st.integers(0, 2**32 - 1)
# the property below also holds for 10,000 heads, which take a minute: PS_RANDOM_HEADS=10000
HEADS = int(os.environ.get('PS_RANDOM_HEADS', '2000'))


@pytest.mark.parametrize(('tilt_deg', 'cr'), [(0, 0.22), (30, 0.0685), (40, 0.0110)])
def test_nominal_head_has_the_stated_values(tilt_deg, cr):
    m = BrightFieldKinematics(NOMINAL).motor_counts(np.radians(tilt_deg))
    solution = forward(NOMINAL, m)
    assert solution.convergence_radius == pytest.approx(cr, abs=5e-5)
    assert solution.branch is Branch.UNCROSSED


def test_nominal_axes_cross_near_41_7_degrees():
    solver = CrSolver(NOMINAL)
    motor = BrightFieldKinematics(NOMINAL)
    assert solver.forward(motor.motor_counts(np.radians(41.6))).branch is Branch.UNCROSSED
    assert solver.forward(motor.motor_counts(np.radians(41.8))).branch is Branch.CROSSED


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(0, 0.75), st.floats(0.12, 0.2))
@example(1500, 0.478515625, 0.14714399498850836)      # a small circle beats a huge one
def test_forward_agrees_with_rays_and_an_independent_circle_fit(seed, where, light_height):
    head = random_head(np.random.default_rng(seed))
    solver = CrSolver(head, light_height)
    low, high = BrightFieldKinematics(head).limits_counts
    m = int(low + where * (high - low))
    at_m0 = lights_at(head, head.bright_field.slider.m0_counts, 1.2)[:4]
    plane_z = np.mean([light.position[2] for light in at_m0]) - light_height
    points = []
    for light in lights_at(head, m, 1.2)[:4]:
        if light.axis[2] >= 0 or light.position[2] <= plane_z:
            with pytest.raises(PsError):
                solver.forward(m)
            return
        # march along the ray in its own words: position plus length times axis ends on the plane
        length = (plane_z - light.position[2]) / light.axis[2]
        points.append(np.array(light.position) + length * np.array(light.axis))
    xy = np.array(points)[:, :2]
    size = np.abs(xy).max()

    def distances(circle):
        return np.hypot(*(xy / size - circle[:2]).T) - circle[2]

    # four points may have several circles that are best among their neighbours
    middle = (xy / size).mean(axis=0)
    best = min((least_squares(distances, [*(middle + start), 1.0], xtol=1e-15, ftol=1e-15,
                              gtol=1e-15)
                for start in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))),
               key=lambda found: found.cost)
    if size > 1.0:       # axes almost level: a circle of metres, out of any use
        return
    solution = solver.forward(m)
    if solution.residual > 0.1 * solution.convergence_radius:
        return       # no circle to speak of: the fit may have two answers
    if size < 0.1 * solution.convergence_radius:
        # points almost in line: the best circle is a huge one, which the reference may not find
        assert solution.residual <= size * np.sqrt(np.mean(best.fun**2)) + 1e-9
        return
    # the reference optimiser's own precision, worse for large circles through close points
    tolerance = 1e-9 + 1e-8 * size + 1e-5 * solution.convergence_radius
    assert solution.convergence_radius == pytest.approx(2 * size * best.x[2], abs=tolerance)
    assert solution.residual == pytest.approx(size * np.sqrt(np.mean(best.fun**2)), abs=1e-9)
    np.testing.assert_allclose(solution.center, size * best.x[:2], atol=tolerance)


@settings(max_examples=12, deadline=None)
@given(seeds, st.floats(0.02, 0.98), st.sampled_from([Branch.UNCROSSED, Branch.CROSSED]))
def test_inverse_is_within_one_count_of_the_best_of_all_counts(seed, where, branch):
    head = random_head(np.random.default_rng(seed))
    solver = CrSolver(head)
    low, high = BrightFieldKinematics(head).limits_counts
    # every 20th count everywhere, and every count around the best of those
    counts = np.arange(low, high + 1, 20, dtype=float)
    cr, branches = solver.evaluate(counts)
    useful = (branches == branch) & (cr < 0.3)
    if not useful.any():
        return
    wanted = cr[useful][int(where * (useful.sum() - 1))] * (1 + 1e-5)
    near = counts[np.nanargmin(np.abs(np.where(useful, cr, np.nan) - wanted))]
    around = np.arange(max(near - 40, low), min(near + 40, high) + 1)
    cr_around, branches = solver.evaluate(around)
    best = np.where(branches == branch, np.abs(cr_around - wanted), np.inf).min()
    solution = solver.inverse(wanted, branch)
    assert solution.branch is branch
    assert abs(solution.convergence_radius - wanted) <= best + 1e-12
    lowest, highest = solution.reachable
    assert lowest - 1e-12 <= cr[useful].min()
    assert highest + 1e-12 >= cr[useful].max()


def pins(head: HeadModel, m: float) -> tuple[float, float]:
    """Angles of the crank pin on both assemblies: where two circles meet, by plane geometry."""
    field, slider = head.bright_field, head.bright_field.slider
    z = slider.z_at_m0 + slider.direction * (m - slider.m0_counts) / slider.counts_per_metre
    line = complex(slider.r - field.hinge.r, z - field.hinge.z)
    foot = (field.crank.radius**2 - field.rod_length**2 + abs(line)**2) / (2 * abs(line))
    aside = np.sqrt(field.crank.radius**2 - foot**2)
    found = [complex(foot, side * aside) * line / abs(line) for side in (1, -1)]
    return -np.angle(found[0]), -np.angle(found[1])      # pin = radius * (cos a, -sin a)


def turned(angle: float) -> float:
    return float(np.angle(np.exp(1j * angle)))


def points_by_rays(head: HeadModel, m: float) -> np.ndarray:
    """Where the four axes meet z = 0, in the words of head.yaml, one panel at a time."""
    field = head.bright_field
    offset = field.crank.offset
    at_home = [abs(turned(a - offset)) for a in pins(head, field.slider.m0_counts)]
    tilt = turned(pins(head, m)[int(np.argmin(at_home))] - offset)
    points = []
    for panel in field.panels.values():
        angle = tilt + panel.tilt_offset
        along, out = np.cos(angle) * field.arm.along, field.arm.out
        up, reach = np.exp(1j * panel.azimuth), np.exp(1j * (panel.azimuth + panel.twist))
        hinge = (field.hinge.r + panel.shift[0] + 1j * panel.shift[1]) * up
        center = hinge + (along - out * np.sin(angle)) * reach
        height = (field.hinge.z + panel.shift[2] - np.sin(angle) * field.arm.along
                  - out * np.cos(angle))
        point = center - height * np.tan(angle) * reach
        points.append((point.real, point.imag))
    return np.array(points)


def newton_step(points: np.ndarray, center: np.ndarray, radius: float) -> float:
    """How far one exact Newton step on the sum of squared distances moves circle and radius."""
    to_point = points - center
    distance = np.linalg.norm(to_point, axis=1)
    unit, off = to_point / distance[:, None], distance - radius
    gradient = np.append(-off @ unit, -off.sum())
    hessian = np.zeros((3, 3))
    for u, o, d in zip(unit, off, distance, strict=True):
        hessian[:2, :2] += np.outer(u, u) + o / d * (np.eye(2) - np.outer(u, u))
        hessian[:2, 2] += u
        hessian[2, :2] += u
        hessian[2, 2] += 1
    return float(np.abs(np.linalg.solve(hessian, gradient)).max())


def test_random_heads_forward_and_inverse():
    """Outside MIXED: the best of all counts on the branch asked for, or a refusal, never a guess.

    Forward is held against rays and a circle that share no code with the solver.
    """
    rng = np.random.default_rng(7)
    answered = refused = compared = 0
    refusals = set()
    for _ in range(HEADS):
        head = random_head(rng)
        solver = CrSolver(head)
        branch = Branch(int(rng.integers(1, 3)))
        wanted = float(rng.uniform(0, 0.3))
        low, high = BrightFieldKinematics(head).limits_counts
        counts = rng.integers(low, high, 40, endpoint=True).astype(float)
        try:
            solution = solver.inverse(wanted, branch)
        except PsError as refusal:
            refusals.add(refusal.code)
            refused += 1
            cr, branches = solver.evaluate(counts)
            cr = cr[branches == branch]
            if len(cr) and cr.min() <= wanted <= cr.max():      # then in a gap of the branch
                counts = np.arange(low, high + 1.0)
                cr, branches = solver.evaluate(counts)
                off = np.where(branches == branch, np.abs(cr - wanted), np.inf)
                best = solver.forward(int(counts[np.argmin(off)]))
                assert off.min() > abs(best.dcr_dm)
            continue
        answered += 1
        assert solution.branch is branch
        around = np.clip(solution.motor_counts + np.arange(-3.0, 4.0), low, high)
        cr, branches = solver.evaluate(np.concatenate([counts, around]))
        achieved = abs(solution.convergence_radius - wanted)
        assert achieved <= np.abs(cr[branches == branch] - wanted).min() + 1e-12
        assert achieved <= abs(solution.dcr_dm) + 1e-9

        points = points_by_rays(head, solution.motor_counts)
        # points that cover little of a circle, or are far from any, do not tell it to 1e-9 m
        cover = np.ptp(points, axis=0).max() / solution.convergence_radius
        if cover > 0.1 and solution.residual < 0.1 * solution.convergence_radius:
            step = newton_step(points, np.array(solution.center), solution.convergence_radius / 2)
            assert step < 1e-9
            compared += 1
    assert refusals == {ErrorCode.CR_UNREACHABLE}
    assert answered > HEADS / 2
    assert refused > HEADS / 100
    assert compared > 0.9 * answered


def test_light_height_moves_the_plane_and_reports_h_at_m():
    plain, high = forward(NOMINAL, 10000), forward(NOMINAL, 10000, 0.18)
    assert high.light_height - plain.light_height == pytest.approx(0.03, abs=1e-7)
    assert high.convergence_radius < plain.convergence_radius
    assert forward(NOMINAL, 10000, 0.0) == plain


def test_level_or_upward_axes_are_no_intersection():
    m = BrightFieldKinematics(NOMINAL).motor_counts(np.radians(95))
    with pytest.raises(PsError, match='E, N, W, S') as error:
        forward(NOMINAL, m)
    assert error.value.code == ErrorCode.CR_NO_INTERSECTION


def test_mixed_is_reported():
    data = NOMINAL.model_dump()
    data['bright_field']['panels']['E']['tilt_offset'] = 0.05
    head = type(NOMINAL).model_validate(data)
    m = BrightFieldKinematics(head).motor_counts(np.radians(40.5))
    solution = forward(head, m)
    assert solution.branch is Branch.MIXED
    assert solution.residual > 1e-4
    low, high = solution.reachable
    assert low <= solution.convergence_radius <= high


@pytest.mark.parametrize('wrong', [float('nan'), float('inf'), -0.01])
def test_wrong_numbers_are_named(wrong):
    with pytest.raises(PsError, match='convergence_radius') as error:
        inverse(NOMINAL, wrong)
    assert error.value.code == ErrorCode.CR_BAD_REQUEST
    with pytest.raises(PsError, match='light_height') as error:
        inverse(NOMINAL, 0.05, wrong)
    assert error.value.code == ErrorCode.CR_BAD_REQUEST


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(1e-3, 10), seeds)
def test_circle_fit_finds_circles(x, y, radius, seed):
    angles = np.random.default_rng(seed).uniform(-0.3, 0.3, 4) + np.arange(4) * np.pi / 2
    points = np.stack([x + radius * np.cos(angles), y + radius * np.sin(angles)], axis=-1)
    center, fitted, residual = fit_circles(points[None])
    np.testing.assert_allclose(center[0], [x, y], atol=1e-8 * (1 + radius))
    assert fitted[0] == pytest.approx(radius, rel=1e-8)
    assert residual[0] < 1e-8 * radius
