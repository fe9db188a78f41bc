"""Detection of two nodes that send the same message.

Each sender numbers its frames by an alive counter. Numbers that do not fit together show that there are two senders.
A sender increments its counter by one with each frame. CAN may lose or repeat a frame, but CAN keeps the order of the frames. So
two different frames with the same counter, one directly after the other, come from two senders. Two successive frames of one
cycle also come from two senders if their counters are not consecutive.
"""

from __future__ import annotations

from atalante_dbc import Message
from atalante_hal.wire.e2e import COUNTER_BYTE, CRC_BYTES, crc, data_id_bytes
from atalante_hal.wire.frame import Frames


class Senders:
    """Detect whether two nodes send the same message.

    The emulator runs the detector only in cycles with missing, rejected, late or extra frames.
    """

    def __init__(self, message: Message) -> None:
        self._message = message
        self._last: bytes | None = None  # payload received last
        self._last_cycle = -1

    def are_two(self, frames: Frames, cycle: int) -> bool:
        """Return whether the frames received in a cycle show that two nodes send the message.

        Args:
            frames: all frames received in the cycle, in the order of reception, shape (n,). Other messages are ignored.
            cycle: number of the cycle. The frames are compared with the frames of the previous call only if that call
                was in the previous cycle.
        """
        if self._last_cycle != cycle - 1:
            self._last = None
        self._last_cycle = cycle
        two, first = False, True
        for payload in intact_payloads(self._message, frames):
            if self._last is not None and payload != self._last:
                step = (payload[COUNTER_BYTE] - self._last[COUNTER_BYTE]) & 0xFF
                two |= step == 0 or (step != 1 and not first)
            self._last, first = payload, False
        return two


def intact_payloads(message: Message, frames: Frames) -> list[bytes]:
    """Return the payload of each frame of a message, if length and CRC of the frame are correct.

    Args:
        message: message of the DBC.
        frames: received frames, shape (n,). Other messages are ignored.
    """
    data_id = data_id_bytes(message.data_id)
    candidates = frames[(frames["can_id"] == message.frame_id) & (frames["len"] == message.length)]
    payloads = [frame["data"][: message.length].tobytes() for frame in candidates]
    return [p for p in payloads if crc(p[CRC_BYTES:], data_id) == int.from_bytes(p[:CRC_BYTES], "little")]
