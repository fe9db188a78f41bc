"""Names as people type them: in any case, and with a hint when there is no such one."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import click


def find(typed: str, names: Sequence[str], what: str) -> int:
    """Place of a name in `names`, whatever its case.

    Raises:
        click.UsageError: with the nearest names and all there are.
    """
    lower = [name.lower() for name in names]
    try:
        return lower.index(typed.strip().lower())
    except ValueError:
        near = [names[lower.index(name)] for name in difflib.get_close_matches(typed.lower(), lower, 3)]
        hint = f" Did you mean {' or '.join(near)}?" if near else ""
        raise click.UsageError(f"there is no {what} {typed!r}.{hint} There are {', '.join(names)}.") from None
