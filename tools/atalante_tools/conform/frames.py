"""One message as the bench says it, well or deliberately wrong, and as it hears it: without the receiver's usual forgiveness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from atalante_dbc import Message
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.e2e import COUNTER_BYTE, CRC_BYTES, crc, data_id_bytes
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames

_FD: Final = FLAG_FDF | FLAG_BRS


class Outgoing:
    """Sender of one message, frame by frame. Every defect of a frame is asked for; all else about it is right."""

    def __init__(self, message: Message) -> None:
        self.message = message
        self._codec = Codec([message])
        self._template = self._codec.template()
        self._values = np.zeros(self._codec.size)
        self._counter = 255  # of the last frame

    def frame(
        self,
        values: Mapping[str, float],
        *,
        raw: Mapping[str, int] | None = None,
        counter: int | None = None,
        data_id: int | None = None,
        length: int | None = None,
        classic: bool = False,
        flip: int | None = None,
    ) -> Frames:
        """The next frame. Shape (1,).

        Args:
            values: physical value of each signal that is not 0, DBC units.
            raw: codes to write instead, whatever the range says.
            counter: this one instead of the next; the sequence is not moved by it.
            data_id: protect for another message.
            length: cut or fill the payload, and protect it as it is then.
            classic: a frame of classic CAN.
            flip: bit of the payload to damage after protection.
        """
        message, codec = self.message, self._codec
        self._values.fill(0.0)
        for name, value in values.items():
            self._values[codec.index(message.name, name)] = value
        frames = self._template.copy()
        codec.encode(self._values, frames)
        data = frames["data"][0]
        for name, code in (raw or {}).items():
            signal = message.signal(name)
            word = data.view("<u8")[signal.start // 64 :][:1]
            shift, mask = np.uint64(signal.start % 64), np.uint64((1 << signal.length) - 1)
            word[0] = word[0] & ~(mask << shift) | np.uint64(code) << shift
        if counter is None:
            self._counter = counter = (self._counter + 1) & 0xFF
        data[COUNTER_BYTE] = counter
        if length is not None:
            frames["len"] = length
        if classic:
            frames["flags"] = 0
        size = int(frames["len"][0])
        code = crc(data[CRC_BYTES:size].tobytes(), data_id_bytes(message.data_id if data_id is None else data_id))
        data[:CRC_BYTES] = code & 0xFF, code >> 8
        if flip is not None:
            data[flip // 8] ^= 1 << flip % 8
        return frames

    @property
    def counter(self) -> int:
        """Counter of the last frame in sequence."""
        return self._counter


@dataclass(frozen=True)
class Heard:
    """One frame of the node under test. What is wrong with it is noted, not refused."""

    message: Message
    cycle: int  # of the last SYNC before it
    time: float  # s
    length_right: bool
    format_right: bool  # CAN FD with bit rate switch, data frame
    crc_right: bool
    counter: int
    reserved_zero: bool
    outside: tuple[str, ...]  # signals outside their range or with their invalid code
    values: dict[str, float]  # DBC units; empty when the length is wrong


class Incoming:
    """Listener to one message."""

    def __init__(self, message: Message) -> None:
        self.message = message
        self._codec = Codec([message])
        self._names = [s.name for _, s in self._codec.signals]
        self._frames = self._codec.template()
        self._decoded = np.zeros(self._codec.size)
        self._data_id = data_id_bytes(message.data_id)
        used = np.zeros(64, np.uint8)
        for signal in message.signals:
            for bit in range(signal.start, signal.start + signal.length):
                used[bit // 8] |= 1 << bit % 8
        self._reserved = (~used)[: message.length]

    def hear(self, frame: Frames, cycle: int, time: float) -> Heard:
        """Take one frame apart. Shape (1,)."""
        message = self.message
        length = int(frame["len"][0])
        payload = frame["data"][0][:length]
        length_right = length == message.length
        values: dict[str, float] = {}
        outside: tuple[str, ...] = ()
        if length_right:
            self._frames["data"][0][:length] = payload
            inside = self._codec.decode(self._frames, self._decoded)
            values = dict(zip(self._names, self._decoded.tolist(), strict=True))
            if not inside:
                outside = tuple(s.name for s in message.signals if not self._is_inside(s.name, values[s.name]))
        said = int(payload[0]) | int(payload[1]) << 8 if length >= CRC_BYTES else -1
        return Heard(
            message=message,
            cycle=cycle,
            time=time,
            length_right=length_right,
            format_right=int(frame["flags"][0]) & _FD == _FD and int(frame["can_id"][0]) == message.frame_id,
            crc_right=crc(payload[CRC_BYTES:].tobytes(), self._data_id) == said,
            counter=int(payload[COUNTER_BYTE]) if length > COUNTER_BYTE else -1,
            reserved_zero=not length_right or not (payload & self._reserved).any(),
            outside=outside,
            values=values,
        )

    def _is_inside(self, name: str, value: float) -> bool:
        signal = self.message.signal(name)
        slack = 0.5 * abs(signal.factor)
        return signal.minimum - slack <= value <= signal.maximum + slack
