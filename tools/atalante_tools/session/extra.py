"""Optional dependencies of the gait optimisation. The controller does not need these packages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from atalante_tools.console.outcome import Failed


@contextmanager
def extra() -> Iterator[None]:
    """Replace the import error of an optional dependency with an error that shows the install command.

    Raises:
        Failed: If casadi, joblib or scikit-learn is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("casadi", "joblib", "sklearn"):
            raise
        raise Failed(
            f"the gait optimisation needs the package {error.name}: install it with `pip install 'atalante-hal[gaits]'`"
        ) from error
