"""Lookup of names that a user types: case-insensitive, with suggestions for an unknown name."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import click


def find(typed: str, names: Sequence[str], kind: str) -> int:
    """Return the index of a name in `names`, ignoring case.

    Args:
        typed: Name as the user typed it.
        names: All valid names.
        kind: Kind of the named thing for the error message, e.g. "joint".

    Raises:
        click.UsageError: If the name is unknown; the message lists similar names and all valid names.
    """
    lower = [name.lower() for name in names]
    try:
        return lower.index(typed.strip().lower())
    except ValueError:
        near = [names[lower.index(name)] for name in difflib.get_close_matches(typed.lower(), lower, 3)]
        hint = f" Did you mean {' or '.join(near)}?" if near else ""
        raise click.UsageError(f"{kind} must be one of {', '.join(names)}, got {typed!r}.{hint}") from None
