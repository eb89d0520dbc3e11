"""How a surface departs from Lambert's law, shared by all pixels of one object.

The robust solver predicts the intensity per irradiance of a pixel as

    u = |g| * f(n.l, n.h),    f(x, h) = x + sum_k c_k B_k(x, h),

n.l the cosine to the light, n.h the cosine to the half-vector between light and view. The basis is
low order: six polynomials for the body reflection (drop-off at grazing light, forward and backward
scattering) and four lobes of the half-vector, shaped like a GGX distribution, for gloss. The ten
coefficients belong to the object, so thousands of pixels determine them: the scaled normals are
eliminated pixel by pixel (variable projection) and what no normal can explain is fitted.
Lambert's law is c = 0.

Bi-polynomial reflectance: Shi et al., "Bi-polynomial modeling of low-frequency reflectances",
TPAMI 2014; there per pixel, here shared.
"""
import numba
import numpy as np
from numpy.typing import NDArray

TERMS = 10
LOBES = (0.004, 0.02, 0.06, 0.2)     # squared roughness of the gloss lobes
LEAST_FACTOR = 0.05                  # of f / (n.l)
LEAST_HALF = 0.05                    # cosine to the half-vector below which nothing is predicted
RIDGE = 1e-3                         # of the coefficients, relative to the mean information


@numba.njit(nogil=True, cache=True)
def fill_basis(x, h, out):    # type: ignore[no-untyped-def]
    """Values of the ten terms at n.l = x and n.h = h, into ``out`` (10,)."""
    u, v = 1.0 - x, 1.0 - h
    out[0], out[1], out[2] = x * u, x * u * u, x * u * u * u
    out[3], out[4], out[5] = x * v, x * v * v, x * u * v
    tangent = (1.0 - h * h) / (h * h)
    for k in range(len(LOBES)):
        out[6 + k] = 1.0 / (1.0 + tangent / LOBES[k]) ** 2


@numba.njit(nogil=True, cache=True, inline='always')
def departure(coefficients, x, h):    # type: ignore[no-untyped-def]
    """F / (n.l), at least LEAST_FACTOR; float32 and free of branches, for vectorised loops."""
    one = np.float32(1)
    u, v = one - x, one - h
    square = h * h
    tangent = (one - square) / square
    body = (coefficients[0] + u * (coefficients[1] + u * coefficients[2])) * u + (
        coefficients[3] + coefficients[4] * v + coefficients[5] * u) * v
    gloss = np.float32(0)
    for k in range(len(LOBES)):
        inverse = one / (one + tangent * np.float32(1 / LOBES[k]))
        gloss += coefficients[6 + k] * inverse * inverse
    return max(one + body + gloss / x, np.float32(LEAST_FACTOR))


def departures(coefficients: NDArray, x: NDArray, h: NDArray) -> NDArray:
    """F / (n.l) in plain NumPy, for samples and oracles; x > 0."""
    tangent = 1 / h ** 2 - 1
    u, v = 1 - x, 1 - h
    c = coefficients
    gloss = sum(c[6 + k] / (1 + tangent / LOBES[k]) ** 2 for k in range(len(LOBES)))
    factor = (1 + c[0] * u + c[1] * u ** 2 + c[2] * u ** 3 + c[3] * v + c[4] * v ** 2
              + c[5] * u * v + gloss / x)
    limited: NDArray = np.maximum(factor, LEAST_FACTOR)
    return limited


@numba.njit(nogil=True, cache=True)
def solve3(a, b, x):    # type: ignore[no-untyped-def]
    """Solve a symmetric 3 x 3 system by Cramer's rule; False if it is (nearly) singular.

    :param a: (6,) upper triangle xx xy xz yy yz zz.
    """
    c0 = a[3] * a[5] - a[4] * a[4]
    c1 = a[2] * a[4] - a[1] * a[5]
    c2 = a[1] * a[4] - a[2] * a[3]
    determinant = a[0] * c0 + a[1] * c1 + a[2] * c2
    trace = a[0] + a[3] + a[5]
    if not determinant > 1e-7 * trace * trace * trace:
        return False
    c3 = a[0] * a[5] - a[2] * a[2]
    c4 = a[1] * a[2] - a[0] * a[4]
    c5 = a[0] * a[3] - a[1] * a[1]
    x0 = (c0 * b[0] + c1 * b[1] + c2 * b[2]) / determinant
    x1 = (c1 * b[0] + c3 * b[1] + c4 * b[2]) / determinant
    x2 = (c2 * b[0] + c4 * b[1] + c5 * b[2]) / determinant
    x[0], x[1], x[2] = x0, x1, x2
    return True


@numba.njit(nogil=True, cache=True)
def add_equation(a, b, direction, weight, value):    # type: ignore[no-untyped-def]
    """Add one weighted equation direction . g = value to normal equations a (6,), b (3,)."""
    d0, d1, d2 = direction[0], direction[1], direction[2]
    a[0] += weight * d0 * d0
    a[1] += weight * d0 * d1
    a[2] += weight * d0 * d2
    a[3] += weight * d1 * d1
    a[4] += weight * d1 * d2
    a[5] += weight * d2 * d2
    b[0] += weight * value * d0
    b[1] += weight * value * d1
    b[2] += weight * value * d2


@numba.njit(nogil=True, cache=True)
def normal_equations(values, directions, halves, usable, scaled_normals, coefficients,    # type: ignore[no-untyped-def]
                     darkest, low, high, huber, first, last):
    """Information matrix (10, 10) and right side (10,) for a step of the coefficients.

    :param values: (T, P) intensity per irradiance of sample pixels.
    :param directions: (T, 3, P) unit vectors to the lights; halves: (T, 3, P) unit half-vectors.
    :param usable: (T, P), 0 for frames that must not be used.
    :param scaled_normals: (3, P).
    :param darkest: least n.l; low, high: limits of value over prediction; huber: threshold on the
        residual relative to |g|. Samples ``first`` to ``last`` are added up.
    """
    count = len(values)
    information, right = np.zeros((TERMS, TERMS)), np.zeros(TERMS)
    terms = np.empty((count, TERMS))
    jacobian = np.empty((count, 3))
    weight, residual = np.empty(count), np.empty(count)
    a, b, x = np.empty(6), np.empty(3), np.empty(3)
    cross, projection, column = np.empty((3, TERMS)), np.empty((3, TERMS)), np.empty(3)
    for p in range(first, last):
        g = scaled_normals[:, p]
        length = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if not length > 0:
            continue
        a[:], b[:], cross[:] = 0, 0, 0
        used = 0
        for t in range(count):
            weight[t] = 0
            d, e = directions[t, :, p], halves[t, :, p]
            cosine = (g[0] * d[0] + g[1] * d[1] + g[2] * d[2]) / length
            half = (g[0] * e[0] + g[1] * e[1] + g[2] * e[2]) / length
            if not usable[t, p] or cosine < darkest or half < LEAST_HALF:
                continue
            fill_basis(cosine, half, terms[t])
            predicted = cosine
            for k in range(TERMS):
                predicted += coefficients[k] * terms[t, k]
            value = values[t, p] / length
            if value < low * predicted or value > high * predicted:
                continue
            residual[t] = value - predicted
            size = abs(residual[t])
            weight[t] = 1.0 if size < huber else huber / size
            jacobian[t] = d * (predicted / cosine)
            used += 1
            add_equation(a, b, jacobian[t], weight[t], residual[t])
            for m in range(3):
                for k in range(TERMS):
                    cross[m, k] += weight[t] * jacobian[t, m] * terms[t, k]
        if used < 4 or not solve3(a, b, x):
            continue
        for k in range(TERMS):
            solve3(a, cross[:, k], column)
            projection[:, k] = column
        for t in range(count):
            if weight[t] == 0:
                continue
            j = jacobian[t]
            rest = residual[t] - (j[0] * x[0] + j[1] * x[1] + j[2] * x[2])
            for k in range(TERMS):
                terms[t, k] -= (j[0] * projection[0, k] + j[1] * projection[1, k]
                                + j[2] * projection[2, k])
            for k in range(TERMS):
                weighted = weight[t] * terms[t, k]
                right[k] += weighted * rest
                for m in range(TERMS):
                    information[k, m] += weighted * terms[t, m]
    return information, right


def improved(coefficients: NDArray[np.float64], information: NDArray[np.float64],
             right: NDArray[np.float64]) -> NDArray[np.float64]:
    """One Gauss-Newton step of the coefficients with a ridge towards Lambert's law."""
    ridge = RIDGE * max(float(np.trace(information)) / TERMS, 1e-12)
    step: NDArray = np.linalg.solve(
        information + ridge * np.eye(TERMS), right - ridge * coefficients)
    return np.asarray(coefficients + step, np.float64)
