"""CR forward against an independent computation, and the inverse against exhaustive search."""
from heads import NOMINAL, random_head
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import least_squares

from ps_head_driver.convergence_radius import Branch, CrSolver, fit_circles, forward, inverse
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.kinematics import BrightFieldKinematics, lights_at

seeds = st.integers(0, 2**32 - 1)


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

    best = least_squares(distances, [*(xy / size).mean(axis=0), 1.0], xtol=1e-15, ftol=1e-15,
                         gtol=1e-15)
    if size > 1.0:       # axes almost level: a circle of metres, out of any use
        return
    solution = solver.forward(m)
    if solution.residual > 0.1 * solution.convergence_radius:
        return       # no circle to speak of: the fit may have two answers
    tolerance = 1e-9 + 1e-8 * size      # the reference optimiser's own precision
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


def test_two_thousand_requests_are_answered_right_or_refused():
    """Never silently clamped: the answer is as near as one count allows, or there is none."""
    rng = np.random.default_rng(7)
    answered, codes = 0, set()
    for _ in range(40):
        solver = CrSolver(random_head(rng))
        for wanted in rng.uniform(0, 0.4, 50):
            branch = Branch(int(rng.integers(0, 3)))
            try:
                solution = solver.inverse(float(wanted), branch)
            except PsError as refusal:
                codes.add(refusal.code)
                continue
            answered += 1
            if branch is not Branch.ANY:
                assert solution.branch is branch
            if solution.branch is not Branch.MIXED:
                step = abs(solution.dcr_dm)
                assert abs(solution.convergence_radius - wanted) <= step + 1e-9
    assert answered > 600
    assert codes == {ErrorCode.CR_UNREACHABLE}


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
