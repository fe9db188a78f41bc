"""Monitor of the slow messages of all nodes: status messages (heartbeats) and emergencies.

    slow process image -> heartbeats -> fault memory

The monitor follows CiA 301. Each heartbeat has a timeout. A boot-up message reports that the sender was reset. If this message is
lost, the decreased uptime in the next status message shows the reset. An emergency stays active until the sender reports error
code 0, or until the operator acknowledges the emergency.
"""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_dbc import Network
from atalante_hal.robot import Thresholds
from atalante_hal.safety.diagnostics import Dtc, Reaction, emergency
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.types import Vector
from atalante_hal.wire.e2e import FULL, Check, suspect
from atalante_hal.wire.frame import Frames
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: Values of the signal NodeState (CiA 301): 0 in the first status message after the start of a node, 5 in normal operation.
#: All other values mean that the node does not work, for example 4 (STOPPED) and 127 (PRE-OPERATIONAL).
BOOT_UP, OPERATIONAL = 0, 5
#: Largest check result of a frame with new data. Such a frame has the result `Check.OK` (0) or `Check.SOME_LOST` (1).
#: `_FRESH` is a plain integer, because numpy compares enum members ten times slower.
_FRESH = int(Check.SOME_LOST)
#: Largest number of frames that `Heartbeats.essential` selects.
_ESSENTIAL = 128


class _Status(NamedTuple):
    node: str
    drive: bool  # True if the node is a drive; only drives measure the motor supply voltage
    row: int  # row of the status message in the process image
    timeout: int  # timeout of the status message [cycles]
    emergency: int  # row of the emergency message of the node in the process image
    state: int  # index of NodeState in the values of the process image
    dbc_hash: int  # index of DbcHash in the values of the process image
    supply: int  # index of SupplyVoltage in the values of the process image
    uptime: int  # index of Uptime in the values of the process image


class Heartbeats:
    """Monitor of the status messages and emergencies of all nodes.

    While `quiet` is True no node has a fault, and `evaluate` need not be called.
    """

    def __init__(self, network: Network, thresholds: Thresholds) -> None:
        messages = [m for m in network.received_by("HAL") if m.cycle_ms != 1]
        self.image = ReceiveImage(messages, restarts=True)
        codec = self.image.codec
        self._hash = network.hash32
        self._low, self._under = thresholds.supply_low, thresholds.supply_under
        self._statuses = [
            _Status(
                m.sender,
                network.node(m.sender).kind == "drive",
                codec.rows[m.name],
                m.timeout_ms,
                codec.rows[f"{m.sender}_EMCY"],
                *(codec.index(m.name, s) for s in _SIGNALS),
            )
            for m in messages
            if m.name.endswith("_STATUS")
        ]
        self._status_rows = np.array([s.row for s in self._statuses])
        self._timeouts = np.array([s.timeout for s in self._statuses])
        self._needed = {s.node for s in self._statuses if network.node(s.node).kind != "pendant"}
        self._reported: set[str] = set()  # nodes that have sent a status message
        self._emergency_of = {
            m.frame_id: (m.sender, codec.rows[m.name], codec.index(m.name, "ErrorCode"))
            for m in messages
            if m.name.endswith("_EMCY")
        }
        self._status_of = {codec.messages[s.row].frame_id: s for s in self._statuses}
        self._emergency_ids = list(self._emergency_of)
        # All status messages have the same layout.
        (self._state_byte,) = {codec.messages[s.row].signal("NodeState").start // 8 for s in self._statuses}
        #: Largest uptime that a node can report [s]. After it, the node may report 0 again without a restart.
        (self._last_uptime,) = {codec.messages[s.row].signal("Uptime").maximum for s in self._statuses}
        self._amplitude, self._amplitude_row = codec.slice("Amplitude"), codec.rows["HAPTICS_STATE"]
        self._seen = 0  # cycle of the last call of `image.new_cycle`
        #: Node -> diagnostic and error code of its active emergency. A cleared emergency is removed.
        #: A new emergency of a node replaces the old emergency of this node.
        #: Exception: the reaction to the new emergency is INFO, or is less severe than the reaction to the old emergency.
        self.emergencies: dict[str, tuple[Dtc, int]] = {}
        self._cleared: set[str] = set()  # nodes whose emergency was cleared in this cycle
        self._unreported: set[str] = set()  # nodes whose active emergency `evaluate` has not reported yet
        #: Nodes with an active emergency that was new in the last call of `evaluate`.
        self._just_reported: set[str] = set()
        #: Emergencies that were cleared before `evaluate` reported them, each as (node, diagnostic, error code).
        #: The next `evaluate` reports each emergency in `_brief` once.
        self._brief: list[tuple[str, Dtc, int]] = []
        #: Events that the next `evaluate` raises only as pending diagnostics, each as (node, diagnostic, error code):
        #: - An emergency with the reaction INFO.
        #: - An emergency of a node that already has an active emergency with a more severe reaction.
        #: - A frame from an error passive node. The error code of this event is 0.
        self._notices: list[tuple[str, Dtc, int]] = []
        #: Nodes whose last status reports a state other than OPERATIONAL. A single BOOT_UP is ignored.
        self._stopped: set[str] = set()
        #: Nodes that were reset since the last `evaluate`: they restarted (see `booted`), or reported a state other than
        #: OPERATIONAL.
        #: The first status message of a node is ignored, because the first start of a node is not a reset.
        self._reset: set[str] = set()
        #: Row of a message in the process image -> counter that rises if two nodes seem to send this message, 0 to `FULL`.
        #: If the counter of a message reaches `FULL`, it is confirmed that two nodes send this message.
        self._evidence: defaultdict[int, int] = defaultdict(int)
        #: Nodes that restarted: they sent a boot-up message, or, if this message was lost, their uptime has decreased.
        #: The safety monitor empties this set after each use.
        self.booted: set[str] = set()
        #: True when every required node (all but the pendant) has sent a status message.
        self.all_reported = False
        self.quiet = True

    def accept(self, frames: Frames, cycle: int, vibration: Vector) -> list[int]:
        """Process the frames that do not belong to the 1 ms process image, one by one in order of arrival.

        Args:
            frames: received frames, shape (n,).
            cycle: number of the current cycle.
            vibration: output for the measured vibration amplitudes, shape (8,); written if a new haptics state was received.

        Returns:
            Indices in `frames` of the frames that the DBC does not define as messages to the HAL.
        """
        image = self.image
        self._age(cycle)
        unknown = []
        for index, frame_id in enumerate(frames["can_id"].tolist()):
            refused = len(image.refused)
            if image.accept_each(frames[index:], 1):
                unknown.append(index)
                continue
            row = image.frame_ids[frame_id]
            if image.error_passive:
                self._notices.append((image.codec.messages[row].sender, Dtc.NODE_ERROR_PASSIVE, 0))
                image.error_passive.clear()
                self.quiet = False
            rejected = image.refused[refused:]
            conflict = rejected == [(row, Check.CONFLICT)]
            self._suspect(row, rival=conflict)
            if rejected:
                self.quiet = False
            if rejected and not conflict:  # the image commits the values of a frame with the result CONFLICT
                continue
            if frame_id in self._status_of:
                self._take_status(self._status_of[frame_id])
            elif frame_id in self._emergency_of:
                node, _, code = self._emergency_of[frame_id]
                self._take_emergency(node, int(image.values[code]))
        if image.check[self._amplitude_row] <= _FRESH:
            vibration[:] = image.values[self._amplitude]
        return unknown

    def essential(self, frames: Frames) -> npt.NDArray[np.intp]:
        """Choose the frames that must be processed when many frames arrived at once, and return their indices in ascending order.

        These are all emergencies, the newest frame of each other message, and the newest status of each node with each NodeState.
        The number is limited to `_ESSENTIAL`, because processing takes about 20 us per frame.

        Args:
            frames: slow messages of the nodes, shape (n,).
        """
        # The byte `_state_byte` is NodeState in a status message, and 0 in every other message except an emergency.
        kinds = np.column_stack([frames["can_id"], frames["data"][:, self._state_byte]])
        _, newest = np.unique(kinds[::-1], axis=0, return_index=True)
        needed = np.isin(frames["can_id"], self._emergency_ids)
        needed[len(frames) - 1 - newest] = True
        return np.flatnonzero(needed)[-_ESSENTIAL:]

    def evaluate(self, cycle: int, memory: FaultMemory) -> None:
        """Report the diagnostics of all nodes to the fault memory."""
        self._age(cycle)
        if self.quiet and not self.overdue(cycle):
            return
        messages = self.image.codec.messages
        for row, why in self.image.refused:
            dtc = _REFUSED.get(why, Dtc.SIGNAL_RANGE)
            memory.raise_dtc(cycle, dtc, messages[row].sender, confirmed=False)
        self.image.refused = []
        two_senders = [row for row, evidence in self._evidence.items() if evidence == FULL]
        for row in two_senders:
            text = f"{messages[row].sender}: {Dtc.NODE_DUPLICATE.meaning}, {messages[row].name}: switch one of them off"
            memory.raise_dtc(cycle, Dtc.NODE_DUPLICATE, messages[row].sender, value=FULL, text=text)
        for node in self._reset:
            memory.raise_dtc(cycle, Dtc.NODE_RESET, node)
        self._reset.clear()
        for node, dtc, code in self._notices:
            memory.raise_dtc(cycle, dtc, node, value=code, confirmed=False)
        self._notices.clear()
        for node, dtc, code in [*self._brief, *((node, *active) for node, active in self.emergencies.items())]:
            text = f"{node}: {dtc.meaning} (emergency 0x{code:04X})"
            memory.raise_dtc(cycle, dtc, node, value=code, text=text)
        self._brief.clear()
        self._just_reported, self._unreported = self._unreported, set()
        self.quiet = not (self.emergencies or two_senders)
        for status in self._statuses:
            self._check_status(cycle, memory, status)

    def overdue(self, cycle: int) -> bool:
        """Return whether a status message timed out.

        Call this function periodically: a received message can trigger `evaluate`, but a missing message cannot.
        """
        self._age(cycle)
        ages = self.image.age[self._status_rows]
        return bool(((ages >= self._timeouts) & (ages < NEVER)).any())

    def acknowledge(self, still_faulty: set[str]) -> None:
        """Remove the emergencies that the operator has acknowledged.

        The emergencies of drives that are still in FAULT remain. The emergencies that the last `evaluate` reported for the
        first time remain, too, because the operator pressed START before. Call this function when START is pressed, after the
        `evaluate` of the same cycle.

        Args:
            still_faulty: DBC names of the drives that are still in FAULT.
        """
        kept = still_faulty | self._just_reported
        self.emergencies = {node: active for node, active in self.emergencies.items() if node in kept}

    def has_emergency(self, node: str) -> bool:
        """Return whether a drive has an active emergency.

        While the result is True, the drive state FAULT raises no second diagnostic. The result is also True in the cycle in which
        the emergency is cleared, because the drive may still report FAULT.

        Args:
            node: DBC name of the drive.
        """
        return node in self.emergencies or node in self._cleared

    def missing(self) -> set[str]:
        """Return the required nodes that have sent no status message, and the nodes that use a different DBC."""
        values = self.image.values
        return (self._needed - self._reported) | {
            s.node for s in self._statuses if s.node in self._reported and values[s.dbc_hash] != self._hash
        }

    def _age(self, cycle: int) -> None:
        if cycle != self._seen:
            self._cleared.clear()
            refused = self.image.refused
            self.image.new_cycle(cycle - self._seen)
            self.image.refused = refused
            self._seen = cycle

    def _suspect(self, row: int, *, rival: bool) -> None:
        """Update the counter that detects two senders of one message.

        Call this function for each frame of the message.

        A restarted sender can repeat the last alive counter once, so one repeat is no proof of two senders. Two senders of one
        message often send the same alive counter.

        Args:
            row: row of the frame in the process image.
            rival: True if the frame has the same alive counter as the previous frame, but other bytes.
        """
        self._evidence[row] = suspect(self._evidence[row], rival=rival)

    def _take_status(self, status: _Status) -> None:
        values = self.image.values
        low = status.drive and values[status.supply] < self._low
        if low or values[status.dbc_hash] != self._hash or values[status.state] != OPERATIONAL:
            self.quiet = False
        state, before = values[status.state], self.image.values_before[status.state]
        if state == OPERATIONAL:
            self._stopped.discard(status.node)
        elif state != BOOT_UP or before == BOOT_UP:
            self._stopped.add(status.node)
        uptime, uptime_before = values[status.uptime], self.image.values_before[status.uptime]
        # The pendant is excluded, because the uptime also decreases if a second pendant replaces the first pendant.
        decreased = status.node in self._needed and uptime < uptime_before < self._last_uptime
        restarted = state == BOOT_UP or decreased
        if restarted:
            self.booted.add(status.node)
            self.image.restart(status.emergency)
        if status.node not in self._reported:
            self._reported.add(status.node)
            self.all_reported = self._reported.issuperset(self._needed)
            if self.all_reported:
                self.quiet = False  # all required nodes have reported, so the safety monitor must evaluate this cycle
        elif restarted or state != OPERATIONAL:
            self._reset.add(status.node)
            self.quiet = False

    def _take_emergency(self, node: str, code: int) -> None:
        dtc = emergency(code)
        self.quiet = False
        if dtc is None:
            active = self.emergencies.pop(node, None)
            if active is not None:
                self._cleared.add(node)
            if active is not None and node in self._unreported:
                self._brief.append((node, *active))
        elif dtc.reaction is Reaction.INFO:
            self._notices.append((node, dtc, code))
        elif node in self.emergencies and dtc.reaction < self.emergencies[node][0].reaction:
            self._notices.append((node, dtc, code))  # the active emergency is more severe, so it stays active
        else:
            self.emergencies[node] = dtc, code
            self._unreported.add(node)

    def _check_status(self, cycle: int, memory: FaultMemory, status: _Status) -> None:
        age, values, node = int(self.image.age[status.row]), self.image.values, status.node
        if age >= NEVER:
            return
        lost = age >= status.timeout
        stopped = node in self._stopped
        mismatch = values[status.dbc_hash] != self._hash
        supply = float(values[status.supply]) if status.drive else self._low
        if lost:
            memory.raise_dtc(cycle, Dtc.HEARTBEAT_LOST, node, value=age)
        if stopped:
            memory.raise_dtc(cycle, Dtc.NODE_RESET, node)
        if mismatch:
            memory.raise_dtc(cycle, Dtc.DBC_MISMATCH, node, value=values[status.dbc_hash])
        if supply < self._under:
            memory.raise_dtc(cycle, Dtc.UNDER_VOLTAGE, node, value=supply)
        elif supply < self._low:
            memory.raise_dtc(cycle, Dtc.SUPPLY_LOW, node, value=supply)
        if lost or stopped or mismatch or supply < self._low:
            self.quiet = False


_SIGNALS = ("NodeState", "DbcHash", "SupplyVoltage", "Uptime")
_REFUSED = {
    Check.REPEATED: Dtc.E2E_REPEATED,
    Check.CONFLICT: Dtc.NODE_DUPLICATE,
    Check.CRC: Dtc.E2E_CRC,
    Check.LENGTH: Dtc.FRAME_LENGTH,
}
