"""Heartbeats of the emulated nodes. The first status message of a node reports BOOTUP, all later messages report OPERATIONAL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from atalante_dbc import Message, Network
from atalante_hal.types import PERIOD
from atalante_hal.wire.frame import Frames
from atalante_hal.wire.process_image import TransmitImage

#: Node states of the CiA 301 heartbeat.
BOOTUP: Final = 0
OPERATIONAL: Final = 5
_FIRMWARE_VERSION: Final = 0x0100
_SUPPLY_VOLTAGE: Final = 48.0  # supply voltage in the status messages [V]


@dataclass
class _Status:
    """Status message of one node, and the time at which the node started."""

    tx: TransmitImage  # encoder of the status message: `tx.values` contains its signal values
    at: dict[str, int]  # name of each signal -> index of its value in `tx.values`
    booted: int = 0  # cycle number at the last start of the node; the signal Uptime counts from this cycle


class Heartbeats:
    """Sender of the status messages of all emulated nodes."""

    def __init__(self, network: Network, messages: Sequence[Message], emergencies: TransmitImage) -> None:
        """Plan the status messages.

        Args:
            network: nodes and messages of the DBC.
            messages: status messages of the emulated nodes.
            emergencies: encoder of the emergencies of these nodes. A restart of a node resets the alive counter of its emergency.
        """
        self._emergencies = emergencies
        self._period = max(m.cycle_ms for m in messages)
        # Distribute the status messages over the period: node i sends its message `gap` cycles after node i - 1.
        # As a result, at most one node sends its regular status message in the same cycle.
        gap = self._period // len(messages)
        self._due: dict[int, _Status] = {}
        self._of: dict[str, _Status] = {}
        self._booting: list[_Status] = []
        for index, message in enumerate(messages):
            tx = TransmitImage([message])
            status = _Status(tx, {signal.name: tx.codec.index(message.name, signal.name) for signal in message.signals})
            self._due[gap * index] = self._of[message.sender] = status
            self.set(message.sender, "NodeState", BOOTUP)
            self.set(message.sender, "DbcHash", network.hash32)
            self.set(message.sender, "FirmwareVersion", _FIRMWARE_VERSION)
            self.set(message.sender, "SupplyVoltage", _SUPPLY_VOLTAGE)

    @property
    def nodes(self) -> frozenset[str]:
        """Names of the nodes that send status messages."""
        return frozenset(self._of)

    def set(self, node: str, signal: str, value: float) -> None:
        """Set a signal in the status message of a node.

        Args:
            node: name of the node.
            signal: name of the signal.
            value: value in the unit of the DBC.
        """
        status = self._of[node]
        status.tx.values[status.at[signal]] = value

    def boot(self, node: str, cycle: int) -> None:
        """Restart a node, so that its next status message reports BOOTUP.

        The next call of `due` returns this message. Its uptime restarts at 0, and so do the alive counters of the status message
        and of the emergency.

        Args:
            node: name of the node.
            cycle: number of the current cycle.
        """
        status = self._of[node]
        status.booted = cycle
        status.tx.set_counter(0, 0xFF)
        self._emergencies.set_counter(self._emergencies.codec.rows[f"{node}_EMCY"], 0xFF)
        self.set(node, "NodeState", BOOTUP)
        self.set(node, "ErrorFlags", 0.0)
        self._booting.append(status)

    def due(self, cycle: int) -> Sequence[Frames]:
        """Return the status frames to send in a cycle, as one array of shape (1,) for each frame.

        Most cycles have no status frame.

        Args:
            cycle: number of the cycle.
        """
        due = self._due.get(cycle % self._period)
        if due is None and not self._booting:
            return ()
        due_now = [*self._booting, *([due] if due is not None and due not in self._booting else [])]
        self._booting = []
        return [self._sealed(status, cycle) for status in due_now]

    @staticmethod
    def _sealed(status: _Status, cycle: int) -> Frames:
        values = status.tx.values
        values[status.at["Uptime"]] = (cycle - status.booted) * PERIOD
        frames = status.tx.seal()
        values[status.at["NodeState"]] = OPERATIONAL
        return frames
