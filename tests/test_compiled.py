"""Machine code and interpreter give the same numbers; without a compiler there is none, and a cache that is kept."""

from __future__ import annotations

from pathlib import Path

import casadi
import numpy as np
import pytest

from atalante_control.generation import compiled as module
from atalante_control.generation.compiled import cache_directory, compiled
from atalante_control.generation.programme import Functions, Programme, Rows


@pytest.fixture(scope="module")
def functions() -> Functions:
    programme = Programme(3, casadi.SX.sym("p", 1))
    x = casadi.SX.sym("x", 3)
    # Sums of products: what a contraction to fused multiply-adds would round differently.
    value = x[0] * x[1] + x[1] * x[2] + casadi.sin(x[0]) * x[2]
    programme.add([Rows("one", "m", 1.0, value, np.zeros(1), np.ones(1))], x, [np.arange(3)])
    programme.minimise(casadi.sumsqr(x) * value, x, [np.arange(3)], np.ones(1))
    return programme.functions()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(module.CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_same_bits_as_the_interpreter(functions: Functions, cache: Path) -> None:
    machine = compiled(functions)
    assert machine is not None, "this machine has no gcc"
    random = np.random.default_rng(2)
    for _ in range(50):
        arguments = [random.normal(size=3), [0.3], 0.7, random.normal(size=1)]
        for one, other in zip(functions, machine, strict=True):
            given = arguments[: one.n_in()]
            expected, found = one.call([casadi.DM(a) for a in given]), other.call([casadi.DM(a) for a in given])
            for a, b in zip(expected, found, strict=True):
                assert np.array(a).tobytes() == np.array(b).tobytes()


def test_compiled_once(functions: Functions, cache: Path) -> None:
    assert compiled(functions) is not None
    [library] = cache.iterdir()
    written = library.stat().st_mtime_ns
    assert compiled(functions) is not None
    assert [path.stat().st_mtime_ns for path in cache.iterdir()] == [written]


def test_other_options_are_another_library(functions: Functions, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled(functions)
    monkeypatch.setattr(module, "OPTIONS", (*module.OPTIONS, "-g0"))
    compiled(functions)
    assert len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("compiler", ["no-such-compiler", "false"])
def test_none_without_a_compiler_that_works(
    functions: Functions, cache: Path, monkeypatch: pytest.MonkeyPatch, compiler: str
) -> None:
    monkeypatch.setattr(module, "COMPILER", compiler)
    assert compiled(functions) is None


def test_none_where_nothing_can_be_kept(functions: Functions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv(module.CACHE_VARIABLE, str(blocked))
    assert compiled(functions) is None


def test_the_cache_is_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(module.CACHE_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_directory() == tmp_path / "atalante"
