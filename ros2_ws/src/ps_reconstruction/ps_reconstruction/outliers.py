"""Which frames of a pixel to believe: the temporal weights of the robust regression.

Many lights (T >= MANY): start from the middle ranks of the intensities; then, three times, call a
frame shadowed where the prediction or the observation is too dark, and of the rest believe the
darker 60 %, because gloss and light from neighbours only ever add.
Few lights: the residual alone cannot tell a highlight from the attached shadow opposite, so drop
frames that are dark against the brightest (attached shadow), then the frame whose half-vector
comes closest to the normal, if that is close and the frame is brighter than noise explains
(highlight), at the pixel or in the mean of NEAR side by side: rejected by chance alone, bright
frames would flatten every slope.
`refine` then repeats the rejection against the object's own reflectance (reflectance.py).

CHUNK pixels are worked on together. Their numbers lie in flat float32 buffers, quantity after
quantity at the constant offsets below: with these and without branches, the compiler sees that
the loops over pixels can use vector instructions. Weights are 0 for a frame not believed.
"""
import numba
import numpy as np

from ps_reconstruction.reflectance import LEAST_HALF, departure

MANY = 8                                  # lights, from which on ranks tell more than thresholds
RANKS = (0.3, 0.8)                        # of the first estimate with many lights
BELIEVED = 0.6                            # fraction of the lit frames kept, the darkest
LEAST_KEPT = 4
BISECTIONS = 13                           # of an intensity, to find its rank
LEAST_COSINE = 0.1                        # to a light; below it a frame counts as shadowed
LEAST_RATIO, MOST_RATIO = 0.6, 1.5        # observation over prediction
DARK_RATIO = 0.1                          # of the brightest frame; darker is an attached shadow
GATE = float(np.cos(np.radians(25)))      # half-vector against normal: there gloss shows
NEAR = 5                                  # pixels side by side that a highlight is tested with
MOST_EXCESS = 0.1                         # of |g|, that one of them counts
HUBER = 0.02                              # threshold of the residual, relative to |g|
SINGULAR = 1e-7                           # determinant over cubed trace
FAST = {'contract', 'reassoc', 'arcp', 'nsz', 'afn'}    # without nnan: NaN marks invalid pixels

CHUNK = 64
# Buffer of a frame, (FRAME_SIZE,): intensity per irradiance; irradiance; unit vector to the light;
# unit half-vector between light and view; 1 if usable; weight; f / (n.l). Lambert: U = g . D
U, E = 0, CHUNK
D0, D1, D2 = 2 * CHUNK, 3 * CHUNK, 4 * CHUNK
H0, H1, H2 = 5 * CHUNK, 6 * CHUNK, 7 * CHUNK
USABLE, WEIGHT, FACTOR = 8 * CHUNK, 9 * CHUNK, 10 * CHUNK
FRAME_SIZE = 11 * CHUNK
# Buffer of the pixels, (PIXEL_SIZE,): scaled normal, its length and 1 / length; scratch
G0, G1, G2, LENGTH, INVERSE = 0, CHUNK, 2 * CHUNK, 3 * CHUNK, 4 * CHUNK
LEFT, BEST, PLACE = 5 * CHUNK, 6 * CHUNK, 7 * CHUNK
PIXEL_SIZE = 8 * CHUNK
# Buffer of the normal equations, (EQUATION_SIZE,): xx xy xz yy yz zz, right side
EQUATION_SIZE = 9 * CHUNK


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def add_equations(frame, equations):    # type: ignore[no-untyped-def]
    """Add the weighted equations U = FACTOR D . g of one frame."""
    for x in range(CHUNK):
        f = frame[FACTOR + x]
        w = frame[WEIGHT + x] * f
        value = frame[U + x] * w
        w *= f
        d0, d1, d2 = frame[D0 + x], frame[D1 + x], frame[D2 + x]
        w0, w1, w2 = w * d0, w * d1, w * d2
        equations[x] += w0 * d0
        equations[CHUNK + x] += w0 * d1
        equations[2 * CHUNK + x] += w0 * d2
        equations[3 * CHUNK + x] += w1 * d1
        equations[4 * CHUNK + x] += w1 * d2
        equations[5 * CHUNK + x] += w2 * d2
        equations[6 * CHUNK + x] += value * d0
        equations[7 * CHUNK + x] += value * d1
        equations[8 * CHUNK + x] += value * d2


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def solve_equations(equations, pixels):    # type: ignore[no-untyped-def]
    """Scaled normals by Cramer's rule; where the equations are singular they stay as they are."""
    one = np.float32(1)
    for x in range(CHUNK):
        xx, xy, xz = equations[x], equations[CHUNK + x], equations[2 * CHUNK + x]
        yy, yz, zz = (equations[3 * CHUNK + x], equations[4 * CHUNK + x],
                      equations[5 * CHUNK + x])
        b0, b1, b2 = (equations[6 * CHUNK + x], equations[7 * CHUNK + x],
                      equations[8 * CHUNK + x])
        c0, c1, c2 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        c3, c4, c5 = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        determinant = xx * c0 + xy * c1 + xz * c2
        trace = xx + yy + zz
        good = determinant > np.float32(SINGULAR) * trace * trace * trace
        inverse = one / (determinant if good else one)
        old0, old1, old2 = pixels[G0 + x], pixels[G1 + x], pixels[G2 + x]
        g0 = (c0 * b0 + c1 * b1 + c2 * b2) * inverse if good else old0
        g1 = (c1 * b0 + c3 * b1 + c4 * b2) * inverse if good else old1
        g2 = (c2 * b0 + c4 * b1 + c5 * b2) * inverse if good else old2
        length = np.sqrt(g0 * g0 + g1 * g1 + g2 * g2)
        pixels[G0 + x], pixels[G1 + x], pixels[G2 + x] = g0, g1, g2
        pixels[LENGTH + x] = length
        pixels[INVERSE + x] = one / max(length, np.float32(1e-30))


@numba.njit(nogil=True, cache=True)
def solve_frames(frames, equations, pixels):    # type: ignore[no-untyped-def]
    """Weighted least squares over all frames (T, FRAME_SIZE)."""
    for x in range(EQUATION_SIZE):
        equations[x] = 0
    for t in range(frames.shape[0]):
        add_equations(frames[t], equations)
    solve_equations(equations, pixels)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _count_below(frame, middle, count):    # type: ignore[no-untyped-def]
    """Add 1 to ``count`` where the frame is believed and not brighter than ``middle``."""
    for x in range(CHUNK):
        below = (frame[WEIGHT + x] > np.float32(0)) & (frame[U + x] <= middle[x])
        count[x] += np.float32(1) if below else np.float32(0)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def find_rank(frames, wanted, limit):    # type: ignore[no-untyped-def]
    """Intensity of which ``wanted`` (CHUNK,) believed frames are not brighter, into ``limit``.

    By bisection over all pixels at once, to 1e-4 of the brightest: linear in the number of frames
    and faster than sorting each pixel.
    """
    low, high = np.zeros(CHUNK, np.float32), np.zeros(CHUNK, np.float32)
    middle, count = np.empty(CHUNK, np.float32), np.empty(CHUNK, np.float32)
    for t in range(frames.shape[0]):
        frame = frames[t]
        for x in range(CHUNK):
            low[x] = min(low[x], frame[U + x])
            high[x] = max(high[x], frame[U + x])
    for _ in range(BISECTIONS):
        for x in range(CHUNK):
            middle[x] = np.float32(0.5) * (low[x] + high[x])
            count[x] = 0
        for t in range(frames.shape[0]):
            _count_below(frames[t], middle, count)
        for x in range(CHUNK):
            enough = count[x] >= wanted[x]
            bottom, top = low[x], high[x]
            low[x] = bottom if enough else middle[x]
            high[x] = middle[x] if enough else top
    limit[:] = high


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _keep_between(frame, low, high):    # type: ignore[no-untyped-def]
    """Set the weight to 0 where the intensity is not above ``low`` and up to ``high``."""
    for x in range(CHUNK):
        weight, value = frame[WEIGHT + x], frame[U + x]
        frame[WEIGHT + x] = weight if (value > low[x]) & (value <= high[x]) else np.float32(0)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def keep_darkest(frames):    # type: ignore[no-untyped-def]
    """Set the weight of all but the darkest frames used of each pixel to 0."""
    wanted, low = np.zeros(CHUNK, np.float32), np.full(CHUNK, -1e30, np.float32)
    high = np.empty(CHUNK, np.float32)
    for t in range(frames.shape[0]):
        for x in range(CHUNK):
            wanted[x] += np.float32(1) if frames[t, WEIGHT + x] > 0 else np.float32(0)
    for x in range(CHUNK):
        kept = np.floor(np.float32(BELIEVED) * wanted[x] + np.float32(0.5))
        wanted[x] = min(wanted[x], max(kept, np.float32(LEAST_KEPT)))
    find_rank(frames, wanted, high)
    for t in range(frames.shape[0]):
        _keep_between(frames[t], low, high)


@numba.njit(nogil=True, cache=True)
def middle_ranks(frames):    # type: ignore[no-untyped-def]
    """Weight 1 for the usable frames of middle rank of each pixel."""
    last = frames.shape[0] - 1
    wanted = np.empty(CHUNK, np.float32)
    low, high = np.empty(CHUNK, np.float32), np.empty(CHUNK, np.float32)
    for t in range(frames.shape[0]):
        frames[t, WEIGHT:WEIGHT + CHUNK] = 1
    wanted[:] = int(RANKS[0] * last) + 1
    find_rank(frames, wanted, low)
    wanted[:] = np.ceil(RANKS[1] * last)
    find_rank(frames, wanted, high)
    for t in range(frames.shape[0]):
        frame = frames[t]
        frame[WEIGHT:WEIGHT + CHUNK] = frame[USABLE:USABLE + CHUNK]
        _keep_between(frame, low, high)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def believe_lit(frame, pixels):    # type: ignore[no-untyped-def]
    """Weight 1 where a frame is usable and neither prediction nor observation is too dark."""
    for x in range(CHUNK):
        predicted = (pixels[G0 + x] * frame[D0 + x] + pixels[G1 + x] * frame[D1 + x]
                     + pixels[G2 + x] * frame[D2 + x])
        lit = ((predicted > np.float32(LEAST_COSINE) * pixels[LENGTH + x])
               & (frame[U + x] > np.float32(LEAST_RATIO) * predicted))
        usable = frame[USABLE + x]
        frame[WEIGHT + x] = usable if lit else np.float32(0)


@numba.njit(nogil=True, cache=True)
def first_of_many(frames, equations, pixels):    # type: ignore[no-untyped-def]
    """First estimate from many lights: weights 0 or 1 and scaled normals."""
    middle_ranks(frames)
    solve_frames(frames, equations, pixels)
    for _ in range(3):
        for t in range(frames.shape[0]):
            believe_lit(frames[t], pixels)
        keep_darkest(frames)
        solve_frames(frames, equations, pixels)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _find_dark(frame, index, pixels):    # type: ignore[no-untyped-def]
    """Note this frame as PLACE where it is believed and darker than BEST."""
    for x in range(CHUNK):
        best, place, value = pixels[BEST + x], pixels[PLACE + x], frame[U + x]
        darker = ((frame[WEIGHT + x] > np.float32(0)) & (value < best)
                  & (pixels[LEFT + x] > np.float32(3)))
        pixels[BEST + x] = value if darker else best
        pixels[PLACE + x] = index if darker else place


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _find_glossy(frame, index, pixels):    # type: ignore[no-untyped-def]
    """Note this frame as PLACE where it is believed and its half-vector nearer than BEST."""
    for x in range(CHUNK):
        best, place = pixels[BEST + x], pixels[PLACE + x]
        cosine = (pixels[G0 + x] * frame[H0 + x] + pixels[G1 + x] * frame[H1 + x]
                  + pixels[G2 + x] * frame[H2 + x])
        nearer = (frame[WEIGHT + x] > np.float32(0)) & (cosine > best)
        pixels[BEST + x] = cosine if nearer else best
        pixels[PLACE + x] = index if nearer else place


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _drop_place(frame, index, pixels):    # type: ignore[no-untyped-def]
    """Drop this frame where it is PLACE."""
    for x in range(CHUNK):
        weight = frame[WEIGHT + x]
        frame[WEIGHT + x] = np.float32(0) if pixels[PLACE + x] == index else weight


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _drop_highlight(frame, index, pixels, margins, excess):    # type: ignore[no-untyped-def]
    """Drop this frame where it is PLACE and exceeds Lambert's law by more than noise explains.

    :param margins: (2,) of the excess relative to |g|: of the pixel, of the mean of NEAR pixels
        side by side, in which noise is lower.
    :param excess: (CHUNK + NEAR - 1,) scratch, 0 at both ends.
    """
    alone, together = margins[0], margins[1]
    for x in range(CHUNK):
        predicted = (pixels[G0 + x] * frame[D0 + x] + pixels[G1 + x] * frame[D1 + x]
                     + pixels[G2 + x] * frame[D2 + x])
        over = (frame[U + x] - predicted) * pixels[INVERSE + x]
        believed = frame[WEIGHT + x] > np.float32(0)
        limited = min(max(over, np.float32(-MOST_EXCESS)), np.float32(MOST_EXCESS))
        excess[NEAR // 2 + x] = limited if believed else np.float32(0)
        pixels[BEST + x] = over
    for x in range(CHUNK):
        mean = np.float32(0)
        for k in range(NEAR):
            mean += excess[x + k]
        mean *= np.float32(1 / NEAR)
        weight, own = frame[WEIGHT + x], pixels[BEST + x]
        drop = ((pixels[PLACE + x] == index)
                & ((own > alone) | ((mean > together) & (own > np.float32(0)))))
        frame[WEIGHT + x] = np.float32(0) if drop else weight


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _any_place(pixels, index):    # type: ignore[no-untyped-def]
    """Whether this frame is PLACE anywhere in the chunk."""
    found = np.float32(0)
    for x in range(CHUNK):
        found += np.float32(1) if pixels[PLACE + x] == index else np.float32(0)
    return found > np.float32(0)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def first_of_few(frames, margins, equations, pixels):    # type: ignore[no-untyped-def]
    """First estimate from few lights: weights 0 or 1 and scaled normals."""
    count = frames.shape[0]
    zero, one = np.float32(0), np.float32(1)
    brightest = np.zeros(CHUNK, np.float32)
    for x in range(CHUNK):
        pixels[LEFT + x] = zero
    for t in range(count):
        frame = frames[t]
        for x in range(CHUNK):
            frame[WEIGHT + x] = frame[USABLE + x]
            pixels[LEFT + x] += frame[USABLE + x]
            brightest[x] = max(brightest[x], frame[U + x])
    for _ in range(count - 3):                      # the darkest, then the next darkest, ...
        for x in range(CHUNK):
            pixels[BEST + x] = np.float32(DARK_RATIO) * brightest[x]
            pixels[PLACE + x] = -one
        for t in range(count):
            _find_dark(frames[t], np.float32(t), pixels)
        found = False
        for t in range(count):
            if _any_place(pixels, np.float32(t)):
                found = True
                _drop_place(frames[t], np.float32(t), pixels)
        if not found:
            break
        for x in range(CHUNK):
            pixels[LEFT + x] -= one if pixels[PLACE + x] >= zero else zero
    solve_frames(frames, equations, pixels)
    for x in range(CHUNK):
        enough = pixels[LEFT + x] > np.float32(3)
        gate = np.float32(GATE) * pixels[LENGTH + x]
        pixels[BEST + x] = gate if enough else np.float32(1e30)
        pixels[PLACE + x] = -one
    for t in range(count):
        _find_glossy(frames[t], np.float32(t), pixels)
    excess, found = np.zeros(CHUNK + NEAR - 1, np.float32), False
    for t in range(count):
        if _any_place(pixels, np.float32(t)):
            found = True
            _drop_highlight(frames[t], np.float32(t), pixels, margins, excess)
    if found:
        solve_frames(frames, equations, pixels)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def reject(frame, coefficients, pixels):    # type: ignore[no-untyped-def]
    """Weight (w_temp times Huber) and reflectance factor of one frame for the present g."""
    zero, one = np.float32(0), np.float32(1)
    least_cosine, least_half = np.float32(LEAST_COSINE), np.float32(LEAST_HALF)
    for x in range(CHUNK):
        g0, g1, g2 = pixels[G0 + x], pixels[G1 + x], pixels[G2 + x]
        length, inverse = pixels[LENGTH + x], pixels[INVERSE + x]
        cosine = (g0 * frame[D0 + x] + g1 * frame[D1 + x] + g2 * frame[D2 + x]) * inverse
        half = (g0 * frame[H0 + x] + g1 * frame[H1 + x] + g2 * frame[H2 + x]) * inverse
        f = departure(coefficients, min(max(cosine, least_cosine), one),
                      min(max(half, least_half), one))
        value, usable = frame[U + x], frame[USABLE + x]
        predicted = f * cosine * length
        fits = ((cosine >= least_cosine) & (half >= least_half)
                & (value > np.float32(LEAST_RATIO) * predicted)
                & (value < np.float32(MOST_RATIO) * predicted))
        limit = np.float32(HUBER) * length
        weight = usable * limit / max(abs(value - predicted), limit)
        frame[WEIGHT + x] = weight if fits else zero
        frame[FACTOR + x] = f


@numba.njit(nogil=True, cache=True)
def refine(frames, coefficients, rounds, equations, pixels):    # type: ignore[no-untyped-def]
    """Repeat rejection, Huber weights and solution against the object's reflectance."""
    for _ in range(rounds):
        for t in range(frames.shape[0]):
            reject(frames[t], coefficients, pixels)
        if frames.shape[0] >= MANY:
            keep_darkest(frames)
        solve_frames(frames, equations, pixels)


@numba.njit(nogil=True, cache=True)
def estimate(frames, coefficients, margins, rounds, rejecting, reflecting, equations, pixels):    # type: ignore[no-untyped-def]
    """Robust scaled normals of a chunk: ``pixels`` hold LS on entry and the estimate on return.

    :param frames: (T, FRAME_SIZE), U to USABLE filled; returns WEIGHT and FACTOR.
    :param coefficients: (10,) float32 of the reflectance, for ``reflecting``.
    :param margins: (2,) excess over Lambert's law, relative to |g|, that noise explains: of a
        pixel, of the mean of NEAR pixels.
    """
    for t in range(frames.shape[0]):
        frame = frames[t]
        for x in range(CHUNK):
            frame[WEIGHT + x], frame[FACTOR + x] = 1, 1
    if not rejecting:
        return
    if frames.shape[0] >= MANY:
        first_of_many(frames, equations, pixels)
    else:
        first_of_few(frames, margins, equations, pixels)
        for t in range(frames.shape[0]):         # what the first test dropped stays dropped
            frame = frames[t]
            for x in range(CHUNK):
                frame[USABLE + x] = frame[WEIGHT + x]
    if reflecting:
        refine(frames, coefficients, rounds, equations, pixels)


@numba.njit(nogil=True, cache=True)
def estimate_samples(u, d, h, usable, coefficients, margins, rounds, rejecting, reflecting, g,    # type: ignore[no-untyped-def]
                     first, last):
    """`estimate` for samples ``first`` to ``last``: u, usable (T, P), d, h (T, 3, P), g (3, P).

    Samples have no neighbours: ``margins[1]`` must be infinite.
    """
    count = len(u)
    frames = np.empty((count, FRAME_SIZE), np.float32)
    equations, pixels = np.empty(EQUATION_SIZE, np.float32), np.empty(PIXEL_SIZE, np.float32)
    for begin in range(first, last, CHUNK):
        for x in range(CHUNK):
            p = min(begin + x, last - 1)
            for t in range(count):
                frame = frames[t]
                frame[U + x], frame[USABLE + x], frame[E + x] = u[t, p], usable[t, p], 1
                for m in range(3):
                    frame[D0 + m * CHUNK + x] = d[t, m, p]
                    frame[H0 + m * CHUNK + x] = h[t, m, p]
            for m in range(3):
                pixels[m * CHUNK + x] = g[m, p]
        estimate(frames, coefficients, margins, rounds, rejecting, reflecting, equations, pixels)
        for x in range(min(CHUNK, last - begin)):
            for m in range(3):
                g[m, begin + x] = pixels[m * CHUNK + x]
