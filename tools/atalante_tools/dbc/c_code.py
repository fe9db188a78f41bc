"""C of a network: pack and unpack by cantools' generator, E2E Profile 5 in the same style, and the files that prove both.

DBC -> Build -> NAME.h NAME.c (cantools)  NAME_e2e.h NAME_e2e.c (here)  host_test.c vectors.bin vectors.json Makefile
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cantools
from cantools.database.can import Database
from cantools.database.can.c_source import camel_to_snake_case, generate

import atalante_dbc
from atalante_dbc import Message, Network, Signal
from atalante_tools.dbc.e2e_c import e2e_header, e2e_source
from atalante_tools.dbc.host_test import makefile, source
from atalante_tools.dbc.vectors import Vectors
from atalante_tools.names import find

#: Images in the vector file of the folder: enough for a test without Python.
_IMAGES: Final = 100
_HOST_TEST, _VECTORS, _EXAMPLES, _MAKEFILE = "host_test.c", "vectors.bin", "vectors.json", "Makefile"


@dataclass(frozen=True)
class Build:
    """What is generated: a whole network, or one node's share of it."""

    network: Network
    text: str  # of the DBC
    name: str  # prefix of every C name
    node: str | None

    @classmethod
    def of(cls, path: Path, node: str | None) -> Build:
        """Read a DBC.

        Raises:
            DbcError: the strict loader refuses it.
            click.UsageError: there is no such node.
        """
        network = atalante_dbc.load(path)
        names = [n.name for n in network.nodes]
        node = names[find(node, names, "node")] if node is not None else None
        return cls(network, path.read_text("cp1252"), camel_to_snake_case(path.stem), node)

    @property
    def messages(self) -> tuple[Message, ...]:
        """Messages with any C code, in DBC order."""
        return tuple(m for m in self.network.messages if self.sends(m) or self.received(m))

    def sends(self, message: Message) -> bool:
        """Whether there is a pack function."""
        return self.node in (None, message.sender)

    def received(self, message: Message) -> tuple[Signal, ...]:
        """Signals the unpack function fills; empty: there is none."""
        return tuple(s for s in message.signals if self.node is None or self.node in s.receivers)

    def c_name(self, message: Message) -> str:
        """What the C names of a message begin with, and behind an underscore the signal."""
        return f"{self.name}_{camel_to_snake_case(message.name)}"


def write(build: Build, folder: Path, seed: int) -> list[Path]:
    """Write every file of the build and return their paths. The same DBC gives the same bytes."""
    folder.mkdir(parents=True, exist_ok=True)
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
        _MAKEFILE: makefile(build).encode(),
    }
    for file, content in files.items():
        (folder / file).write_bytes(content)
    return [folder / file for file in files]


def _cantools(build: Build) -> tuple[str, str]:
    # Not strict: cantools' own checks refuse less than the loader, which has already passed.
    database = cantools.database.load_string(build.text, database_format="dbc", strict=False)
    assert isinstance(database, Database)
    header, code, _, _ = generate(
        database,
        build.name,
        f"{build.name}.h",
        f"{build.name}.c",
        "",
        node_name=build.node,
        use_round=True,  # or the encoder truncates, and 0.0375 Nm leaves as 0.025
    )
    # The date of the day would make every run another file.
    header, code = (re.sub(r"(by cantools version \S+) .*", r"\1.", part) for part in (header, code))
    return header, code
