"""Test vectors of a network, as binary stream or JSON: payloads, and the values that the Python codec decodes from them.

An image is a set of payloads, one payload per message. The generated host test reads the binary stream, which is little endian.
The stream begins with 8 bytes magic, u32 network hash and u32 number of images; then the images follow. Each image
contains the messages of the `Build` in DBC order:

- message that the node receives: payload, u8 flag (1: every decoded signal is in range), f64 value of each decoded signal;
- message that the node sends: f64 value of each signal after the E2E header (NaN: invalid code), encoded payload.

In image 3, the value of each signal is half a step above an even code if float64 arithmetic is exact for this value. C and
Python must round it in the same direction.
In the images 5, 7, 9, ..., the payloads that the node receives have random bits. All other payloads are encoded from
signal values.
The alive counter is the low byte of the image number, which starts at 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from struct import Struct
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message, Signal
from atalante_hal.types import Vector
from atalante_hal.wire.codec import HIGH, LOW, Codec
from atalante_hal.wire.e2e import COUNTER_BYTE, CRC_BYTES, crc, data_id_bytes
from atalante_hal.wire.frame import FRAME_BYTES, HEADER_BYTES
from atalante_hal.wire.process_image import TransmitImage

if TYPE_CHECKING:
    from atalante_tools.dbc.build import Build

MAGIC: Final = b"ATVEC\x00\x00\x01"
HEADER: Final = Struct("<8sII")


class Vectors:
    """Generator of test vectors for the messages of a `Build`. Equal seeds give equal vectors."""

    def __init__(self, build: Build, seed: int) -> None:
        self._build = build
        self._random = np.random.default_rng(seed)
        self._sender = TransmitImage(build.messages)
        self._codec = codec = self._sender.codec
        self._received = codec.template()
        self._decoded = np.empty(codec.size)
        # The range check of the C code covers only the signals that the node receives.
        self._checked = Codec([replace(m, signals=build.received(m) or m.signals) for m in build.messages])
        self._in_range = np.ones(len(build.messages), np.uint8)
        octets = self._received.view(np.uint8).reshape(-1, FRAME_BYTES)
        self._counters = octets[:, HEADER_BYTES + COUNTER_BYTE]
        self._crcs = octets.view("<u2")[:, HEADER_BYTES // 2]
        self._protected = [
            (row.data[HEADER_BYTES + CRC_BYTES : HEADER_BYTES + m.length], data_id_bytes(m.data_id))
            for row, m in zip(octets, build.messages, strict=True)
        ]
        self._minimum = np.array([s.minimum for _, s in codec.signals])
        self._maximum = np.array([s.maximum for _, s in codec.signals])
        # NaN is encoded as the invalid code. For a signal without invalid code, the minimum of the signal is sent.
        no_code = [s.invalid_raw is None for _, s in codec.signals]
        self._invalid = np.where(no_code, self._minimum, np.nan)
        self._half_step = self._half_steps()
        self._order = self._stream_order()

    def _half_steps(self) -> Vector:
        """Return one physical value per signal for the test of rounding, shape (signals,).

        The value lies half a quantisation step above an even raw code. If the range of the signal has no such code, or if
        float64 arithmetic is not exact, the value is the minimum of the signal.
        """
        plan = self._codec.table.plan
        factor, offset = np.array([(s.factor, s.offset) for _, s in self._codec.signals]).T
        code = np.maximum(plan[LOW] + plan[LOW] % 2, 0)
        half = code + 0.5
        value = half * factor + offset
        exact = ((value - offset) / factor == half) & (value / factor == half + offset / factor)
        return np.where(exact & (code < plan[HIGH]), value, self._minimum)

    def _stream_order(self) -> npt.NDArray[np.intp]:
        """Return the index array `order` that sorts the bytes of an image into the order of the stream.

        An image is a set of payloads, one payload per message.
        The method `images` joins one array per kind of data, such as all payloads and all signal values. The stream has the
        order of the messages instead. Byte k of an image in the stream is the byte of the joined arrays at the index `order[k]`.
        """
        build, codec = self._build, self._codec
        rows = len(build.messages)
        parts = (FRAME_BYTES * rows, FRAME_BYTES * rows, 8 * codec.size, 8 * codec.size, rows)
        received, sent, decoded, encoded, in_range = (sum(parts[:index]) for index in range(len(parts)))

        def values(start: int, message: Message, signals: Iterable[Signal]) -> list[int]:
            offsets = [start + 8 * codec.index(message.name, s.name) for s in signals]
            return [offset + byte for offset in offsets for byte in range(8)]

        def payload(start: int, row: int, message: Message) -> range:
            first = start + FRAME_BYTES * row + HEADER_BYTES
            return range(first, first + message.length)

        order: list[int] = []
        for row, message in enumerate(build.messages):
            if signals := build.received(message):
                order += [*payload(received, row, message), in_range + row, *values(decoded, message, signals)]
            if build.sends(message):
                order += [*values(encoded, message, signals_after_header(message)), *payload(sent, row, message)]
        return np.array(order, np.intp)

    def header(self, images: int) -> bytes:
        """Return the header of the stream: magic number, network hash and number of images.

        Args:
            images: number of images. An image is a set of payloads, one payload per message.
        """
        return HEADER.pack(MAGIC, self._build.network.hash32, images)

    def images(self, count: int) -> Iterator[bytes]:
        """Yield images as bytes of the binary stream. An image is a set of payloads, one payload per message.

        Image 0 contains the minimum of each signal, image 1 the maximum, image 2 the invalid code, and image 3 a half step. All
        further images contain random values.

        Call this method only once per instance, because a second call would continue the counters and the random numbers.

        Args:
            count: number of images.
        """
        for image in range(count):
            encoded = self._next(image)
            parts = (self._received, self._sender.frames, self._decoded, encoded, self._in_range)
            yield np.concatenate([part.view(np.uint8) for part in parts])[self._order].tobytes()

    def examples(self) -> Iterator[dict[str, Any]]:
        """Yield four test vectors of each message as JSON objects.

        The four vectors contain the minimum of each signal, the maximum, the invalid code, and a random value.

        Call this method only once per instance, because a second call would continue the counters and the random numbers.
        """
        for number, kind in ((0, "minimum"), (1, "maximum"), (2, "invalid codes"), (4, "random")):
            self._next(number)
            for row, message in enumerate(self._build.messages):
                values = {
                    s.name: float(self._decoded[self._codec.index(message.name, s.name)]) for s in message.signals
                }
                yield {
                    "message": message.name,
                    "what": kind,
                    "id": message.frame_id,
                    "data_id": message.data_id,
                    "payload": self._received["data"][row][: message.length].tobytes().hex(),
                    "in_range": bool(self._in_range[row]),
                    "values": values,
                }

    def _next(self, number: int) -> Vector:
        """Encode and decode one payload of each message. Return the signal values before encoding, shape (signals,).

        Args:
            number: 0 encodes the minimum of each signal, 1 the maximum, 2 the invalid code, 3 a half step, and a higher number
                random values.
        """
        fixed = (self._minimum, self._maximum, self._invalid, self._half_step)
        encoded = fixed[number] if number < len(fixed) else self._random.uniform(self._minimum, self._maximum)
        self._sender.values[:] = encoded
        self._sender.seal()
        if number % 2 and number > len(fixed):
            data = self._received["data"]
            data[:] = self._random.integers(0, 256, data.shape, np.uint8)
            self._counters.fill(number & 0xFF)
            self._crcs[:] = [crc(payload, data_id) for payload, data_id in self._protected]
        else:
            self._received[:] = self._sender.frames
        self._codec.decode(self._received, self._decoded)
        self._in_range.fill(1)
        if not self._checked.decode(self._received, np.empty(self._checked.size)):
            self._in_range[self._checked.rows_outside()] = 0
        return encoded


def signals_after_header(message: Message) -> list[Signal]:
    """Return the signals of a message except the CRC and the counter of the E2E header."""
    return [s for s in message.signals if s.name not in ("Crc", "Counter")]
