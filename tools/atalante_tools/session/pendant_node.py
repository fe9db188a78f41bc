"""PENDANT node of the network: answers each SYNC with `PENDANT_STATE`, and sends `PENDANT_STATUS` at its period.

Only one pendant sends at a time. A new pendant listens first and copies the state of the older one: request counter, dead-man
switch, assistance factor. The older pendant stops sending when it receives a frame with its own identifier.

During the takeover both pendants answer the same SYNC for a cycle or two. Their frames have the same counter, the low byte of
the SYNC's Cycle. The HAL accepts the first frame. It reports the second frame as a repetition, or as a second sender if the
contents differ. After four such cycles it holds the robot.
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

#: Duration of a takeover, in cycles: time for the older pendant to stop sending.
GRACE: Final = 50
#: Last cycles of the takeover, in which the older pendant must not send any more.
SILENT: Final = 10
#: NMT state of an operational node (CiA 301).
OPERATIONAL: Final = 5
#: Firmware version reported in PENDANT_STATUS.
FIRMWARE_VERSION: Final = 0x0100
#: Values of `Check` for a frame with a valid CRC, whether or not its counter is right. Another pendant has sent such a frame.
_SPOKEN: Final = (Check.OK, Check.SOME_LOST, Check.REPEATED, Check.CONFLICT, Check.WRONG_SEQUENCE)


class Request(IntEnum):
    """Request of the operator; values of the signal `PENDANT_STATE.Request`."""

    NONE = 0
    START = 1
    STOP = 2
    HOLD = 3


class PendantNode:
    """Pendant node: listens until `speak()`, then answers every SYNC until another pendant takes over.

    Attributes:
        hal: State of the HAL in the last SYNC; None: no SYNC received.
        cycles: Number of SYNCs received.
        spoken: Number of SYNCs answered.
        heard_another: Whether a frame of another pendant was received before `speak()`.
        displaced: Whether another pendant has taken over since.
        refused: Whether the older pendant kept sending, so that this one stopped.
    """

    def __init__(self, network: Network, bus: Bus) -> None:
        """Prepare the node.

        Args:
            network: Network of the robot.
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
        self._speaking = False
        self._other_at = -GRACE  # value of `spoken` at the last frame of another pendant
        self.hal: SupervisorState | None = None
        self.cycles = 0
        self.spoken = 0
        self.heard_another = False
        self.displaced = False
        self.refused = False

    def speak(self) -> None:
        """Begin to send: answer the next SYNC and every later one."""
        self._speaking = True

    @property
    def dead_man(self) -> bool:
        """Return whether the dead-man switch is pressed."""
        return bool(self._tx.values[self._at["DeadMan"]])

    @dead_man.setter
    def dead_man(self, pressed: bool) -> None:
        self._tx.values[self._at["DeadMan"]] = pressed

    def press(self, request: Request) -> None:
        """Press a button: send the request with an incremented counter.

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
        """Receive the pending frames, and answer a SYNC.

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
        if state in _SPOKEN:
            self._other_received(state)
        if not Check(image.check[self._sync_row]).fresh:
            return False
        self.hal = SupervisorState(int(image.values[self._hal_at]))
        self.cycles += 1
        if self._speaking:
            self._answer()
        return True

    def _other_received(self, check: Check) -> None:
        if not self._speaking:
            if check.fresh:
                self.heard_another = True
                self._take_over()
            return
        if self.spoken > GRACE:
            self._speaking = False
            self.displaced = True
        self._other_at = self.spoken

    def _take_over(self) -> None:
        """Copy the signals of the other pendant, so that the HAL gets the same state from this one."""
        for name, index in self._at.items():
            self._tx.values[index] = self._received.values[self._received_index[name]]

    def _answer(self) -> None:
        if self.spoken == GRACE and self._other_at > GRACE - SILENT:
            self._speaking = False
            self.refused = True
            return
        self._send(self._tx.seal(int(self._received.values[self._cycle_at]) & 0xFF))
        if self.spoken % self._status_cycles == 0:
            self._status.values[self._uptime_at] = self.spoken * PERIOD
            self._send(self._status.seal())
        self.spoken += 1

    def _send(self, frames: Frames) -> None:
        with suppress(BusFull):  # the HAL detects a missing frame by its timeout
            self._bus.send(frames)
