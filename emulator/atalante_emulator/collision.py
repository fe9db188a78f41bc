"""Two senders of one message: what a receiver can tell from the frames it gets, each of them right.

One sender counts on by one from frame to frame. Frames may be lost and CAN may repeat one, but it puts no frame of a sender
before an earlier one: whoever hears two different frames with one counter, or two in one cycle that do not follow each other,
hears two senders.
"""

from __future__ import annotations

from atalante_dbc import Message
from atalante_hal.wire.e2e import COUNTER_BYTE, CRC_BYTES, crc, data_id_bytes
from atalante_hal.wire.frame import Frames


class Senders:
    """The frames of one message, watched in every cycle in which something is not as expected."""

    def __init__(self, message: Message) -> None:
        self._message = message
        self._data_id = data_id_bytes(message.data_id)
        self._last: bytes | None = None  # heard last
        self._last_cycle = -1

    def are_two(self, frames: Frames, cycle: int) -> bool:
        """Whether the frames of a cycle are of two senders.

        Args:
            frames: everything that came, in that order. Shape (n,).
            cycle: a number that goes on by one.
        """
        if self._last_cycle != cycle - 1:
            self._last = None
        self._last_cycle = cycle
        two, first = False, True
        for payload in self._intact(frames):
            if self._last is not None and payload != self._last:
                step = (payload[COUNTER_BYTE] - self._last[COUNTER_BYTE]) & 0xFF
                two |= step == 0 or (step != 1 and not first)
            self._last, first = payload, False
        return two

    def _intact(self, frames: Frames) -> list[bytes]:
        """Payloads of the message's frames whose length and CRC are right."""
        message = self._message
        mine = frames[(frames["can_id"] == message.frame_id) & (frames["len"] == message.length)]
        payloads = [frame["data"][: message.length].tobytes() for frame in mine]
        return [p for p in payloads if crc(p[CRC_BYTES:], self._data_id) == int.from_bytes(p[:CRC_BYTES], "little")]
