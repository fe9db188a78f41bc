"""Optional dependencies of the commands: the packages of the gait optimisation, and matplotlib for pictures."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager

from atalante_tools.console.outcome import Failed


@contextmanager
def extra() -> Iterator[None]:
    """Replace the import error of a package of the gait optimisation with an error that shows the install command.

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


def require_matplotlib() -> None:
    """Check that a picture can be drawn. A command calls this function before its work, so that no result is lost.

    Raises:
        Failed: If matplotlib is not installed.
    """
    try:
        importlib.import_module("matplotlib")
    except ModuleNotFoundError as error:
        raise Failed(
            f"a picture needs the package {error.name}: install it with `pip install 'atalante-hal[plot]'`"
        ) from error
