"""Which frames of one pixel to believe: the temporal weights of the robust regression.

Everything here looks at one pixel: u_t intensity per irradiance, d_t unit vector to the light, h_t
unit half-vector between light and view. Lambert's law reads u_t = g . d_t.

Many lights (T >= MANY): start from the middle ranks of the intensities; then, three times, call a
frame shadowed where the prediction or the observation is too dark, and of the rest believe the
darker 60 %, because gloss and light from neighbours only ever add.
Few lights: the residual alone cannot tell a highlight from the attached shadow opposite, so drop
frames that are dark against the brightest (attached shadow), then the frame whose half-vector
comes closest to the normal, if that is close and the frame is too bright (highlight).
`refine` then repeats the rejection against the object's own reflectance (reflectance.py).
"""
import numba
import numpy as np

from ps_reconstruction.reflectance import LEAST_HALF, add_equation, look_up, solve3

MANY = 8                                  # lights, from which on ranks tell more than thresholds
RANKS = (0.3, 0.8)                        # of the first estimate with many lights
BELIEVED = 0.6                            # fraction of the lit frames kept, the darkest
LEAST_COSINE = 0.1                        # to a light; below it a frame counts as shadowed
LEAST_RATIO, MOST_RATIO = 0.6, 1.5        # observation over prediction
DARK_RATIO = 0.1                          # of the brightest frame; darker is an attached shadow
GATE = float(np.cos(np.radians(25)))      # half-vector against normal: there gloss shows
HUBER = 0.02                              # threshold of the residual, relative to |g|


@numba.njit(nogil=True, cache=True)
def least_squares(u, d, weight, g):    # type: ignore[no-untyped-def]
    """Weighted least squares u_t = g . d_t; False (g untouched) if it is not determined."""
    a, b = np.zeros(6, np.float32), np.zeros(3, np.float32)
    for t in range(u.size):
        if weight[t] > 0:
            add_equation(a, b, d[t], weight[t], u[t])
    return solve3(a, b, g)


@numba.njit(nogil=True, cache=True)
def keep_darkest(u, weight, fraction):    # type: ignore[no-untyped-def]
    """Set the weight of all but the darkest ``fraction`` (at least 4) of the used frames to 0."""
    used = np.sort(u[weight > 0])
    if used.size > 4:
        limit = used[min(max(4, int(fraction * used.size + 0.5)), used.size) - 1]
        for t in range(u.size):
            if u[t] > limit:
                weight[t] = 0


@numba.njit(nogil=True, cache=True)
def first_of_many(u, d, usable, weight, g):    # type: ignore[no-untyped-def]
    """First estimate from many lights; fills weight (T,) with 0 or 1 and g (3,)."""
    order = np.argsort(u)
    last = u.size - 1
    weight[:] = 0
    for rank in range(u.size):
        t = order[rank]
        if usable[t] and RANKS[0] * last < rank < RANKS[1] * last:
            weight[t] = 1
    if not least_squares(u, d, weight, g):
        return
    for _ in range(3):
        length = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        for t in range(u.size):
            predicted = g[0] * d[t, 0] + g[1] * d[t, 1] + g[2] * d[t, 2]
            weight[t] = 1 if (usable[t] and predicted > LEAST_COSINE * length
                              and u[t] > LEAST_RATIO * predicted) else 0
        keep_darkest(u, weight, BELIEVED)
        if not least_squares(u, d, weight, g):
            return


@numba.njit(nogil=True, cache=True)
def first_of_few(u, d, h, usable, weight, g):    # type: ignore[no-untyped-def]
    """First estimate from few lights; fills weight (T,) with 0 or 1 and g (3,)."""
    count = u.size
    brightest = np.float32(0)
    left = 0
    for t in range(count):
        weight[t] = 1 if usable[t] else 0
        left += 1 if usable[t] else 0
        brightest = max(brightest, u[t])
    while left > 3:
        darkest = -1
        for t in range(count):
            if weight[t] > 0 and u[t] < DARK_RATIO * brightest and (
                    darkest < 0 or u[t] < u[darkest]):
                darkest = t
        if darkest < 0:
            break
        weight[darkest] = 0
        left -= 1
    if not least_squares(u, d, weight, g) or left < 4:
        return
    length = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    nearest, best = -1, np.float32(GATE) * length
    for t in range(count):
        cosine = g[0] * h[t, 0] + g[1] * h[t, 1] + g[2] * h[t, 2]
        if weight[t] > 0 and cosine > best:
            nearest, best = t, cosine
    if nearest < 0:
        return
    predicted = g[0] * d[nearest, 0] + g[1] * d[nearest, 1] + g[2] * d[nearest, 2]
    if u[nearest] > predicted:
        weight[nearest] = 0
        if not least_squares(u, d, weight, g):
            weight[nearest] = 1


@numba.njit(nogil=True, cache=True)
def refine(u, d, h, usable, table, rounds, g, weight, factor):    # type: ignore[no-untyped-def]
    """Repeat rejection, Huber weights and solution against the object's reflectance.

    :param table: of reflectance.tabulate.
    :param g: (3,) estimate in, better estimate out.
    :param weight: (T,) out: w_temp times the Huber weight.
    :param factor: (T,) out: f / (n.l), so that u_t = factor_t d_t . g.
    """
    count = u.size
    many = count >= MANY
    a, b, x = np.empty(6, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    for _ in range(rounds):
        length = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if not length > 0:
            return
        used = 0
        for t in range(count):
            weight[t], factor[t] = 0, 1
            cosine = (g[0] * d[t, 0] + g[1] * d[t, 1] + g[2] * d[t, 2]) / length
            half = (g[0] * h[t, 0] + g[1] * h[t, 1] + g[2] * h[t, 2]) / length
            if not usable[t] or cosine < LEAST_COSINE or half < LEAST_HALF:
                continue
            factor[t] = look_up(table, min(cosine, np.float32(1)), min(half, np.float32(1)))
            predicted = factor[t] * cosine * length
            if LEAST_RATIO * predicted < u[t] < MOST_RATIO * predicted:
                size = abs(u[t] - predicted)
                limit = np.float32(HUBER) * length
                weight[t] = 1 if size < limit else limit / size
                used += 1
        if many:
            keep_darkest(u, weight, BELIEVED)
        if used < 3:
            return
        a[:], b[:] = 0, 0
        for t in range(count):
            if weight[t] > 0:
                add_equation(a, b, d[t], weight[t] * factor[t] * factor[t], u[t] / factor[t])
        if not solve3(a, b, x):
            return
        g[:] = x
