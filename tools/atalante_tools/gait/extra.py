"""The extra that makes gaits may be missing: walking them does without."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from atalante_tools.console.outcome import Failed


@contextmanager
def extra() -> Iterator[None]:
    """Imports of what makes gaits: a library that is missing becomes a sentence that says what to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("casadi", "joblib", "sklearn"):
            raise
        raise Failed(f"making gaits needs {error.name}: type `pip install 'atalante-hal[gaits]'`") from error
