"""Input of the C code generators: all messages of a DBC file, or the messages of one node."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cantools.database.can.c_source import camel_to_snake_case

import atalante_dbc
from atalante_dbc import Message, Network, Signal
from atalante_dbc.network import decoded_text
from atalante_tools.console.names import find
from atalante_tools.console.outcome import Failed


@dataclass(frozen=True)
class Build:
    """Input of the C code generators: a network, and the node for which code is generated."""

    network: Network
    text: str  # content of the DBC file
    name: str  # prefix of every C identifier
    node: str | None  # node for which code is generated; None means all nodes

    @classmethod
    def of(cls, path: Path, node: str | None) -> Build:
        """Read a DBC file.

        Args:
            path: DBC file.
            node: name of the node for which code is generated; None means all nodes.

        Raises:
            DbcError: If the strict loader rejects the file.
            click.UsageError: If there is no such node.
            Failed: If there is no message for the C code.
        """
        network = atalante_dbc.load(path)
        names = [n.name for n in network.nodes]
        node = names[find(node, names, "node")] if node is not None else None
        build = cls(network, decoded_text(path.read_bytes()), camel_to_snake_case(path.stem), node)
        if not build.messages:
            raise Failed(f"{node or path} must have at least one message for the C code, got none")
        return build

    @property
    def messages(self) -> tuple[Message, ...]:
        """Return the messages for which C code is generated, in DBC order."""
        return tuple(m for m in self.network.messages if self.sends(m) or self.received(m))

    def sends(self, message: Message) -> bool:
        """Return whether a pack function is generated for the message."""
        return self.node in (None, message.sender)

    def received(self, message: Message) -> tuple[Signal, ...]:
        """Return the signals that the unpack function decodes; empty if no unpack function is generated."""
        return tuple(s for s in message.signals if self.node is None or self.node in s.receivers)

    def c_name(self, message: Message) -> str:
        """Return the prefix of all C identifiers of a message, without the trailing underscore."""
        return f"{self.name}_{camel_to_snake_case(message.name)}"
