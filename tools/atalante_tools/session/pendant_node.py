"""PENDANT node of the network: answers each SYNC with `PENDANT_STATE`, and sends `PENDANT_STATUS` at its period.

Only one pendant sends at a time. A new pendant listens first and copies the signals of the older pendant: request counter,
dead-man switch and assistance factor. The older pendant stops sending when it receives a frame with its own identifier.

During the takeover both pendants answer the same SYNC in one or two cycles. Both frames have the same counter, the low byte of
the signal Cycle in SYNC. The HAL accepts the first frame. It reports the second frame as a repetition, or as a second sender if
the contents differ. After four such cycles the HAL holds the robot.
"""

from __future__ import annotations

from contextlib import suppress
from enum import IntEnum
from typing import Final

from atalante_dbc import Network
from atalante_hal.bus import Bus, BusFull
from atalante_hal.types import PERIOD, SupervisorState
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

#: Duration of a takeover [cycles]. In this time the older pendant must stop sending.
TAKEOVER_CYCLES: Final = 50
#: Last part of a takeover, in which the older pendant must not send any frame [cycles].
QUIET_CYCLES: Final = 10
#: NMT state of an operational node (CiA 301).
OPERATIONAL: Final = 5
#: Firmware version reported in PENDANT_STATUS.
FIRMWARE_VERSION: Final = 0x0100
#: Values of `Check` for a frame with a valid CRC. Such a frame with the identifier of the pendant comes from another pendant.
_FROM_ANOTHER: Final = (Check.OK, Check.SOME_LOST, Check.REPEATED, Check.CONFLICT, Check.WRONG_SEQUENCE)


class Request(IntEnum):
    """Button that the operator pressed last: values of the signal `PENDANT_STATE.Request`."""

    NONE = 0
    START = 1
    STOP = 2
    HOLD = 3


class PendantNode:
    """Pendant node. It listens until `start_sending()`, then answers every SYNC until another pendant takes over.

    Attributes:
        hal: State of the HAL in the last SYNC. None: no SYNC received.
        cycles: Number of received SYNCs.
        answered: Number of answered SYNCs.
        found_another: Whether a frame of another pendant was received before `start_sending()`.
        displaced: Whether another pendant took over from this node.
        takeover_failed: Whether this node stopped because the older pendant did not stop sending.
    """

    def __init__(self, network: Network, bus: Bus) -> None:
        """Set up the process images of the node.

        Args:
            network: Nodes and messages of the DBC.
            bus: Bus that carries `PENDANT_STATE`.
        """
        state, status = network.message("PENDANT_STATE"), network.message("PENDANT_STATUS")
        sync = next(m for m in network.sent_by("HAL") if m.bus == state.bus and m.name.startswith("SYNC_"))
        self._bus = bus
        self._received = ReceiveImage([sync, state])
        self._sync_row, self._state_row = (self._received.codec.rows[m.name] for m in (sync, state))
        self._ids = {sync.frame_id, state.frame_id}
        self._scratch = new_frames(128)
        self._tx, self._status = TransmitImage([state]), TransmitImage([status])
        self._at = {s.name: self._tx.codec.index(state.name, s.name) for s in state.signals}
        self._received_index = {s.name: self._received.codec.index(state.name, s.name) for s in state.signals}
        self._hal_at = self._received.codec.index(sync.name, "HalState")
        self._cycle_at = self._received.codec.index(sync.name, "Cycle")
        for name, value in (
            ("NodeState", OPERATIONAL),
            ("DbcHash", network.hash32),
            ("FirmwareVersion", FIRMWARE_VERSION),
        ):
            self._status.values[self._status.codec.index(status.name, name)] = value
        self._uptime_at = self._status.codec.index(status.name, "Uptime")
        self._status_cycles = status.cycle_ms
        self._sending = False
        self._other_at = -TAKEOVER_CYCLES  # value of `answered` when the last frame of another pendant arrived
        self.hal: SupervisorState | None = None
        self.cycles = 0
        self.answered = 0
        self.found_another = False
        self.displaced = False
        self.takeover_failed = False

    def start_sending(self) -> None:
        """Answer every SYNC from now on."""
        self._sending = True

    @property
    def dead_man(self) -> bool:
        """Return whether the dead-man switch is pressed."""
        return bool(self._tx.values[self._at["DeadMan"]])

    @dead_man.setter
    def dead_man(self, pressed: bool) -> None:
        self._tx.values[self._at["DeadMan"]] = pressed

    def press(self, request: Request) -> None:
        """Press a button. The next frames contain the request with an incremented counter.

        Args:
            request: Request of the button.
        """
        values, at = self._tx.values, self._at
        values[at["Request"]] = request
        values[at["RequestCounter"]] = (int(values[at["RequestCounter"]]) + 1) & 0xFF

    def assist(self, factor: float) -> None:
        """Set the assistance factor.

        Args:
            factor: Assistance factor Xi, 0 to 1.
        """
        self._tx.values[self._at["AssistanceFactor"]] = factor
        self._tx.values[self._at["AssistanceSet"]] = 1.0

    def poll(self, timeout: float = 0.0) -> bool:
        """Receive the waiting frames. Answer the SYNC if one is among them.

        Args:
            timeout: Longest wait for the first frame [s].

        Returns:
            Whether a SYNC was received.
        """
        count = self._bus.receive(self._scratch, timeout)
        if self._ids.isdisjoint(self._scratch["can_id"][:count].tolist()):
            return False
        image = self._received
        image.new_cycle()
        image.accept_each(self._scratch, count)
        state = Check(image.check[self._state_row])
        if state in _FROM_ANOTHER:
            self._other_received(state)
        if not Check(image.check[self._sync_row]).fresh:
            return False
        self.hal = SupervisorState(int(image.values[self._hal_at]))
        self.cycles += 1
        if self._sending:
            self._answer()
        return True

    def _other_received(self, check: Check) -> None:
        if not self._sending:
            if check.fresh:
                self.found_another = True
                self._copy_signals()
            return
        if self.answered > TAKEOVER_CYCLES:
            self._sending = False
            self.displaced = True
        self._other_at = self.answered

    def _copy_signals(self) -> None:
        """Copy the signals of the other pendant. The HAL then receives the same values from both pendants."""
        for name, index in self._at.items():
            self._tx.values[index] = self._received.values[self._received_index[name]]

    def _answer(self) -> None:
        if self.answered == TAKEOVER_CYCLES and self._other_at > TAKEOVER_CYCLES - QUIET_CYCLES:
            self._sending = False
            self.takeover_failed = True
            return
        self._send(self._tx.seal(int(self._received.values[self._cycle_at]) & 0xFF))
        if self.answered % self._status_cycles == 0:
            self._status.values[self._uptime_at] = self.answered * PERIOD
            self._send(self._status.seal())
        self.answered += 1

    def _send(self, frames: Frames) -> None:
        with suppress(BusFull):  # the HAL detects missing frames by a timeout
            self._bus.send(frames)
