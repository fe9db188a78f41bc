"""Optional dependencies of the gait optimisation, which are not needed to walk a gait."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from atalante_tools.console.outcome import Failed


@contextmanager
def extra() -> Iterator[None]:
    """Import optional dependencies inside this context; a missing one becomes an error with the install command.

    Raises:
        Failed: If casadi, joblib or scikit-learn is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("casadi", "joblib", "sklearn"):
            raise
        raise Failed(
            f"solving gaits needs {error.name}: install it with `pip install 'atalante-hal[gaits]'`"
        ) from error
