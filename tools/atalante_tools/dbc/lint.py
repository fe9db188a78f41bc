"""Errors that the DBC loader reports, as a list of findings. Each finding is one error with its line number."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import atalante_dbc

_LINE = re.compile(r"at line (\d+)")


@dataclass(frozen=True)
class Finding:
    """Error in a DBC file. The field `line` is None if the error concerns the whole file."""

    line: int | None
    text: str


def findings(path: Path) -> list[Finding]:
    """Return the errors in a DBC file in the order of its lines; empty if the loader accepts the file."""
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
    found = _LINE.search(text)  # the cantools parser writes the line number inside its error text
    return Finding(int(found[1]) if found else None, text.strip())
