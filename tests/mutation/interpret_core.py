"""Pytest plugin that runs the compiled functions of the safety core as plain Python: coverage cannot measure machine code.

All other compiled functions stay compiled: some of them take minutes without machine code.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from core import CORE

import atalante_hal.compiled as compilation

_interpreted = compilation.interpreted
_CORE_MODULES = {file.removesuffix(".py").replace("/", ".") for files, _ in CORE.values() for file in files}


def _interpreted_in_the_core(function: Callable[..., Any]) -> bool:
    return function.__module__ in _CORE_MODULES or _interpreted(function)


compilation.interpreted = _interpreted_in_the_core
