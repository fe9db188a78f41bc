"""Compiler of the functions of the nonlinear program: `CasADi functions -> C -> gcc -> shared library in a cache`.

Interpreted and compiled functions execute the same operations in the same order, without fused multiply-add. The gaits
are therefore the same. If there is no compiler, or if the compilation fails, the interpreted functions are used.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import casadi

from atalante_control.gait_optimization.nlp import Functions

COMPILER = "gcc"
#: Compiler options. With -O0, the functions (60,000 C statements) compile in 13 s and run 4 times as fast as in the interpreter.
#: With -O1, the functions would compile in 95 s and run twice as fast as with -O0.
#: But the solver would take only 10 % less time than with -O0.
#: -ffp-contract=off disables fused multiply-adds.
#: Without fused multiply-adds, the compiled functions round after each multiplication, as the interpreter does.
OPTIONS = ("-O0", "-fPIC", "-shared", "-ffp-contract=off")
CACHE_VARIABLE = "ATALANTE_CACHE"


def cache_directory() -> Path:
    """Return the directory of the compiled functions: $ATALANTE_CACHE if set, else a folder in the user's cache."""
    if given := os.environ.get(CACHE_VARIABLE):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "atalante"


def compiled(functions: Functions) -> Functions | None:
    """Compile functions to a shared library, or load the library from the cache.

    Args:
        functions: interpreted functions of the program.

    Returns:
        The compiled functions; None if they cannot be compiled or stored.
    """
    if shutil.which(COMPILER) is None:
        return None
    with tempfile.TemporaryDirectory() as directory:
        generator = casadi.CodeGenerator("gait.c", {"casadi_int": "long long int"})
        for function in functions:
            generator.add(function)
        source = Path(generator.generate(f"{directory}/"))
        text = source.read_bytes()
        key = hashlib.sha256(
            text + " ".join((*OPTIONS, platform.machine(), casadi.CasadiMeta.version())).encode()
        ).hexdigest()[:16]
        library = cache_directory() / f"gait-{key}.so"
        if not library.exists():
            built = Path(directory) / library.name
            command = (COMPILER, *OPTIONS, "-o", str(built), str(source), "-lm")
            if subprocess.run(command, capture_output=True, check=False).returncode != 0:
                return None
            try:
                library.parent.mkdir(parents=True, exist_ok=True)
                # The file is replaced atomically, because another process can write it at the same time.
                staged = library.with_suffix(f".{os.getpid()}")
                shutil.copy(built, staged)
                staged.replace(library)
            except OSError:
                return None
    return Functions(*(casadi.external(function.name(), str(library)) for function in functions))
