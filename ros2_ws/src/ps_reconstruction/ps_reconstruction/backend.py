"""Where a GPU version of the heavy kernels plugs in; without one the compiled CPU loops run.

A plug-in is an installed package with an entry point of the group ``ps_reconstruction.backend``,
for instance ``cuda``, that names a module. The environment variable PS_BACKEND chooses it. The
module has functions with the names, arguments and results of those it replaces, arrays in, arrays
out, any of

    solve_pixels, combine_patches, finish      (stv_kernels.py)
    solve_poisson                              (integration.py)

and may have WHOLE = True to be given the whole picture at a time instead of bands of rows. Results
must agree with the CPU's to 0.01 degrees. No such package exists yet: this one was written where
no GPU was at hand to test it.
"""
from collections.abc import Callable
import functools
from importlib.metadata import entry_points
import logging
import os
from typing import Any

GROUP = 'ps_reconstruction.backend'


def kernel(name: str, on_cpu: Callable[..., Any]) -> Callable[..., Any]:
    """The chosen plug-in's function of this name, else the given one."""
    found: Callable[..., Any] = getattr(_plugin(os.environ.get('PS_BACKEND', '')), name, on_cpu)
    return found


def band_rows(height: int, on_cpu: int) -> int:
    """Rows per call of the kernels: all for a plug-in that wants it so."""
    return height if getattr(_plugin(os.environ.get('PS_BACKEND', '')), 'WHOLE', False) else on_cpu


@functools.cache
def _plugin(name: str) -> Any:
    """The module of a plug-in; None, logged once, where it cannot be used."""
    if name in ('', 'cpu'):
        return None
    log = logging.getLogger('ps_reconstruction')
    try:
        [entry] = entry_points(group=GROUP, name=name)
        module = entry.load()
    except Exception as error:      # a driver that is missing may raise anything
        reason = (f'{type(error).__name__}: {error}' if entry_points(group=GROUP, name=name)
                  else 'no such plug-in is installed')
        log.warning('PS_BACKEND=%s cannot be used (%s); the CPU does the work', name, reason)
        return None
    log.info('PS_BACKEND=%s is used', name)
    return module
