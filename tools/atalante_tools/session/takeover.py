"""Takeover rule of the pendants: after each takeover, exactly one pendant sends.

    SYNC and frames of other pendants -> PendantReader -> Takeover -> answer or silence

A pendant answers each SYNC with a frame whose counter is the low byte of the signal Cycle. Only an intact frame with the counter
of the last SYNC is treated as a frame of another pendant. A damaged, old or replayed frame changes nothing.

A pendant that receives frames of another pendant stops sending and listens. If the other pendant continues, the listening
pendant gives up. If no frame is received, the listening pendant resumes sending. An established pendant stops at once. A new
pendant stops at a random cycle of its takeover. Two pendants that stop in the same cycle also resume in the same cycle. Each of
them then stops after a new random time, until one pendant stops alone and gives up.
"""

from __future__ import annotations

from random import Random
from typing import Final

from atalante_dbc import Message, Network
from atalante_hal.wire.e2e import COUNTER_BYTE, MAX_DELTA, Check
from atalante_hal.wire.frame import Frames
from atalante_hal.wire.process_image import ReceiveImage

#: Shortest time for which a new pendant sends [cycles], so that the older pendant can fall silent.
#: If the older pendant still sends after `TAKEOVER_CYCLES`, the new pendant may fall silent.
TAKEOVER_CYCLES: Final = 50
#: Shortest time for which a pendant sends after it has resumed sending [cycles]. Then it may stop again.
RETRY_CYCLES: Final = 8
#: A random time of 0 to `DRAW_CYCLES` - 1 is added to `TAKEOVER_CYCLES` and to `RETRY_CYCLES` [cycles].
DRAW_CYCLES: Final = 50
#: Number of consecutive frames of another pendant after which a sending pendant falls silent and listens.
#: The HAL tolerates two senders for three cycles.
PRESENT_FRAMES: Final = 2
#: Number of consecutive frames of another pendant after which a silent pendant gives up. It then never sends again.
LOST_FRAMES: Final = 3
#: Time without a frame of another pendant after which a silent pendant resumes sending [cycles].
#: The HAL reports a timeout after 5 cycles without a frame.
QUIET_CYCLES: Final = 3
#: Results of the E2E check that count as an intact frame: the CRC is valid. The alive counter may have any value.
_INTACT: Final = (Check.OK, Check.SOME_LOST, Check.REPEATED, Check.CONFLICT, Check.WRONG_SEQUENCE)


class Takeover:
    """Takeover rule of one pendant. The rule decides whether the pendant answers the last SYNC.

    Attributes:
        established: Whether this pendant was the only pendant that sent at the end of its takeover.
        silent: Whether this pendant stopped sending to listen for another pendant.
        lost: Whether this pendant gave up. It never sends again.
    """

    def __init__(self, *, established: bool = False, quiet: int = QUIET_CYCLES, seed: int | None = None) -> None:
        """Start as a new pendant that only listens, or as an established pendant that sends.

        Args:
            established: Whether this pendant sends from the beginning, and stops for each new pendant.
            quiet: Time without a frame of another pendant after which this pendant resumes sending [cycles].
            seed: Seed of the random times. None means a random seed of the operating system.
        """
        self._quiet, self._random = quiet, Random(seed)
        self._sending = self.established = established
        self.silent = self.lost = False
        self._tag = -1  # counter value that every answer to the last SYNC contains; -1 before the first SYNC
        self._cycle = 0  # number of SYNCs
        self._free_from = 0  # first cycle in which this pendant may stop sending
        self._quiet_from = 0  # first cycle of the current pause in the frames of other pendants
        self._received_at = -MAX_DELTA - 1  # cycle in which the newest frame of another pendant was received
        # Number of consecutive frames of another pendant, with at most `MAX_DELTA` cycles from one frame to the next.
        # The count restarts when this pendant falls silent.
        self._received = 0

    @property
    def present(self) -> bool:
        """Return whether frames of another pendant are being received."""
        return self._received >= PRESENT_FRAMES and self._cycle - self._received_at <= MAX_DELTA

    @property
    def sends(self) -> bool:
        """Return whether this pendant answers the last SYNC."""
        return self._sending and not self.silent and not self.lost

    def start(self) -> None:
        """Begin the takeover as a new pendant: answer each SYNC from now on."""
        self._sending = True
        self._free_from = self._cycle + 1 + TAKEOVER_CYCLES + self._random.randrange(DRAW_CYCLES)

    def sync(self, tag: int) -> None:
        """Process a SYNC received from the HAL: decide whether this pendant answers the SYNC.

        Args:
            tag: Counter that an answer to this SYNC contains, 0 to 255.
        """
        self._cycle += 1
        self._tag = tag
        if self.silent and self._cycle - self._quiet_from >= self._quiet:
            self.silent = False
            self._free_from = self._cycle + RETRY_CYCLES + self._random.randrange(DRAW_CYCLES)
        elif self.sends and self._cycle >= self._free_from:
            if self.present:
                self.silent = True
                self._quiet_from, self._received = self._cycle, 0
            else:
                self.established = True

    def answer(self, counter: int) -> bool:
        """Count an intact frame of another pendant if the frame answers the last SYNC.

        Args:
            counter: Alive counter of the frame, 0 to 255.

        Returns:
            Whether the frame is the first answer of another pendant to the last SYNC.
        """
        if counter != self._tag or self._received_at == self._cycle:
            return False
        in_row = self._cycle - self._received_at <= MAX_DELTA
        self._received = self._received + 1 if in_row else 1
        self._received_at, self._quiet_from = self._cycle, self._cycle + 1
        if self.silent and self._received >= LOST_FRAMES:
            self.lost, self.silent = True, False
        return True


class PendantReader:
    """Reader of the frames on the bus of the pendant: passes each SYNC and each frame of another pendant to the takeover rule.

    Attributes:
        tag: Counter that an answer to the last SYNC contains, 0 to 255.
        hal_state: Signal HalState of the last SYNC.
        gaps: Number of rejected SYNCs. After a gap, SYNCs are rejected until enough consecutive SYNCs were received.
        other: Signal name -> value in the last frame with which another pendant answered a SYNC. Empty before the first
            such frame.
    """

    def __init__(self, network: Network, takeover: Takeover) -> None:
        """Set up the process image of the reader.

        Args:
            network: Nodes and messages of the DBC.
            takeover: Rule to which each SYNC and each frame of another pendant is passed.
        """
        state, sync = pendant_messages(network)
        self._takeover = takeover
        self._image = ReceiveImage([sync, state])
        rows, index = self._image.codec.rows, self._image.codec.index
        self._sync_row, self._state_row = rows[sync.name], rows[state.name]
        self._ids = {sync.frame_id, state.frame_id}
        self._state_index = {s.name: index(state.name, s.name) for s in state.signals}
        self._hal_index, self._cycle_index = index(sync.name, "HalState"), index(sync.name, "Cycle")
        self.tag = 0
        self.hal_state = 0
        self.gaps = 0
        self.other: dict[str, float] = {}

    def read(self, frames: Frames, count: int) -> int:
        """Process SYNC frames and pendant frames in the order in which they were received; ignore all other messages.

        Args:
            frames: Receive buffer.
            count: Number of received frames at the start of the buffer.

        Returns:
            Number of SYNCs in these frames.
        """
        synced = 0
        for index, can_id in enumerate(frames["can_id"][:count].tolist()):
            if can_id in self._ids:
                synced += self._read_one(frames[index : index + 1])
        return synced

    def _read_one(self, frame: Frames) -> bool:
        """Read one frame, shape (1,). Return whether the frame is a SYNC."""
        image = self._image
        image.new_cycle()
        image.accept_each(frame, 1)
        if (check := Check(image.check[self._state_row])) in _INTACT:
            counter = int(frame["data"][0, COUNTER_BYTE])
            if self._takeover.answer(counter) and check.fresh:
                self.other = {name: float(image.values[at]) for name, at in self._state_index.items()}
        sync = Check(image.check[self._sync_row])
        if not sync.fresh:
            self.gaps += sync is not Check.NO_DATA
            return False
        self.tag = int(image.values[self._cycle_index]) & 0xFF
        self.hal_state = int(image.values[self._hal_index])
        self._takeover.sync(self.tag)
        return True


def pendant_messages(network: Network) -> tuple[Message, Message]:
    """Return the cyclic message of the pendant, and the SYNC message that the pendant answers.

    Args:
        network: Nodes and messages of the DBC.
    """
    state = network.message("PENDANT_STATE")
    sync = next(m for m in network.sent_by("HAL") if m.bus == state.bus and m.name.startswith("SYNC_"))
    return state, sync
