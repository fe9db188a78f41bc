"""The program's functions as machine code: `CasADi functions -> C -> gcc -> shared library, kept in a cache`.

Interpreted and compiled functions do the same operations in the same order, without contraction into fused ones, so a gait
is the same with either. Without a compiler, or when anything about it fails, the interpreted functions serve.
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
#: Functions of 60,000 statements: -O0 compiles them in 13 s to 4 times the interpreter's speed; -O1 takes 95 s for another
#: factor of 2, which is a tenth of a solve. Contracted multiply-adds would round differently.
OPTIONS = ("-O0", "-fPIC", "-shared", "-ffp-contract=off")
CACHE_VARIABLE = "ATALANTE_CACHE"


def cache_directory() -> Path:
    """Where compiled functions are kept: $ATALANTE_CACHE, else the user's cache directory."""
    if given := os.environ.get(CACHE_VARIABLE):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "atalante"


def compiled(functions: Functions) -> Functions | None:
    """The functions from a shared library, made once for their exact code; None where that cannot be had."""
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
                # In one move: another process may be doing the same.
                staged = library.with_suffix(f".{os.getpid()}")
                shutil.copy(built, staged)
                staged.replace(library)
            except OSError:
                return None
    return Functions(*(casadi.external(function.name(), str(library)) for function in functions))
