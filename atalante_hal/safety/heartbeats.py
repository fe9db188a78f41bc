"""What the nodes say now and then: status (their heartbeat) and emergencies.

`slow process image -> heartbeats -> diagnostics`

After CiA 301: a heartbeat consumer with a timeout, the boot-up message as the sign of a reset, and emergencies that hold until
the node says that the error is gone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from atalante_dbc import Network
from atalante_hal.robot import Thresholds
from atalante_hal.safety.diagnostics import Dtc, Reaction, emergency
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.wire.codec import Vector
from atalante_hal.wire.e2e import FULL, Check, suspect
from atalante_hal.wire.frame import Frames
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: NMT states of a node that has just begun, and of one that works.
BOOT_UP, OPERATIONAL = 0, 5
#: Largest `Check` whose data is new, as a plain integer: numpy compares it ten times faster.
_FRESH = int(Check.SOME_LOST)


class _Status(NamedTuple):
    node: str
    drive: bool  # hangs on the supply that moves the robot
    row: int
    timeout: int
    state: int  # place of NodeState in the image's values, as for the two below
    dbc_hash: int
    supply: int


class Heartbeats:
    """Status and emergencies of all nodes.

    `quiet` says that nothing is wrong, so that nothing has to be judged.
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
                *(codec.index(m.name, s) for s in _SIGNALS),
            )
            for m in messages
            if m.name.endswith("_STATUS")
        ]
        self._status_rows = np.array([s.row for s in self._statuses])
        self._timeouts = np.array([s.timeout for s in self._statuses])
        self._needed = {s.node for s in self._statuses if network.node(s.node).kind != "pendant"}
        self._heard: set[str] = set()  # nodes that sent a status
        self._emergency_of = {
            m.frame_id: (m.sender, codec.rows[m.name], codec.index(m.name, "ErrorCode"))
            for m in messages
            if m.name.endswith("_EMCY")
        }
        self._status_of = {codec.messages[s.row].frame_id: s for s in self._statuses}
        self._amplitude, self._amplitude_row = codec.slice("Amplitude"), codec.rows["HAPTICS_STATE"]
        self._seen = 0  # cycle up to which ages count
        #: Node -> what it said last of an error that is not gone: code and emergency error code.
        self.emergencies: dict[str, tuple[Dtc, int]] = {}
        #: Nodes whose emergency was cleared in this cycle. Their state frame of the same cycle may still report FAULT.
        self.cleared: set[str] = set()
        #: Emergencies that only inform, since the last `judge`.
        self._notices: list[tuple[str, Dtc, int]] = []
        self._reset: set[str] = set()  # nodes that began anew since the last `judge`
        #: Row -> evidence of two senders, of the rows that have any, one step a frame.
        self._evidence: dict[int, int] = {}
        #: Nodes that sent a boot-up message since the last `judge` was used: its reader clears it.
        self.booted: set[str] = set()
        #: Every node that has to has sent a status.
        self.known = False
        self.quiet = True

    def accept(self, frames: Frames, cycle: int, vibration: Vector) -> list[int]:
        """Take the frames of a cycle that are not of the fast image, one by one: each counts.

        Args:
            vibration: gets the measured amplitudes, shape (8,).

        Returns:
            Places in `frames` of those nobody may send to the HAL.
        """
        image = self.image
        self._age(cycle)
        unknown = []
        for place, frame_id in enumerate(frames["can_id"].tolist()):
            refused = len(image.refused)
            if image.accept_each(frames[place:], 1):
                unknown.append(place)
                continue
            row = image.frame_ids[frame_id]
            self._suspect(row, rival=image.refused[refused:] == [(row, Check.CONFLICT)])
            if image.check[row] > _FRESH:
                self.quiet = False
                continue
            if frame_id in self._status_of:
                self._take_status(self._status_of[frame_id])
            elif frame_id in self._emergency_of:
                node, _, code = self._emergency_of[frame_id]
                self._take_emergency(node, int(image.values[code]))
        if image.check[self._amplitude_row] <= _FRESH:
            vibration[:] = image.values[self._amplitude]
        return unknown

    def judge(self, cycle: int, memory: FaultMemory) -> None:
        """Raise what is wrong with any node."""
        self._age(cycle)
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
        for node, (dtc, code) in self.emergencies.items():
            text = f"{node}: {dtc.meaning} (emergency 0x{code:04X})"
            memory.raise_dtc(cycle, dtc, node, value=code, text=text)
        self.quiet = not (self.emergencies or two_senders)
        for status in self._statuses:
            self._judge_status(cycle, memory, status)

    def overdue(self, cycle: int) -> bool:
        """Whether a status is late: asked now and then, because nothing comes that would say so."""
        self._age(cycle)
        ages = self.image.age[self._status_rows]
        return bool(((ages >= self._timeouts) & (ages < NEVER)).any())

    def acknowledge(self, still_faulty: set[str]) -> None:
        """The operator starts again: emergencies are over, but of the drives that are still in FAULT."""
        self.emergencies = {node: said for node, said in self.emergencies.items() if node in still_faulty}

    def missing(self) -> set[str]:
        """Nodes without a status, or of another DBC."""
        values = self.image.values
        return (self._needed - self._heard) | {
            s.node for s in self._statuses if s.node in self._heard and values[s.dbc_hash] != self._hash
        }

    def _age(self, cycle: int) -> None:
        if cycle != self._seen:
            self.cleared.clear()
            refused = self.image.refused
            self.image.new_cycle(cycle - self._seen)
            self.image.refused = refused
            self._seen = cycle

    def _suspect(self, row: int, *, rival: bool) -> None:
        """Weigh one more frame of a row. A sender that begins anew may meet the last counter once, two senders do often."""
        before = self._evidence.get(row, 0)
        if rival or before:
            self.quiet = False
            self._evidence[row] = suspect(before, rival=rival)

    def _take_status(self, status: _Status) -> None:
        values = self.image.values
        low = status.drive and values[status.supply] < self._low
        if low or values[status.dbc_hash] != self._hash or values[status.state] != OPERATIONAL:
            self.quiet = False
        if values[status.state] == BOOT_UP:
            self.booted.add(status.node)
        if status.node not in self._heard:
            self._heard.add(status.node)
            self.known = self._heard.issuperset(self._needed)
            if self.known:
                self.quiet = False  # the robot may become READY now
        elif values[status.state] != OPERATIONAL:
            self._reset.add(status.node)

    def _take_emergency(self, node: str, code: int) -> None:
        dtc = emergency(code)
        self.quiet = False
        if dtc is None:
            if self.emergencies.pop(node, None) is not None:
                self.cleared.add(node)
        elif dtc.reaction is Reaction.INFO:
            self._notices.append((node, dtc, code))
        else:
            self.emergencies[node] = dtc, code

    def _judge_status(self, cycle: int, memory: FaultMemory, status: _Status) -> None:
        age, values, node = int(self.image.age[status.row]), self.image.values, status.node
        if age >= NEVER:
            return
        lost = age >= status.timeout
        mismatch = values[status.dbc_hash] != self._hash
        supply = float(values[status.supply]) if status.drive else self._low
        if lost:
            memory.raise_dtc(cycle, Dtc.HEARTBEAT_LOST, node, value=age)
        if mismatch:
            memory.raise_dtc(cycle, Dtc.DBC_MISMATCH, node, value=values[status.dbc_hash])
        if supply < self._under:
            memory.raise_dtc(cycle, Dtc.UNDER_VOLTAGE, node, value=supply)
        elif supply < self._low:
            memory.raise_dtc(cycle, Dtc.SUPPLY_LOW, node, value=supply)
        if lost or mismatch or supply < self._low:
            self.quiet = False


_SIGNALS = ("NodeState", "DbcHash", "SupplyVoltage")
_REFUSED = {
    Check.REPEATED: Dtc.E2E_REPEATED,
    Check.CONFLICT: Dtc.NODE_DUPLICATE,
    Check.CRC: Dtc.E2E_CRC,
    Check.LENGTH: Dtc.FRAME_LENGTH,
}
