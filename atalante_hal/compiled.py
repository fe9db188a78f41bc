"""Compilation of numeric functions to machine code with numba, at their first call.

The source stays plain Python. With NUMBA_DISABLE_JIT=1 it runs uncompiled and gives the same results, for debuggers,
profilers, coverage and mutation tests. The functions that a compiled function calls are compiled, too. The machine code
of each function is cached in a folder of the user's cache directory. The folder name contains a hash of the function,
its callees and its constants. So a second start does not compile, and every change leads to a new compilation. The machine
code uses only instructions that all processors of an architecture have. So all machines of one architecture give the same
results, and a virtual machine can use the cache of its host.

*Reference counts.* By default, numba counts the references to each array that a function passes to another function, because
the last user of an array must free it. The counting takes most of the time of a kernel that calls small functions. Therefore
`specialised` compiles a function without reference counts. numba refuses this for a function that creates an array.
Such a function is compiled with reference counts.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

_log = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])
P = ParamSpec("P")
R = TypeVar("R")

#: Name of an empty file that marks the cache folder of a function that creates arrays.
#: `specialised` compiles a function with numba's reference counting if the function creates arrays, otherwise without it.
_MARK = "creates-arrays"
#: Function given to `specialised` -> whether the function creates arrays. If True, numba must count references to arrays.
_CREATES_ARRAYS: dict[Callable[..., Any], bool] = {}
#: Functions whose machine code releases the interpreter lock, see `releases_gil`.
_RELEASES_GIL: set[Callable[..., Any]] = set()


def releases_gil(function: Function) -> Function:
    """Decorate a function whose machine code releases the interpreter lock, so that other threads run during a call.

    No other thread may use the arguments of a call before the call returns.

    Args:
        function: Function to compile with `compiled` or `specialised`.
    """
    _RELEASES_GIL.add(function)
    return function


def compiled(function: Function) -> Function:
    """Return the function compiled to machine code; array bounds are checked, as in Python.

    A call with new argument types compiles again. So call the function once with its real argument types before timing matters.
    A compilation that is not in the cache takes seconds and is logged at level INFO.

    Args:
        function: Function of numbers and arrays that returns numbers and arrays.

    Returns:
        The compiled function; `function` itself if NUMBA_DISABLE_JIT is set.
    """
    return function if interpreted(function) else cast(Function, _compiled(function, True))


def interpreted(_function: Callable[..., Any]) -> bool:
    """Return whether NUMBA_DISABLE_JIT is set, so that each function runs as plain Python."""
    return os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")


def specialised(function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> Callable[P, R]:
    """Call a function once, and return its machine code for the types of the given arguments.

    A call of this machine code skips numba's type dispatch, and so saves about 0.7 us for each `NamedTuple`. But it does not
    check the types: arrays with another dtype, number of dimensions or memory layout lead to undefined behaviour. So pass
    only arrays that the caller allocated itself, or has checked. An array that the function only reads may be read-only, also if
    the array of the first call was writable.

    Args:
        function: Function to compile, see `compiled`.
        *args: Arguments of the first call, whose results are discarded.
        **kwargs: Must be empty, because machine code takes positional arguments only.
    """
    if interpreted(function):
        function(*args, **kwargs)
        return function
    counted = _CREATES_ARRAYS.get(function)
    if counted is None:
        counted = _CREATES_ARRAYS[function] = _is_marked(function)
    if not counted:
        try:
            return cast(Callable[P, R], _machine_code(function, args, False))
        except _numba().core.errors.NumbaError:  # raised if the function creates an array, or if the call is wrong
            pass
    code = cast(Callable[P, R], _machine_code(function, args, True))
    if not counted:  # the compilation without reference counts has failed, so the function creates an array
        _CREATES_ARRAYS[function] = True
        _mark(function)
    return code


def _machine_code(function: Callable[..., Any], args: tuple[Any, ...], counted: bool) -> Any:
    """Compile a function, call it once, and return its machine code for the types of the arguments."""
    dispatcher = _compiled(function, counted)
    dispatcher(*args)
    if len(dispatcher.overloads) == 1:  # numba compiled the function for one set of types, so return this machine code
        (only,) = dispatcher.overloads.values()
        return only.entry_point
    return dispatcher.get_overload(tuple(dispatcher.typeof_pyval(arg) for arg in args))


@cache
def _numba() -> Any:
    """Import numba, but prevent it from importing scipy.linalg, which takes long.

    Importing scipy.linalg takes a tenth of the time from the start of the program to the first cycle of a walk. When numba loads
    its array functions, it imports scipy.linalg only to learn whether BLAS is available. An empty module in place of
    `scipy.linalg.cython_blas` answers this question, and is removed after the import. A function that needs BLAS imports
    scipy.linalg when it is compiled.
    """
    blas = "scipy.linalg.cython_blas"
    if blas in sys.modules or find_spec("scipy") is None:
        import numba

        return numba
    sys.modules[blas] = ModuleType(blas)
    try:
        import numba
        import numba.np.arraymath
    finally:
        del sys.modules[blas]
    return numba


@cache
def _compiled(function: FunctionType, counted: bool) -> Any:
    """Return a function wrapped by `numba.njit`. The wrapper compiles the function at its first call.

    Args:
        function: Function to compile.
        counted: Whether the machine code counts the references to arrays. Must be True if the function creates arrays.
    """
    numba = _numba()
    config: Any = numba.config
    config.CPU_NAME, config.CPU_FEATURES = "generic", ""
    folder = _folder(function, counted)
    config.CACHE_DIR = str(folder or "")
    options = {"boundscheck": True, "nogil": function in _RELEASES_GIL, "cache": folder is not None, "_nrt": counted}
    dispatcher = numba.njit(**options)(_twin(function, counted))
    _report_compilations(dispatcher)
    return dispatcher


def _report_compilations(dispatcher: Any) -> None:
    """Log each compilation of a function by numba, just before it begins.

    The cache folder does not show whether numba will compile. numba also compiles a function if another part of its source file
    changed, for example by an update, and for new types of arguments.

    Args:
        dispatcher: Function wrapped by `numba.njit`.
    """
    from numba.core import event

    class Reporter(event.Listener):
        """Listener of the event that numba triggers before and after each compilation."""

        def on_start(self, started: Any) -> None:
            """Log the compilation of `dispatcher`, but not the compilations of the functions that `dispatcher` calls."""
            if started.data["dispatcher"] is dispatcher:
                _log.info("compiling %s.%s", dispatcher.py_func.__module__, dispatcher.py_func.__qualname__)

        def on_end(self, _ended: Any) -> None:
            """Ignore the end of a compilation."""

    register: Callable[..., None] = event.register
    register("numba:compile", Reporter())


def _mark(function: Callable[..., Any]) -> None:
    """Create the file `_MARK` in the cache folder of a function that creates arrays."""
    folder = _folder(cast(FunctionType, function), False)
    if folder is not None:
        (folder / _MARK).touch()


def _is_marked(function: Callable[..., Any]) -> bool:
    """Return whether the cache folder records that a function creates arrays, see `_MARK`."""
    folder = _folder(cast(FunctionType, function), False)
    return folder is not None and (folder / _MARK).exists()


def _twin(function: FunctionType, counted: bool) -> FunctionType:
    """Return a copy of a function in which each called function is replaced by its compiled form."""
    names = {name: value for name, value in function.__globals__.items() if name != function.__name__}
    for name, callee in _callees(function):
        names[name] = _callee(callee, counted)
    twin = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
    twin.__module__, twin.__qualname__ = function.__module__, function.__qualname__
    return twin


@cache
def _callee(function: FunctionType, counted: bool) -> Any:
    """Return the compiled form of a called function. Each function is compiled once for all its callers."""
    return _numba().njit(boundscheck=True, _nrt=counted)(_twin(function, counted))


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _callees(function: FunctionType) -> Iterator[tuple[str, FunctionType]]:
    """Yield the name and the object of each Python function that a function calls."""
    for name in dict.fromkeys(_names(function.__code__)):
        value = function.__globals__.get(name)
        if isinstance(value, FunctionType):
            yield name, value


def _compile_inputs(function: FunctionType) -> Iterator[bytes]:
    """Yield everything that determines the machine code, as bytes: code, constants, record types, globals, called functions."""
    yield function.__qualname__.encode()
    yield function.__code__.co_code + repr(_constants(function.__code__)).encode()
    yield from _records(function.__annotations__, function.__globals__)
    for name in dict.fromkeys(_names(function.__code__)):
        value = function.__globals__.get(name)
        if isinstance(value, FunctionType):
            yield from _compile_inputs(value)
        elif isinstance(value, np.ndarray):
            yield value.tobytes()
        elif name in function.__globals__ and not isinstance(value, ModuleType | type):
            yield f"{name}={value!r}".encode()


def _records(annotations: Mapping[str, Any], names: Mapping[str, Any]) -> Iterator[bytes]:
    """Yield the fields of each `NamedTuple` in the annotations, because numba's cache does not compare these fields."""
    for name in dict.fromkeys(re.findall(r"\w+", " ".join(map(str, annotations.values())))):
        record = names.get(name)
        if isinstance(record, type) and issubclass(record, tuple) and hasattr(record, "_fields"):
            yield f"{record.__qualname__}{record._fields}".encode()
            yield from _records(record.__annotations__, vars(sys.modules[record.__module__]))


def _constants(code: CodeType) -> tuple[Any, ...]:
    return tuple(_constants(c) if isinstance(c, CodeType) else c for c in code.co_consts) + code.co_names


def _folder(function: FunctionType, counted: bool = True) -> Path | None:
    """Return the cache folder for the machine code of a function; None if the user's cache is not writable.

    Args:
        function: Function to compile.
        counted: Whether the machine code counts references.
    """
    digest = hashlib.sha256(f"{_numba().__version__} {sys.version}".encode())
    for part in _compile_inputs(function):
        digest.update(part + b"\0")
    if function in _RELEASES_GIL:
        digest.update(releases_gil.__name__.encode())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "atalante", "compiled")
    folder = base / f"{function.__name__.strip('_')}-{digest.hexdigest()[:16]}{'' if counted else '-uncounted'}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None
