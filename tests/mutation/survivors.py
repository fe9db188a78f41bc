"""Surviving mutants that are accepted: `SURVIVORS.md -> mutants with reasons`. Comments of the source code have no effect."""

from __future__ import annotations

import io
import re
import tokenize
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

SURVIVORS = Path(__file__).with_name("SURVIVORS.md")

_ENTRY = re.compile(r"^## `([^`]+)`\n\n```diff\n(.*?)\n```\n\n(\S.*?)(?=\n## |\Z)", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Mutant:
    """Mutant, identified by its change of the source code. The number that mutmut assigns depends on the other mutants."""

    function: str
    removed: tuple[str, ...]
    added: tuple[str, ...]

    def __str__(self) -> str:
        lines = [f"-{line}" for line in self.removed] + [f"+{line}" for line in self.added]
        return f"## `{self.function}`\n\n```diff\n" + "\n".join(lines) + "\n```\n"


def mutant(function: str, diff: Iterable[str]) -> Mutant:
    """Return a mutant from the lines of its diff.

    Args:
        function: name of the function, with its module.
        diff: lines that begin with `-`, `+` or a space.
    """
    changed = [(line[:1], without_comment(line[1:])) for line in diff if not line.startswith(("+++", "---"))]
    removed, added = (tuple(line for sign, line in changed if sign == wanted) for wanted in "-+")
    return Mutant(function, removed, added)


def listed() -> list[Mutant]:
    """Return the survivors listed in SURVIVORS.md. Two places of a function with the same change are two entries.

    Raises:
        ValueError: If a section has no diff or no reason.
    """
    text = SURVIVORS.read_text(encoding="utf-8")
    found = [mutant(name, diff.splitlines()) for name, diff, _ in _ENTRY.findall(text)]
    sections = text.count("\n## ")
    if len(found) != sections:
        raise ValueError(
            f"each of the {sections} sections of SURVIVORS.md must have a diff and a reason, {len(found)} have them"
        )
    return found


def without_comment(line: str) -> str:
    """Return a line of source code without indentation and comment. The line may be a part of a statement."""
    line = line.strip()
    try:
        for token in tokenize.generate_tokens(io.StringIO(line).readline):
            if token.type == tokenize.COMMENT:
                return line[: token.start[1]].rstrip()
    except tokenize.TokenError:
        pass  # the statement continues on the next line
    return line
