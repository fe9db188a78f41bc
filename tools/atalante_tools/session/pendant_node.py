"""PENDANT node of the network: answers each SYNC with `PENDANT_STATE`, and sends `PENDANT_STATUS` at its period.

Only one pendant sends at a time, see `takeover`. A new pendant listens first and copies the signals of the older pendant: request
counter, dead-man switch and assistance factor. The older pendant stops sending when it receives frames of the new pendant.

During the takeover there are two cycles in which both pendants answer the SYNC. Both frames have the same counter, which is the
low byte of the signal Cycle in SYNC. The HAL accepts the first frame. The HAL reports the second frame as a repetition if the
contents are equal, and as a second sender if the contents differ. After four cycles with a second sender, the HAL holds the
robot.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from atalante_dbc import Network
from atalante_hal.bus import Bus, BusFull
from atalante_hal.types import PERIOD, SupervisorState
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.session.takeover import PendantReader, Takeover

#: NMT state of an operational node (CiA 301).
OPERATIONAL: Final = 5
#: Firmware version reported in PENDANT_STATUS.
FIRMWARE_VERSION: Final = 0x0100


class Request(IntEnum):
    """Button that the operator pressed last. The values are the values of the signal `PENDANT_STATE.Request`."""

    NONE = 0
    START = 1
    STOP = 2
    HOLD = 3


class PendantNode:
    """Pendant node. It listens until `start_sending()`, and then answers every SYNC until another pendant takes over.

    Attributes:
        hal: State of the HAL in the last SYNC. None if no SYNC was received.
        cycles: Number of received SYNCs.
        answered_in_row: Number of SYNCs that this node answered since the last gap. There are three kinds of gap: a rejected
            SYNC (see `PendantReader.gaps`), an answer for which the transmit queue had no room, and a `poll` with several
            waiting SYNCs, because only the last of them gets an answer. Silence in a takeover is no gap. After a gap, the HAL
            may ignore requests of the pendant until it has received enough consecutive answers.
        answered: Number of answered SYNCs. Answers for which the transmit queue had no room are included.
        found_another: Whether another pendant sent before `start_sending()`.
    """

    def __init__(self, network: Network, bus: Bus, *, seed: int | None = None) -> None:
        """Set up the process images of the node.

        Args:
            network: Nodes and messages of the DBC.
            bus: Bus that carries `PENDANT_STATE`.
            seed: Seed of the random waiting times in a takeover. None means a random seed of the operating system.
        """
        state, status = network.message("PENDANT_STATE"), network.message("PENDANT_STATUS")
        self._bus = bus
        self._takeover = Takeover(seed=seed)
        self._reader = PendantReader(network, self._takeover)
        self._scratch = new_frames(128)
        self._tx, self._status = TransmitImage([state]), TransmitImage([status])
        self._at = {s.name: self._tx.codec.index(state.name, s.name) for s in state.signals}
        for name, value in (
            ("NodeState", OPERATIONAL),
            ("DbcHash", network.hash32),
            ("FirmwareVersion", FIRMWARE_VERSION),
        ):
            self._status.values[self._status.codec.index(status.name, name)] = value
        self._uptime_at = self._status.codec.index(status.name, "Uptime")
        self._status_cycles = status.cycle_ms
        self._sending = False
        self.hal: SupervisorState | None = None
        self.cycles = 0
        self.answered = 0
        self.answered_in_row = 0
        self.found_another = False

    @property
    def displaced(self) -> bool:
        """Return whether another pendant took over from this node."""
        return self._takeover.lost and self._takeover.established

    @property
    def takeover_failed(self) -> bool:
        """Return whether this node gave up its takeover because another pendant did not stop sending."""
        return self._takeover.lost and not self._takeover.established

    def start_sending(self) -> None:
        """Start sending: answer every SYNC from now on, except while this node must be silent because of another pendant."""
        self._sending = True
        self._takeover.start()

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
        """Receive all waiting frames, and answer the last SYNC among them.

        Args:
            timeout: Longest wait for the first frame [s].

        Returns:
            Whether a SYNC was received.
        """
        was_silent, gaps = self._takeover.silent, self._reader.gaps
        synced = self._reader.read(self._scratch, self._bus.receive(self._scratch, timeout))
        if not self._sending and self._takeover.present:
            self.found_another = True
            self._copy_signals()
        if self._takeover.silent and not was_silent:
            self._release_start()
        # Only the last of several waiting SYNCs gets an answer.
        # If several SYNCs were waiting, or a SYNC was rejected, the count of consecutive answers restarts from zero.
        if self._reader.gaps > gaps or synced > 1:
            self.answered_in_row = 0
        if not synced:
            return False
        self.hal = SupervisorState(self._reader.hal_state)
        self.cycles += 1
        if self._takeover.sends:
            self._answer()
        return True

    def _copy_signals(self) -> None:
        """Copy the signals of the other pendant. The HAL then receives the same values from both pendants."""
        for name, value in self._reader.other.items():
            self._tx.values[self._at[name]] = value

    def _release_start(self) -> None:
        """Replace the request START with NONE, so that START is not pressed again when this pendant resumes sending.

        The request counter of this pendant may then differ from the last counter that the HAL received. With the request START,
        the HAL would interpret the difference as a new press.
        """
        if self._tx.values[self._at["Request"]] == Request.START:
            self._tx.values[self._at["Request"]] = Request.NONE

    def _answer(self) -> None:
        sent = self._send(self._tx.seal(self._reader.tag))
        if self.answered % self._status_cycles == 0:
            self._status.values[self._uptime_at] = self.answered * PERIOD
            self._send(self._status.seal())
        self.answered += 1
        self.answered_in_row = self.answered_in_row + 1 if sent else 0

    def _send(self, frames: Frames) -> bool:
        """Send one frame, and return whether the transmit queue had room for it. The HAL detects a missing frame by a timeout."""
        try:
            self._bus.send(frames)
        except BusFull:
            return False
        return True
