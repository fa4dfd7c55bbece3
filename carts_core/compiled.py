"""Compilation of kernels with numba."""

import os
import sys
from collections.abc import Callable
from typing import Any

import numba

_SAID = "CARTS_COMPILED_UNCACHED"
"""Environment variable that suppresses the warning in child processes after it was printed."""


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function with numba, with a cache on disk.

    If neither the module's folder nor the user's cache is writable, each process compiles the function again, which
    takes seconds; a warning is printed once on standard error.
    """
    options: dict[str, Any] = {"nogil": True, "fastmath": False, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
    if _SAID not in os.environ:
        os.environ[_SAID] = "1"
        print(
            "note: compiled functions cannot be cached, because neither the installation nor the home folder is "
            "writable; each start takes a few seconds longer. Set NUMBA_CACHE_DIR to a writable folder.",
            file=sys.stderr,
        )
    return numba.njit(**options)(function)
