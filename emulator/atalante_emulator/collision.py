"""Two senders of one message: what a receiver can tell from the frames of one cycle."""

from __future__ import annotations

from atalante_dbc import Message
from atalante_hal.e2e import COUNTER_BYTE, CRC_BYTES, crc, data_id_bytes
from atalante_hal.frame import Frames


def two_senders(frames: Frames, message: Message) -> bool:
    """Whether two different intact frames of a message carry the same alive counter: one sender alone never does that.

    Args:
        frames: of one cycle, shape (n,).
    """
    data_id = data_id_bytes(message.data_id)
    said: dict[int, bytes] = {}
    for frame in frames[(frames["can_id"] == message.frame_id) & (frames["len"] == message.length)]:
        payload = frame["data"][: message.length].tobytes()
        intact = crc(payload[CRC_BYTES:], data_id) == int.from_bytes(payload[:CRC_BYTES], "little")
        if intact and said.setdefault(payload[COUNTER_BYTE], payload) != payload:
            return True
    return False
