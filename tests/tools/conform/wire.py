"""Bus between node tester and emulated node, and functions that read and change frames on their way.

The functions calculate E2E counter and CRC independently of the code under test.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable
from typing import Any

import numpy as np

from atalante_dbc import Message
from atalante_hal.bus.pair import PairBus
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames, joined, new_frames

NO_FRAME = new_frames(0)


class Wire:
    """Bus of the node tester. `to_node` and `from_node` replace each frame on its way by zero or more frames."""

    def __init__(self, bus: PairBus) -> None:
        self._bus = bus
        self.to_node: Callable[[Frames], Frames] | None = None
        self.from_node: Callable[[Frames], Frames] | None = None
        #: Function that returns additional frames of the node; called at every receive.
        self.unsolicited: Callable[[], Frames] = lambda: NO_FRAME
        self.sync_sent = False  # since the last receive
        self._syncs = range(0x10, 0x14)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def send(self, frames: Frames) -> None:
        self.sync_sent |= int(frames["can_id"][-1]) in self._syncs
        if self.to_node is None:
            self._bus.send(frames)
            return
        for row in range(len(frames)):
            kept = self.to_node(frames[row : row + 1].copy())
            if len(kept):
                self._bus.send(kept)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        count = self._bus.receive(frames, timeout)
        if self.from_node is not None:
            kept = [self.from_node(frames[row : row + 1].copy()) for row in range(count)]
            together = joined([*kept, self.unsolicited()])
            count = len(together)
            frames[:count] = together
        self.sync_sent = False
        return count


def protect(frame: Frames, message: Message, *, counter: int | None = None, data_id: int | None = None) -> Frames:
    """Write valid length, format, counter and CRC into a frame."""
    frame["len"], frame["flags"] = message.length, FLAG_FDF | FLAG_BRS
    data = frame["data"][0]
    data[message.length :] = 0
    if counter is not None:
        data[2] = counter & 0xFF
    protected_id = message.data_id if data_id is None else data_id
    code = crc_hqx(protected_id.to_bytes(2, "little"), crc_hqx(data[2 : message.length].tobytes(), 0xFFFF))
    data[:2] = code & 0xFF, code >> 8
    return frame


def crc_holds(frame: Frames, data_id: int) -> bool:
    """Return whether the CRC of a frame is valid for its own length."""
    data = frame["data"][0][: frame["len"][0]].tobytes()
    return crc_hqx(data_id.to_bytes(2, "little"), crc_hqx(data[2:], 0xFFFF)) == int.from_bytes(data[:2], "little")


def is_good(frame: Frames, message: Message) -> bool:
    """Return whether length, format and CRC of a frame are valid."""
    shape = int(frame["len"][0]), int(frame["flags"][0]) & FLAG_FDF
    return shape == (message.length, FLAG_FDF) and crc_holds(frame, message.data_id)


def raw(frame: Frames, message: Message, signal: str) -> int:
    """Return the raw code of a signal in a frame."""
    s = message.signal(signal)
    return int.from_bytes(frame["data"][0].tobytes(), "little") >> s.start & (1 << s.length) - 1


def put(frame: Frames, message: Message, signal: str, code: int) -> None:
    """Write the raw code of a signal into a frame."""
    s = message.signal(signal)
    payload = int.from_bytes(frame["data"][0].tobytes(), "little")
    payload = payload & ~((1 << s.length) - 1 << s.start) | code << s.start
    frame["data"][0] = np.frombuffer(payload.to_bytes(64, "little"), np.uint8)


#: Function `(frame, message, memory)` that replaces a frame of the HAL. It returns None for an unchanged frame.
#: `memory["other"]` is the Data ID of another message.
Reading = Callable[[Frames, Message, dict], Frames | None]


def no_crc(frame: Frames, message: Message, memory: dict) -> Frames | None:
    """Repair a wrong CRC, so that the node accepts the frame."""
    if crc_holds(frame, message.data_id) or crc_holds(frame, memory["other"]):
        return None
    return protect(frame, message)


def no_data_id(frame: Frames, message: Message, memory: dict) -> Frames | None:
    """Replace the Data ID of another message, so that the node accepts the frame."""
    return protect(frame, message) if crc_holds(frame, memory["other"]) else None


def no_repetition(frame: Frames, message: Message, memory: dict) -> Frames | None:
    """Replace a repeated counter by the next counter, so that the node accepts the frame."""
    if not is_good(frame, message):
        return None
    counter = int(frame["data"][0][2])
    memory["shift"] = memory.get("shift", 0) + (counter == memory.get("last"))
    memory["last"] = counter
    return protect(frame, message, counter=counter + memory["shift"])


def no_length(frame: Frames, message: Message, _: dict) -> Frames | None:
    """Replace a wrong length or format, so that the node accepts the frame."""
    shape = int(frame["len"][0]), int(frame["flags"][0]) & FLAG_FDF
    return None if shape == (message.length, FLAG_FDF) else protect(frame, message)
