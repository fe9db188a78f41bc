"""Writer of decoded signals as MCAP, with one topic per message (`/can/LEFT_FH_STATE`) and protobuf schemas from the DBC.

Every protobuf field has eight bytes: a double, or a fixed-width integer if the values in the DBC are integers. Because
all fields have the same width, array operations can encode all messages of a chunk. Fields that the multiplexer does
not select are absent from the protobuf message.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from mcap.writer import CompressionType, Writer

from atalante_dbc.foreign import Layout
from atalante_tools.canlog.decode.signals import DecodedFrames
from atalante_tools.canlog.plan import Plan

_PACKAGE = "atalante.can"
_FIXED64 = 1  # protobuf wire type of a value of eight bytes
_TYPES: dict[str, tuple[Any, str]] = {
    "f": (FieldDescriptorProto.TYPE_DOUBLE, "<f8"),
    "i": (FieldDescriptorProto.TYPE_SFIXED64, "<i8"),
    "u": (FieldDescriptorProto.TYPE_FIXED64, "<u8"),
    "O": (FieldDescriptorProto.TYPE_DOUBLE, "<f8"),  # integers wider than 64 bits
}


class McapSink:
    """MCAP file with one protobuf message per CAN frame, in the order of the log."""

    def __init__(self, path: Path, plan: Plan) -> None:
        self._plan = plan
        self.values = 0
        self._file = path.open("wb")
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="atalante decode")
        self._writer.add_metadata("dbc", {"file": plan.catalogue.path.name, "crc32": f"{plan.catalogue.hash32:08X}"})
        #: (message index in the plan, channel name in the log) -> number of the MCAP topic.
        self._topics: dict[tuple[int, str], int] = {}
        self._schemas: dict[int, int] = {}
        #: Messages to write at the next `flush`: (index in the chunk, topic number, time stamp [ns], payload).
        self._buffered: list[tuple[int, int, int, bytes]] = []

    def write(self, decoded: DecodedFrames, channels: Sequence[str]) -> None:
        """Encode the decoded frames of one CAN message as protobuf messages.

        Args:
            decoded: decoded frames of one message.
            channels: names of the channels of the log.
        """
        columns = [decoded.column(index) for index in range(len(decoded.codec.fields))]
        layout = self._plan.layouts[decoded.row]
        if decoded.row not in self._schemas:
            self._schemas[decoded.row] = self._writer.register_schema(
                f"{_PACKAGE}.{layout.name}",
                "protobuf",
                _descriptor(
                    layout, [(f.name, c.values.dtype.kind) for f, c in zip(decoded.codec.fields, columns, strict=True)]
                ),
            )
        topics = np.array([self._topic(decoded.row, channels[channel]) for channel in decoded.channels.tolist()])
        masks = [c.present for c in columns]
        patterns = np.array([np.ones(len(topics), np.bool_) if m is None else m for m in masks]).T
        self.values += int(patterns.sum())
        for pattern in np.unique(patterns, axis=0) if any(m is not None for m in masks) else patterns[:1]:
            where = np.flatnonzero((patterns == pattern).all(axis=1))
            present_fields = [number for number, present in enumerate(pattern.tolist()) if present]
            payloads = encode([(number + 1, columns[number].values[where]) for number in present_fields], len(where))
            self._buffered += zip(
                decoded.indices[where].tolist(),
                topics[where].tolist(),
                decoded.stamps[where].tolist(),
                payloads,
                strict=True,
            )

    def flush(self) -> None:
        """Write the encoded messages of the current chunk to the file."""
        self._buffered.sort(key=lambda message: message[0])
        for _, topic, stamp, payload in self._buffered:
            self._writer.add_message(topic, stamp, payload, stamp)
        self._buffered.clear()

    def _topic(self, row: int, channel: str) -> int:
        """Return the MCAP topic number of a message on a log channel.

        The topic name is `/can/MESSAGE` on the first channel with this message, and `/can/CHANNEL/MESSAGE` on further
        channels.
        """
        topic = self._topics.get((row, channel))
        if topic is None:
            layout = self._plan.layouts[row]
            first = not any(known == row for known, _ in self._topics)
            name = f"/can/{layout.name}" if first else f"/can/{channel}/{layout.name}"
            metadata = {f.name: f.unit for f in layout.fields if f.unit} | {"channel": channel}
            topic = self._writer.register_channel(name, "protobuf", self._schemas[row], metadata)
            self._topics[row, channel] = topic
        return topic

    def close(self) -> None:
        """Write the file footer and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()


def encode(fields: Sequence[tuple[int, npt.NDArray[Any]]], count: int) -> list[bytes]:
    """Encode protobuf messages in which every field has eight bytes.

    Args:
        fields: (protobuf field number, values with shape (count,)) for each field.
        count: number of messages.
    """
    tags = [_varint(number << 3 | _FIXED64) for number, _ in fields]
    width = sum(len(tag) + 8 for tag in tags)
    out = np.empty((count, width), np.uint8)
    at = 0
    for tag, (_, values) in zip(tags, fields, strict=True):
        out[:, at : at + len(tag)] = list(tag)
        at += len(tag)
        eight = np.ascontiguousarray(values, _TYPES[values.dtype.kind][1])
        out[:, at : at + 8] = eight.view(np.uint8).reshape(count, 8)
        at += 8
    whole = out.tobytes()
    return [whole[first : first + width] for first in range(0, count * width, width)] if width else [b""] * count


def _varint(number: int) -> bytes:
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*found, number])


def _descriptor(layout: Layout, fields: Sequence[tuple[str, str]]) -> bytes:
    """Return the serialized protobuf descriptor of a message. The syntax is proto2, because the fields are optional."""
    files = FileDescriptorSet()
    file = files.file.add(name=f"{layout.name}.proto", package=_PACKAGE)
    message = file.message_type.add(name=layout.name)
    for number, (name, kind) in enumerate(fields, start=1):
        message.field.add(name=name, number=number, type=_TYPES[kind][0], label=FieldDescriptorProto.LABEL_OPTIONAL)
    serialized: bytes = files.SerializeToString()
    return serialized
