"""The strict loader's verdict as findings: what a receiver could misread, each with its line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import atalante_dbc

_LINE = re.compile(r"at line (\d+)")


@dataclass(frozen=True)
class Finding:
    """One broken rule; `line` is None when the file as a whole is meant."""

    line: int | None
    text: str


def findings(path: Path) -> list[Finding]:
    """Why `path` is refused, in the order of its lines; empty: the loader takes it."""
    try:
        atalante_dbc.load(path)
    except atalante_dbc.DbcError as error:
        return [_finding(path, line) for line in str(error).splitlines()]
    return []


def _finding(path: Path, line: str) -> Finding:
    text = line.removeprefix(f"{path}:")
    number, colon, rest = text.partition(":")
    if colon and number.isdigit():
        return Finding(int(number), rest.strip())
    found = _LINE.search(text)  # as the parser says it
    return Finding(int(found[1]) if found else None, text.strip())
