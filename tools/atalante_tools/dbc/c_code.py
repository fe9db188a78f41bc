"""C code generator: pack and unpack functions by cantools, E2E Profile 5 functions, and a host test with test vectors.

DBC -> Build -> NAME.h NAME.c (cantools)  NAME_e2e.h NAME_e2e.c (`e2e_c`)  host_test.c vectors.bin vectors.json Makefile
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Final

import cantools
from cantools.database.can import Database
from cantools.database.can.c_source import camel_to_snake_case, generate

from atalante_tools.console.outcome import Failed
from atalante_tools.dbc.build import Build
from atalante_tools.dbc.e2e_c import e2e_header, e2e_source
from atalante_tools.dbc.host_test import makefile, source
from atalante_tools.dbc.vectors import Vectors

#: Number of images in the file of test vectors. An image is a set of payloads, one payload per message.
_IMAGES: Final = 100
#: Keywords of C11 and macros of stdbool.h, in lower case. No compiler accepts a struct member with such a name.
_KEYWORDS: Final = frozenset({
    "auto", "bool", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern",
    "false", "float", "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed",
    "sizeof", "static", "struct", "switch", "true", "typedef", "union", "unsigned", "void", "volatile", "while",
})  # fmt: skip
_HOST_TEST, _VECTORS, _EXAMPLES, _MAKEFILE = "host_test.c", "vectors.bin", "vectors.json", "Makefile"


def write(build: Build, folder: Path, seed: int) -> list[Path]:
    """Write all generated files and return their paths. Equal arguments give identical files.

    Args:
        build: messages for which code is generated.
        folder: folder of the files; created if it does not exist.
        seed: seed of the random images of the test vectors.

    Raises:
        Failed: If the folder contains another Makefile, which would be lost, or if a name of the DBC is no name in C.
    """
    _check_names(build)
    folder.mkdir(parents=True, exist_ok=True)
    makefile_text = makefile(build)
    _check_makefile(folder / _MAKEFILE, makefile_text.partition("\n")[0])
    name = build.name
    header, code = _cantools(build)
    vectors = Vectors(build, seed)
    binary = b"".join([vectors.header(_IMAGES), *vectors.images(_IMAGES)])
    files: dict[str, bytes] = {
        f"{name}.h": header.encode(),
        f"{name}.c": code.encode(),
        f"{name}_e2e.h": e2e_header(build).encode(),
        f"{name}_e2e.c": e2e_source(build).encode(),
        _HOST_TEST: source(build).encode(),
        _VECTORS: binary,
        _EXAMPLES: (json.dumps(list(Vectors(build, seed).examples()), indent=1) + "\n").encode(),
        _MAKEFILE: makefile_text.encode(),
    }
    for file, content in files.items():
        (folder / file).write_bytes(content)
    return [folder / file for file in files]


def _check_names(build: Build) -> None:
    """Raise `Failed` if a name is a C keyword or begins with a digit, or if two names are equal in snake case."""
    file = f"{build.name}.c"
    if not build.name[0].isalpha() or file == _HOST_TEST:
        raise Failed(
            f"name of the C file must differ from {_HOST_TEST}, and must begin with a letter because all C names begin with it, "
            f"got {file}: rename the DBC file"
        )
    _check_distinct("messages", [m.name for m in build.messages])
    for message in build.messages:
        names = [s.name for s in message.signals]
        _check_distinct(f"signals of {message.name}", names)
        if keywords := [name for name in names if camel_to_snake_case(name) in _KEYWORDS]:
            raise Failed(f"signals of {message.name} must not be named like C keywords, got {', '.join(keywords)}")
    # The C functions of a signal begin with the names of message and signal: A.B_C and A_B.C are both a_b_c.
    signals = [f"{m.name}.{s.name}" for m in build.messages for s in m.signals]
    _check_distinct("messages and signals", [*(m.name for m in build.messages), *signals])


def _check_distinct(what: str, names: list[str]) -> None:
    """Raise `Failed` if two names are the same name in C.

    Args:
        what: what the names belong to, for the error message.
        names: names in the DBC; MESSAGE.SIGNAL is the name of a signal together with its message.
    """
    first: dict[str, str] = {}
    for name in names:
        c_name = camel_to_snake_case(name.replace(".", "_"))
        other = first.setdefault(c_name, name)
        if other != name:
            raise Failed(f"{what} must have different names in C, got {other} and {name}: both are {c_name!r}")


def _check_makefile(path: Path, first_line: str) -> None:
    """Raise `Failed` if the file exists and does not begin with the first line of a generated Makefile."""
    if path.exists() and not path.read_bytes().startswith(first_line.encode()):
        raise Failed(
            f"{path} must be a generated file if it exists, got another Makefile: choose another folder with --output"
        )


def _cantools(build: Build) -> tuple[str, str]:
    # `strict` is off, because the loader of `atalante_dbc` has already checked the file more strictly than cantools.
    database = cantools.database.load_string(build.text, database_format="dbc", strict=False)
    assert isinstance(database, Database)
    header, code, _, _ = generate(
        database,
        build.name,
        f"{build.name}.h",
        f"{build.name}.c",
        "",
        node_name=build.node,
        use_round=True,  # without this option, the generated encoder would truncate 0.0375 Nm to 0.025 Nm
    )
    # Remove the date of generation, so that the files depend only on the DBC.
    header, code = (re.sub(r"(by cantools version \S+) .*", r"\1.", part) for part in (header, code))
    # In the default rounding mode (FE_TONEAREST), nearbyint rounds a half step to the even code, as the Python codec does.
    return header, re.sub(r"\bround\(", "nearbyint(", code)
