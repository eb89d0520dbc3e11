"""What the compiled kernels of the fake camera have in common."""
import threading
from typing import Any

#: Options of numba.njit for sums of light: without a check of every division the compiler can
#: take several emitters at once.
FAST: dict[str, Any] = {'cache': True, 'fastmath': True, 'error_model': 'numpy'}

#: Pixels in shadow cost more, and lie together. So the picture is dealt to the threads in runs of
#: RUN pixels, a few lines of the cache, in TURNS hands.
TURNS, RUN = 64, 64

# numba's fallback threading layer aborts the process when two threads run parallel kernels
KERNEL_LOCK = threading.Lock()
