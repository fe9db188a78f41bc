"""Case-insensitive lookup of names that the user typed. An error suggests similar names."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import click


def find(typed: str, names: Sequence[str], kind: str) -> int:
    """Return the index in `names` of a name that the user typed. Upper and lower case need not match.

    Args:
        typed: Name as the user typed it.
        names: All valid names.
        kind: Noun for the error message, for example "joint".

    Raises:
        click.UsageError: If the name is unknown. The message lists all valid names and similar names.
    """
    lower = [name.lower() for name in names]
    try:
        return lower.index(typed.strip().lower())
    except ValueError:
        near = [names[lower.index(name)] for name in difflib.get_close_matches(typed.lower(), lower, 3)]
        hint = f" Did you mean {' or '.join(near)}?" if near else ""
        raise click.UsageError(f"{kind} must be one of {', '.join(names)}, got {typed!r}.{hint}") from None
