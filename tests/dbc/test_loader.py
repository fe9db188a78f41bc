"""Loader of the network: its cache gives the parsed network, and never an old one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from atalante_dbc import DBC_FILE, DbcError, Network, loader, parser
from atalante_dbc.loader import load_cached


@pytest.fixture
def dbc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of a copy of the DBC whose cache is empty."""
    path = tmp_path / DBC_FILE.name
    path.write_bytes(DBC_FILE.read_bytes())
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.setattr(sys, "pycache_prefix", None)
    return path


def cache_files(dbc: Path) -> list[Path]:
    return [*(dbc.parent / "__pycache__").glob("*")]


@pytest.fixture
def no_parser(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path) -> Network:
        raise AssertionError(f"{path} must not be parsed")

    monkeypatch.setattr(parser, "parse", fail)


def test_second_load_reads_the_cache(dbc: Path, request: pytest.FixtureRequest):
    first, parsed = load_cached(dbc), parser.parse(DBC_FILE)
    assert len(cache_files(dbc)) == 1
    request.getfixturevalue("no_parser")
    assert load_cached(dbc) == first == parsed


def test_changed_dbc_is_parsed_again(dbc: Path):
    before = load_cached(dbc)
    dbc.write_text(dbc.read_text().replace("(0.0125,0)", "(0.025,0)"))
    after = load_cached(dbc)
    assert after != before
    assert after == parser.parse(dbc)


def test_invalid_dbc_is_rejected_and_not_cached(dbc: Path):
    load_cached(dbc)
    dbc.write_text(dbc.read_text().replace("(0.0125,0)", "(0,0)"))
    for _ in range(2):
        with pytest.raises(DbcError, match="factor"):
            load_cached(dbc)


@pytest.mark.parametrize("damage", [b"", b"\x00" * 100])
def test_damaged_cache_is_parsed_again(dbc: Path, damage: bytes):
    network = load_cached(dbc)
    (file,) = cache_files(dbc)
    intact = file.read_bytes()
    file.write_bytes(damage + intact[len(damage) : len(intact) - 1])
    assert load_cached(dbc) == network
    assert file.read_bytes() == intact


def test_parser_that_changed_invalidates_the_cache(dbc: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    network = load_cached(dbc)
    source = tmp_path / "parser.py"
    source.write_text("changed")
    monkeypatch.setattr(loader, "SOURCES", (source,))
    other = Network((), (), (), 1, 1, 0)
    monkeypatch.setattr(parser, "parse", lambda path: other)
    assert load_cached(dbc) == other != network


def test_load_without_a_writable_cache_parses(dbc: Path):
    (dbc.parent / "__pycache__").write_text("a file, so that no file can be written below it")
    assert load_cached(dbc) == parser.parse(DBC_FILE)


def test_python_that_writes_no_byte_code_writes_no_cache(dbc: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    load_cached(dbc)
    assert not cache_files(dbc)


def test_missing_dbc_is_an_error(dbc: Path):
    dbc.unlink()
    with pytest.raises(DbcError, match="cannot be read"):
        load_cached(dbc)


def test_cached_network_needs_no_import_of_cantools(tmp_path: Path):
    code = "import sys, atalante_dbc; atalante_dbc.load(); print('cantools' in sys.modules)"
    environment = {"PYTHONPYCACHEPREFIX": str(tmp_path)}
    run = [sys.executable, "-c", code]
    printed = [subprocess.run(run, env=environment, capture_output=True, text=True, check=True).stdout for _ in "ab"]
    assert printed == ["True\n", "False\n"]
