"""Compiled functions have the same results and errors as in Python, and the cache never returns outdated machine code."""

from __future__ import annotations

import math
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
import pytest

from atalante_hal import compiled as module
from atalante_hal.compiled import compiled, releases_gil, specialised

GAIN = 2.0


def _scaled(x: float) -> float:
    return x * GAIN


def total(values: Any, limit: float) -> float:
    sum_ = 0.0
    for i in range(len(values)):
        sum_ += min(limit, _scaled(values[i]))
    return sum_


def element(values: Any, index: int) -> float:
    return float(values[index])


def test_compiled_function_returns_the_same_as_python() -> None:
    values = np.random.default_rng(0).standard_normal(100)
    assert compiled(total)(values, 1.5) == total(values, 1.5)


def test_specialised_function_gives_the_same_result_and_checks_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(0).standard_normal(100)
    assert specialised(total, values, 0.0)(values, 1.5) == total(values, 1.5)
    with pytest.raises(IndexError):
        specialised(element, values, 0)(values, 100)
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert specialised(total, values, 1.5) is total


def test_specialised_function_has_the_types_of_its_own_call() -> None:
    reals, integers = np.array([0.5, 2.5]), np.array([3, 4])
    for values in (reals, integers, reals, integers):
        assert specialised(element, values, 0)(values, 1) == values[1]


def _doubled(values: Any) -> Any:
    return 2.0 * values


def _copied(source: Any, target: Any) -> None:
    target[:] = source


def _sum_of_first(values: Any, count: int) -> float:
    return total(values[:count], math.inf)


def test_specialised_function_may_create_arrays() -> None:
    values, target = np.arange(3.0), np.zeros(3)
    doubled, copied = specialised(_doubled, values), specialised(_copied, values, target)
    for _ in range(2):
        values += 1.0
        assert doubled(values).tolist() == (2.0 * values).tolist()
        copied(values, target)
        assert target.tolist() == values.tolist()


def test_specialised_function_counts_no_references_unless_it_creates_arrays(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # numba cannot show the code of a function from the cache
    values = np.arange(4.0)
    plain, creating = _changed(_sum_of_first), _changed(_doubled)
    assert specialised(plain, values, 2)(values, 3) == GAIN * 3.0
    specialised(creating, values)
    codes = [
        "".join(module._compiled(function, counted).inspect_llvm().values())
        for function, counted in ((plain, False), (creating, True))
    ]
    assert ["NRT_" in code for code in codes] == [False, True]


def test_only_a_decorated_function_releases_the_interpreter_lock(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # numba cannot show the code of a function from the cache
    values = np.arange(4.0)
    plain, decorated = _changed(_sum_of_first), releases_gil(_changed(_sum_of_first))
    for function, releases in ((plain, False), (decorated, True)):
        assert specialised(function, values, 2)(values, 3) == compiled(function)(values, 3) == GAIN * 3.0
        for counted in (False, True):
            code = "".join(module._compiled(function, counted).inspect_llvm().values())
            assert ("PyEval_SaveThread" in code) is releases


def test_calls_of_a_specialised_function_keep_the_reference_count_of_an_array() -> None:
    values = np.arange(4.0)
    first = specialised(_sum_of_first, values, 2)
    before = sys.getrefcount(values)
    for _ in range(100):
        first(values, 3)
        with pytest.raises(IndexError):
            specialised(element, values, 0)(values, 4)
    assert sys.getrefcount(values) == before


def run_twice(script: str, folder: Path) -> list[subprocess.CompletedProcess[str]]:
    """Run a script in two processes, one after the other, with the folder as working directory and as folder of the cache."""
    command, environment = [sys.executable, "-c", script], {"XDG_CACHE_HOME": str(folder), "PATH": "/usr/bin:/bin"}
    return [
        subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]


@pytest.mark.long
def test_second_process_does_not_compile_a_function_that_creates_arrays_again(tmp_path: Path) -> None:
    (tmp_path / "kernel.py").write_text("def double(x):\n    return 2.0 * x\n")
    script = (
        "import logging, numpy; logging.basicConfig(level=logging.INFO, format='%(message)s')\n"
        "from atalante_hal.compiled import specialised; from kernel import double\n"
        "print(specialised(double, numpy.ones(1))(numpy.ones(1)))"
    )
    logs = [done.stderr.splitlines() for done in run_twice(script, tmp_path)]
    assert logs == [["compiling kernel.double"] * 2, []]  # first without, then with reference counts


def test_wrong_specialised_function_raises_the_error_of_numba() -> None:
    from numba.core.errors import TypingError

    with pytest.raises(TypingError):
        specialised(total, 1.0, 1.0)


def test_function_with_a_wrong_call_is_not_marked_as_creating_arrays(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from numba.core.errors import TypingError

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    function = _changed(_sum_of_first)
    with pytest.raises(TypingError):
        specialised(function, 1.0, 1)
    assert not list(tmp_path.rglob(module._MARK))
    values = np.arange(4.0)
    assert specialised(function, values, 2)(values, 3) == GAIN * 3.0
    assert "NRT_" not in "".join(module._compiled(function, False).inspect_llvm().values())
    assert specialised(_changed(_doubled), values)(values).tolist() == (2.0 * values).tolist()
    assert len(list(tmp_path.rglob(module._MARK))) == 1


def test_function_is_compiled_only_once() -> None:
    assert compiled(total) is compiled(total)
    assert compiled(total) is not total


def test_index_out_of_bounds_raises_index_error() -> None:
    with pytest.raises(IndexError):
        compiled(element)(np.zeros(3), 3)


def test_division_by_zero_raises_zero_division_error() -> None:
    with pytest.raises(ZeroDivisionError):
        compiled(_inverse)(0.0)


def _inverse(x: float) -> float:
    return 1.0 / x


def test_switched_off_compiler_returns_the_python_function(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert compiled(total) is total


def test_function_is_compiled_without_a_writable_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "atalante").write_text("a file where the folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert module._folder(total) is None  # type: ignore[arg-type]
    assert compiled(_squared)(2.0) == 4.0


def _squared(x: float) -> float:
    return x * x


def _changed(function: Callable[..., Any], **names: object) -> FunctionType:
    assert isinstance(function, FunctionType)
    twin = FunctionType(function.__code__, {**function.__globals__, **names}, function.__name__)
    twin.__module__, twin.__qualname__ = function.__module__, function.__qualname__
    return twin


def _other_scaled(x: float) -> float:
    return x * GAIN + 1.0


_other_scaled.__name__ = _other_scaled.__qualname__ = "_scaled"


@pytest.mark.parametrize(
    "changed",
    [
        _changed(total, _scaled=_changed(_scaled, GAIN=3.0)),
        _changed(total, _scaled=_other_scaled),
        _changed(total, _scaled=_changed(_scaled, GAIN=np.float32(2.0))),
    ],
    ids=["constant of a callee", "body of a callee", "type of a constant"],
)
def test_every_source_change_gets_another_cache_folder(
    changed: FunctionType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert module._folder(total) != module._folder(changed)  # type: ignore[arg-type]
    assert module._folder(total) == module._folder(_changed(total))  # type: ignore[arg-type]


class _Bounds(NamedTuple):
    low: float
    high: float


class _Reversed(NamedTuple):
    high: float
    low: float


def _span(bounds: _Bounds) -> float:
    return bounds.high - bounds.low


def test_other_order_of_record_fields_gets_another_cache_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    reordered = _changed(_span, _Bounds=_Reversed)
    reordered.__annotations__ = _span.__annotations__
    assert module._folder(_span) != module._folder(reordered)  # type: ignore[arg-type]
    assert compiled(_span)(_Bounds(1.0, 3.0)) == 2.0


def test_compilation_is_logged_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    caplog.set_level("INFO", logger=module.__name__)
    for _ in range(2):
        assert compiled(_changed(_cubed))(2.0) == 8.0
    assert [record.getMessage() for record in caplog.records] == [f"compiling {__name__}._cubed"]


def test_compilation_after_a_change_elsewhere_in_the_file_is_logged(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """numba compiles all functions of a changed file again. The cache folder of an unchanged function is then not empty."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    caplog.set_level("INFO", logger=module.__name__)
    kernel = tmp_path / "kernel.py"
    for comment in ("", "", "# changed\n"):
        kernel.write_text("def square(x):\n    return x * x\n" + comment)
        assert compiled(runpy.run_path(str(kernel))["square"])(3.0) == 9.0
    assert [record.getMessage() for record in caplog.records] == ["compiling <run_path>.square"] * 2


def test_compilation_for_other_types_is_logged(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    caplog.set_level("INFO", logger=module.__name__)
    function = compiled(_changed(_cubed))
    for value in (2.0, 2.0, 2):
        assert function(value) == 8
    assert [record.getMessage() for record in caplog.records] == [f"compiling {__name__}._cubed"] * 2


def _cubed(x: float) -> float:
    return x * x * x


def test_second_process_loads_the_function_from_the_cache(tmp_path: Path) -> None:
    (tmp_path / "kernel.py").write_text("def square(x):\n    return x * x\n")
    script = (
        "from atalante_hal.compiled import compiled; from kernel import square; f = compiled(square); f(3.0);"
        "print(sum(f.stats.cache_hits.values()))"
    )
    hits = [done.stdout.strip() for done in run_twice(script, tmp_path)]
    assert hits == ["0", "1"]


RECORD = """
from typing import NamedTuple
import numpy as np
class Inner(NamedTuple):
    {fields}: float
class Outer(NamedTuple):
    inner: Inner
    values: np.ndarray
"""
KERNEL = """
from record import Outer
def first(outer: Outer) -> float:
    return outer.inner.a
"""


@pytest.mark.sample(2)
@pytest.mark.parametrize("future", ["", "from __future__ import annotations\n"], ids=["types", "texts"])
def test_reordered_fields_of_a_record_are_compiled_again(tmp_path: Path, future: str) -> None:
    script = (
        "from atalante_hal.compiled import compiled; import kernel, record, numpy\n"
        "print(compiled(kernel.first)(record.Outer(record.Inner(a=1.0, b=2.0), numpy.zeros(2))))"
    )
    (tmp_path / "kernel.py").write_text(future + KERNEL)
    for fields in ("a: float\n    b", "b: float\n    a"):
        (tmp_path / "record.py").write_text(future + RECORD.format(fields=fields))
        result = subprocess.run(
            [sys.executable, "-B", "-c", script],
            cwd=tmp_path,
            env={"XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
            capture_output=True,
            text=True,
            check=True,
        )
        assert result.stdout.strip() == "1.0"


def test_machine_code_is_for_a_generic_cpu() -> None:
    import numba

    compiled(total)
    assert (numba.config.CPU_NAME, numba.config.CPU_FEATURES) == ("generic", "")
    assert math.isfinite(compiled(total)(np.ones(2), 5.0))


WITHOUT_BLAS = """
import sys
import numpy as np
from atalante_hal.compiled import compiled
def product(a, b):
    return np.dot(a, b)
def plain(a):
    return a[0]
compiled(plain)(np.eye(2))
print("scipy.linalg" in sys.modules)
print(compiled(product)(2.0 * np.eye(2), np.ones((2, 2))).tolist())
"""


@pytest.mark.long
def test_blas_is_loaded_only_for_a_function_that_needs_it(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(WITHOUT_BLAS)
    result = subprocess.run(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        env={"XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.split("\n")[:2] == ["False", "[[2.0, 2.0], [2.0, 2.0]]"]
