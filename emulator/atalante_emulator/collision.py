"""Detection of two senders of one message, from frames that are all valid by themselves.

A sender increments its counter by one with each frame. CAN may lose or repeat a frame, but it keeps the order of a sender's
frames. Two different frames with the same counter, or two frames of one cycle whose counters are not consecutive, therefore
come from two senders.
"""

from __future__ import annotations

from atalante_dbc import Message
from atalante_hal.wire.e2e import COUNTER_BYTE, CRC_BYTES, crc, data_id_bytes
from atalante_hal.wire.frame import Frames


class Senders:
    """Detector for two senders of one message; the emulator runs it in every imperfect cycle."""

    def __init__(self, message: Message) -> None:
        self._message = message
        self._data_id = data_id_bytes(message.data_id)
        self._last: bytes | None = None  # payload received last
        self._last_cycle = -1

    def are_two(self, frames: Frames, cycle: int) -> bool:
        """Return whether the frames of a cycle come from two senders.

        Args:
            frames: all frames received in the cycle, in the order of reception, shape (n,).
            cycle: number of the cycle; it increases by one per cycle.
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
        """Return the payloads of the message's frames whose length and CRC are correct."""
        message = self._message
        candidates = frames[(frames["can_id"] == message.frame_id) & (frames["len"] == message.length)]
        payloads = [frame["data"][: message.length].tobytes() for frame in candidates]
        return [p for p in payloads if crc(p[CRC_BYTES:], self._data_id) == int.from_bytes(p[:CRC_BYTES], "little")]
