"""Pytest plugin that runs the compiled functions of the safety core as plain Python: coverage cannot measure machine code.

All other compiled functions stay compiled: some of them take minutes without machine code.
"""

from __future__ import annotations

from core import CORE

import atalante_hal.compiled as compilation
from atalante_hal.compiled import Function

_compiled = compilation.compiled
_CORE_MODULES = {file.removesuffix(".py").replace("/", ".") for files, _ in CORE.values() for file in files}


def _compiled_outside_the_core(function: Function) -> Function:
    return function if function.__module__ in _CORE_MODULES else _compiled(function)


# A plugin of the command line is imported before the modules that use `compiled`.
compilation.compiled = _compiled_outside_the_core
