"""The PENDANT node of the network: `SYNC -> PENDANT_STATE` every cycle, `PENDANT_STATUS` now and then.

One pendant speaks at a time. A new one listens first and goes on where the other is: number of presses, dead-man, assistance
factor. The older one hears its own identifier from somebody else and falls silent. In between, both answer the same SYNC for a
cycle or two, with the same counter, the low byte of its Cycle; the HAL takes the first and notes that the second is a repetition,
or that there are two senders if their frames differ. It holds the robot when that lasts for four cycles.
"""

from __future__ import annotations

from contextlib import suppress
from enum import IntEnum
from typing import Final

from atalante_dbc import Network
from atalante_hal.bus import Bus, BusFull
from atalante_hal.hal import PERIOD
from atalante_hal.types import SupervisorState
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

#: Cycles the older pendant is given to fall silent, and how long before their end it must have.
GRACE: Final = 50
SILENT: Final = 10
#: NMT state of a node that works (CiA 301).
OPERATIONAL: Final = 5
FIRMWARE_VERSION: Final = 0x0100
#: The frame is whole, whatever its counter says: somebody sent it.
_SPOKEN: Final = (Check.OK, Check.SOME_LOST, Check.REPEATED, Check.CONFLICT, Check.WRONG_SEQUENCE)


class Request(IntEnum):
    """What the operator asks for; values of `PENDANT_STATE.Request`."""

    NONE = 0
    START = 1
    STOP = 2
    HOLD = 3


class PendantNode:
    """Listens until `speak()`; then answers every SYNC until another pendant takes over.

    Attributes:
        hal: state the HAL said last, None: no SYNC heard.
        cycles: SYNCs heard.
        spoken: of these, answered.
        heard_another: a pendant was heard while listening.
        displaced: another pendant has taken over since.
        refused: the one heard before does not fall silent.
    """

    def __init__(self, network: Network, bus: Bus) -> None:
        """Take a bus that carries the network's `PENDANT_STATE`."""
        state, status = network.message("PENDANT_STATE"), network.message("PENDANT_STATUS")
        sync = next(m for m in network.sent_by("HAL") if m.bus == state.bus and m.name.startswith("SYNC_"))
        self._bus = bus
        self._heard = ReceiveImage([sync, state])
        self._sync_row, self._state_row = (self._heard.codec.rows[m.name] for m in (sync, state))
        self._ids = {sync.frame_id, state.frame_id}
        self._scratch = new_frames(128)
        self._tx, self._status = TransmitImage([state]), TransmitImage([status])
        self._at = {s.name: self._tx.codec.index(state.name, s.name) for s in state.signals}
        self._heard_at = {s.name: self._heard.codec.index(state.name, s.name) for s in state.signals}
        self._hal_at = self._heard.codec.index(sync.name, "HalState")
        self._cycle_at = self._heard.codec.index(sync.name, "Cycle")
        for name, value in (
            ("NodeState", OPERATIONAL),
            ("DbcHash", network.hash32),
            ("FirmwareVersion", FIRMWARE_VERSION),
        ):
            self._status.values[self._status.codec.index(status.name, name)] = value
        self._uptime_at = self._status.codec.index(status.name, "Uptime")
        self._status_cycles = status.cycle_ms
        self._speaking = False
        self._other_at = -GRACE  # `spoken` when another pendant was heard last
        self.hal: SupervisorState | None = None
        self.cycles = 0
        self.spoken = 0
        self.heard_another = False
        self.displaced = False
        self.refused = False

    def speak(self) -> None:
        """Answer from the next SYNC on."""
        self._speaking = True

    @property
    def dead_man(self) -> bool:
        """Whether the dead-man is pressed."""
        return bool(self._tx.values[self._at["DeadMan"]])

    @dead_man.setter
    def dead_man(self, pressed: bool) -> None:
        self._tx.values[self._at["DeadMan"]] = pressed

    def press(self, request: Request) -> None:
        """Press a button."""
        values, at = self._tx.values, self._at
        values[at["Request"]] = request
        values[at["RequestCounter"]] = (int(values[at["RequestCounter"]]) + 1) & 0xFF

    def assist(self, factor: float) -> None:
        """Turn the assistance dial to Xi, in [0, 1]."""
        self._tx.values[self._at["AssistanceFactor"]] = factor
        self._tx.values[self._at["AssistanceSet"]] = 1.0

    def poll(self, timeout: float = 0.0) -> bool:
        """Take what the bus delivered and answer a SYNC in it.

        Args:
            timeout: longest wait for the first frame [s].

        Returns:
            Whether there was a SYNC.
        """
        count = self._bus.receive(self._scratch, timeout)
        if self._ids.isdisjoint(self._scratch["can_id"][:count].tolist()):
            return False
        image = self._heard
        image.new_cycle()
        image.accept_each(self._scratch, count)
        state = Check(image.check[self._state_row])
        if state in _SPOKEN:
            self._hear_another(state)
        if not Check(image.check[self._sync_row]).fresh:
            return False
        self.hal = SupervisorState(int(image.values[self._hal_at]))
        self.cycles += 1
        if self._speaking:
            self._answer()
        return True

    def _hear_another(self, check: Check) -> None:
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
        """Go on where the other pendant is."""
        for name, place in self._at.items():
            self._tx.values[place] = self._heard.values[self._heard_at[name]]

    def _answer(self) -> None:
        if self.spoken == GRACE and self._other_at > GRACE - SILENT:
            self._speaking = False
            self.refused = True
            return
        self._send(self._tx.seal(int(self._heard.values[self._cycle_at]) & 0xFF))
        if self.spoken % self._status_cycles == 0:
            self._status.values[self._uptime_at] = self.spoken * PERIOD
            self._send(self._status.seal())
        self.spoken += 1

    def _send(self, frames: Frames) -> None:
        with suppress(BusFull):  # the HAL notices what it does not hear
            self._bus.send(frames)
