"""Hot loops as machine code: `compiled(function)` is the same function, compiled by numba when it is first called.

The source stays plain Python, one copy of it: tests that look into it (coverage, mutation), debuggers and profilers run it as it
stands when NUMBA_DISABLE_JIT=1 is set, with the same results. Functions it calls are compiled with it. What was compiled is kept
in the user's cache under a fingerprint of everything it was made from, callees and constants included, so a second start does
not compile and a change of any of it is never missed. Code is generic for its architecture: one machine's results are
another's, and one cache serves an emulated kernel, too.
"""

from __future__ import annotations

import hashlib
import logging
import os
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numpy as np

_log = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """The function as machine code: numbers and arrays in, numbers and arrays out. Bounds are checked, as in Python.

    Call it once with what it will be given before time matters: types it has not seen are compiled when they come. What is not
    in the cache takes seconds and is logged as information.
    """
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return function
    return cast(Function, _compiled(function))


@cache
def _compiled(function: FunctionType) -> Any:
    import numba

    config: Any = numba.config
    config.CPU_NAME, config.CPU_FEATURES = "generic", ""
    folder = _folder(function)
    config.CACHE_DIR = str(folder or "")
    if folder is None or not any(folder.iterdir()):
        _log.info("%s.%s is compiled", function.__module__, function.__qualname__)
    return numba.njit(boundscheck=True, cache=folder is not None)(_twin(function))


def _twin(function: FunctionType) -> FunctionType:
    """A copy of the function whose callees are compiled ones."""
    names = {name: value for name, value in function.__globals__.items() if name != function.__name__}
    for name, callee in _callees(function):
        names[name] = _callee(callee)
    twin = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
    twin.__module__, twin.__qualname__ = function.__module__, function.__qualname__
    return twin


@cache
def _callee(function: FunctionType) -> Any:
    """A compiled callee, one for all its callers."""
    import numba

    return numba.njit(boundscheck=True)(_twin(function))


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _callees(function: FunctionType) -> Iterator[tuple[str, FunctionType]]:
    """Python functions a function calls, by name."""
    for name in dict.fromkeys(_names(function.__code__)):
        value = function.__globals__.get(name)
        if isinstance(value, FunctionType):
            yield name, value


def _made_from(function: FunctionType) -> Iterator[bytes]:
    """Everything the machine code of a function depends on."""
    yield function.__qualname__.encode()
    yield function.__code__.co_code + repr(_constants(function.__code__)).encode()
    for name in dict.fromkeys(_names(function.__code__)):
        value = function.__globals__.get(name)
        if isinstance(value, FunctionType):
            yield from _made_from(value)
        elif isinstance(value, np.ndarray):
            yield value.tobytes()
        elif name in function.__globals__ and not isinstance(value, ModuleType | type):
            yield f"{name}={value!r}".encode()


def _constants(code: CodeType) -> tuple[Any, ...]:
    return tuple(_constants(c) if isinstance(c, CodeType) else c for c in code.co_consts) + code.co_names


def _folder(function: FunctionType) -> Path | None:
    """Where the machine code of a function is kept; None: nowhere, this user has no place that can be written."""
    import numba

    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for part in _made_from(function):
        digest.update(part + b"\0")
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "atalante", "compiled")
    folder = base / f"{function.__name__.strip('_')}-{digest.hexdigest()[:16]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None
