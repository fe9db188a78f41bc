"""What C is generated for: a whole network, or one node's share of it. `DBC, node -> Build`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cantools.database.can.c_source import camel_to_snake_case

import atalante_dbc
from atalante_dbc import Message, Network, Signal
from atalante_tools.console.names import find


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
