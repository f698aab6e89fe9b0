"""How the kernels are compiled, and from when on."""

import gc
from collections.abc import Callable
from functools import cached_property, partial
from types import FunctionType

import numpy as np
from numba import config, njit
from numba.core import event

_FEW = 5000  # numbers; Python fills as many of a bed, two of the paper's, in 75 ms
# functions that Python does not call need no wrappers, which cost a fifth and more of the time to compile
compiled = partial(njit, cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)
inner = partial(compiled, no_cpython_wrapper=True)


class _Deferred:
    """A function that fills its last argument: run by Python, to the same bits, until it has filled a few numbers.

    That spares the first simulation what takes longest: the bed takes 1.6 s to compile, and its compiled code 12 ms to
    load from numba's cache.
    """

    def __init__(self, function: Callable, how: dict):
        self._function, self._compiled, self._filled = function, compiled(**how)(function), 0

    def __call__(self, *given):
        self._filled += given[-1].size
        if self._filled > _FEW:
            return self._compiled(*given)
        with np.errstate(all="ignore"):  # as compiled code, which says nothing of a division by zero
            return self._plain(*given)

    @cached_property
    def _plain(self) -> Callable:
        """The function as Python runs it, and all that it calls."""
        names = dict(self._function.__globals__)
        for name, one in names.items():
            names[name] = FunctionType(one.py_func.__code__, names) if hasattr(one, "py_func") else one
        return FunctionType(self._function.__code__, names)


def deferred(**how) -> Callable:
    """Return a decorator as `compiled` with these options, for functions that are compiled once they are worth it."""
    return lambda function: function if config.DISABLE_JIT else _Deferred(function, how)


class _Uncollected(event.Listener):
    """Lets no garbage be collected while numba compiles a function of ours: it takes a tenth of the time."""

    def __init__(self):
        self.collecting = []

    def on_start(self, compiling):
        if _is_ours(compiling):
            self.collecting.append(gc.isenabled())
            gc.disable()

    def on_end(self, compiling):
        # another thread may have compiled when this was imported
        if _is_ours(compiling) and self.collecting and self.collecting.pop():
            gc.enable()


def _is_ours(compiling: event.Event) -> bool:
    return str(compiling.data["dispatcher"].py_func.__module__).startswith("hpgr.")  # it is None of some


event.register("numba:compile", _Uncollected())
