"""Frames of a test: `MessageSender` builds valid or defective frames, `MessageReceiver` decodes and checks received frames."""

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
#: Format of a valid frame, as in `ReceivedFrame.format`.
FD_FORMAT: Final = "CAN FD with bit rate switch"


class MessageSender:
    """Sender of test frames of one message. Frames are valid, unless the caller of `frame` requests a defect.

    Args:
        message: message to send.
        sync: sender of the SYNC if the message is a command, otherwise None. The alive counter of a command is the alive counter
            of the SYNC in the next cycle.
    """

    def __init__(self, message: Message, sync: MessageSender | None = None) -> None:
        self.message, self._sync = message, sync
        self._codec = Codec([message])
        self._template = self._codec.template()
        self._values = np.zeros(self._codec.size)
        self._counter = 255  # alive counter of the last frame, 255 before the first frame

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
        """Return the next frame to send, shape (1,). The keyword arguments can make the frame defective.

        Args:
            values: physical value of each signal, in DBC units; signals that are missing are 0.
            raw: raw code per signal, which replaces the encoded value and is not range-checked.
            counter: alive counter of the frame; None means the next alive counter. The caller sends a command after the
                next SYNC. So the next alive counter of a command is the alive counter of the next SYNC plus 1.
                A given counter does not advance the sequence.
            data_id: E2E Data ID for the CRC; None means the Data ID of the message.
            length: payload length [byte], for which the CRC is valid; None means the length in the DBC.
            classic: True for a classic CAN frame.
            flip: payload bit that is inverted after the CRC is written.
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
            before = self._counter if self._sync is None else self._sync.counter + 1
            self._counter = counter = (before + 1) & 0xFF
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
        """Return the last alive counter that `frame` computed. Counters that the caller gave to `frame` are left out."""
        return self._counter


@dataclass(frozen=True)
class ReceivedFrame:
    """Received frame of the node under test, with the result of each check of the frame."""

    message: Message
    cycle: int  # number of the cycle in which the frame was received
    time: float  # receive time [s]
    length: int  # payload length [byte]
    format: str  # "CAN FD with bit rate switch", "CAN FD without bit rate switch" or "classic CAN"
    crc: int  # CRC in the frame, -1 if the frame is too short
    crc_expected: int  # CRC over payload and Data ID
    counter: int  # alive counter, -1 if the frame is too short
    reserved_zero: bool
    out_of_range: tuple[str, ...]  # signals with a value out of range or with the invalid code
    values: dict[str, float]  # physical values in DBC units; empty if the length is wrong

    @property
    def length_valid(self) -> bool:
        """Return whether the payload has the length in the DBC."""
        return self.length == self.message.length

    @property
    def format_valid(self) -> bool:
        """Return whether the frame is a CAN FD frame with bit rate switch."""
        return self.format == FD_FORMAT

    @property
    def crc_valid(self) -> bool:
        """Return whether the CRC matches payload and Data ID."""
        return self.crc == self.crc_expected


class MessageReceiver:
    """Receiver and decoder of one message of the node under test."""

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

    def decode(self, frame: Frames, cycle: int, time: float) -> ReceivedFrame:
        """Decode and check one frame.

        Args:
            frame: received frame, shape (1,).
            cycle: number of the current cycle.
            time: receive time [s].
        """
        message = self.message
        length = int(frame["len"][0])
        payload = frame["data"][0][:length]
        length_valid = length == message.length
        values: dict[str, float] = {}
        out_of_range: tuple[str, ...] = ()
        if length_valid:
            self._frames["data"][0][:length] = payload
            inside = self._codec.decode(self._frames, self._decoded)
            values = dict(zip(self._names, self._decoded.tolist(), strict=True))
            if not inside:
                out_of_range = tuple(s.name for s in message.signals if not self._is_inside(s.name, values[s.name]))
        flags = int(frame["flags"][0])
        classic = "CAN FD without bit rate switch" if flags & FLAG_FDF else "classic CAN"
        return ReceivedFrame(
            message=message,
            cycle=cycle,
            time=time,
            length=length,
            format=FD_FORMAT if flags & _FD == _FD else classic,
            crc=int(payload[0]) | int(payload[1]) << 8 if length >= CRC_BYTES else -1,
            crc_expected=crc(payload[CRC_BYTES:].tobytes(), self._data_id),
            counter=int(payload[COUNTER_BYTE]) if length > COUNTER_BYTE else -1,
            reserved_zero=not length_valid or not (payload & self._reserved).any(),
            out_of_range=out_of_range,
            values=values,
        )

    def _is_inside(self, name: str, value: float) -> bool:
        signal = self.message.signal(name)
        slack = 0.5 * abs(signal.factor)
        return signal.minimum - slack <= value <= signal.maximum + slack
