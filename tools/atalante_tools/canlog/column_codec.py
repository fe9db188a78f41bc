"""Decoder of CAN logs for any DBC: decodes many frames of one message in one call, and computes E2E CRCs.

The codec of the control loop (`codec.Codec`) decodes all messages of one cycle and requires that each signal lies in
one 64-bit word. The decoder in this module supports Intel and Motorola layouts, signals across two 64-bit words, 64-bit
signals, IEEE floats and multiplexed signals. The decoded values are equal to the values of cantools.
"""

from __future__ import annotations

from binascii import crc_hqx
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_dbc.foreign import Field, Layout
from atalante_hal.wire.e2e import CRC_BYTES, crc, data_id_bytes
from atalante_hal.wire.frame import FRAME_BYTES, Frames, as_words

Words = npt.NDArray[np.uint64]
Mask = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64] | npt.NDArray[np.int64] | npt.NDArray[np.uint64] | npt.NDArray[np.object_]

_WORD = 64
_FLOATS: dict[int, tuple[type[np.unsignedinteger], type[np.floating]]] = {
    16: (np.uint16, np.float16),
    32: (np.uint32, np.float32),
    64: (np.uint64, np.float64),
}
_INT64 = range(-(1 << 63), 1 << 63)
_UINT64 = range(1 << 64)


@dataclass(frozen=True)
class Column:
    """Values of one signal in many frames.

    Attributes:
        values: physical values, shape (n,), DBC units. The type is float64 if the signal is an IEEE float, or if its factor or
            offset in the DBC is not an integer. Otherwise the type is int64, uint64, or `object` with Python integers for values
            of more than 64 bits.
        present: mask of the frames that contain the signal, shape (n,); None means all frames. A frame without this signal
            contains another multiplexed signal, so the element of `values` for this frame is meaningless.
    """

    values: Values
    present: Mask | None


def payload_words(frames: Frames, length: int) -> Words:
    """Return the payloads as 64-bit little-endian words. Row k contains word k of every frame. Shape (words, n).

    Args:
        frames: `FRAME` records, shape (n,).
        length: payload length, bytes.
    """
    count = (length + 7) // 8
    return np.ascontiguousarray(as_words(frames)[:, 1 : 1 + count].T)


class ColumnCodec:
    """Decoder for one message layout. The order in `fields` is: signed fields, unsigned fields, float fields."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        kinds = ("signed", "unsigned", "float")
        self.fields: tuple[Field, ...] = tuple(sorted(layout.fields, key=lambda f: kinds.index(f.kind)))
        self._index = {field.name: index for index, field in enumerate(self.fields)}
        self._signed = sum(f.kind == "signed" for f in self.fields)
        self._plan()

    def index(self, name: str) -> int:
        """Return the index of a signal in `fields`. The result of `extract` has the signal in the row with the same index.

        Raises:
            KeyError: If the message has no such signal; the error lists the signals.
        """
        try:
            return self._index[name]
        except KeyError:
            raise KeyError(
                f"signal of {self.layout.name} must be one of {', '.join(self._index)}, got {name!r}"
            ) from None

    def _plan(self) -> None:
        """Choose for each field the 64-bit word from which the field is extracted.

        The word is a payload word (Intel), a byte-swapped payload word (Motorola), or a word joined from two payload words.
        """
        rows: dict[tuple[str, int], int] = {}
        self._little: list[int] = []  # Intel words
        self._big: list[int] = []  # Motorola words, byte-swapped
        #: Fields that span two payload words, as (is big endian, index of the first word, start bit in the first word).
        self._joined: list[tuple[bool, int, int]] = []
        sources: list[tuple[str, int]] = []
        left: list[int] = []
        for number, field in enumerate(self.fields):
            word, bit = divmod(field.first_bit, _WORD)
            if bit + field.length > _WORD:
                self._joined.append((field.big_endian, word, bit))
                sources.append(("joined", number))
                left.append(0 if field.big_endian else _WORD - field.length)
            elif field.big_endian:
                sources.append(("big", word))
                left.append(bit)
            else:
                sources.append(("little", word))
                left.append(_WORD - bit - field.length)
        for kind, words in (("little", self._little), ("big", self._big)):
            words.extend(sorted({word for source, word in sources if source == kind}))
        order = [("little", w) for w in self._little] + [("big", w) for w in self._big]
        order += [source for source in sources if source[0] == "joined"]
        rows.update((source, row) for row, source in enumerate(order))
        self._sources = np.array([rows[source] for source in sources], np.intp)
        self._left = np.array(left, np.uint64)[:, None]
        right = [_WORD - f.length for f in self.fields]
        self._right_signed = np.array(right[: self._signed], np.int64)[:, None]
        self._right_unsigned = np.array(right[self._signed :], np.uint64)[:, None]

    def extract(self, words: Words) -> Words:
        """Return the raw code of every field in every frame, as a 64-bit word. Shape (fields, n).

        Signed codes are sign-extended. A float field keeps its bit pattern.

        Args:
            words: result of `payload_words`, shape (words, n).
        """
        stack = np.empty((len(self._little) + len(self._big) + len(self._joined), words.shape[1]), np.uint64)
        row = len(self._little)
        stack[:row] = words[self._little]
        if self._big:
            stack[row : row + len(self._big)] = words[self._big].byteswap()
            row += len(self._big)
        for big_endian, word, bit in self._joined:
            first, second = words[word], words[word + 1]
            if big_endian:
                stack[row] = (first.byteswap() << np.uint64(bit)) | (second.byteswap() >> np.uint64(_WORD - bit))
            else:
                stack[row] = (first >> np.uint64(bit)) | (second << np.uint64(_WORD - bit))
            row += 1
        raw: Words = stack.take(self._sources, axis=0)
        np.left_shift(raw, self._left, out=raw)
        signed = raw[: self._signed].view(np.int64)
        np.right_shift(signed, self._right_signed, out=signed)
        np.right_shift(raw[self._signed :], self._right_unsigned, out=raw[self._signed :])
        return raw

    def values(self, raw: Words, index: int) -> Values:
        """Return the physical values of one field, in DBC units; integers are exact. Shape (n,).

        Args:
            raw: result of `extract`, shape (fields, n).
            index: index of the field in `fields`.
        """
        field, codes = self.fields[index], raw[index]
        if field.kind == "float":
            unsigned, floating = _FLOATS[field.length]
            with np.errstate(invalid="ignore", over="ignore"):  # no numpy warning about a NaN or an overflow
                real = codes.astype(unsigned).view(floating).astype(np.float64)
                return np.asarray(real * field.factor + field.offset)
        integers = codes.view(np.int64) if field.kind == "signed" or field.length < _WORD else codes
        if not (float(field.factor).is_integer() and float(field.offset).is_integer()):
            return np.asarray(integers.astype(np.float64) * float(field.factor) + float(field.offset))
        exact = _integer_type(field)
        column: Values = integers.astype(exact)
        if field.factor != 1:
            column = column * exact(int(field.factor))
        return column if field.offset == 0 else np.asarray(column + exact(int(field.offset)))

    def present(self, raw: Words, index: int) -> Mask | None:
        """Return the mask of the frames that contain the field, shape (n,), or None if all frames contain the field.

        Args:
            raw: result of `extract`, shape (fields, n).
            index: index of the field in `fields`.
        """
        mask: Mask | None = None
        for multiplexer, allowed in self.fields[index].selectors:
            selected = np.isin(raw[self._index[multiplexer]].view(np.int64), [as_int64(code) for code in allowed])
            mask = selected if mask is None else mask & selected
        return mask

    def undefined(self, raw: Words, multiplexer: str) -> Mask:
        """Return the mask of the frames in which a multiplexer has a value that the DBC does not define. Shape (n,).

        Args:
            raw: result of `extract`, shape (fields, n).
            multiplexer: name of the multiplexer signal.
        """
        index = self._index[multiplexer]
        defined = [as_int64(code) for code in self.layout.multiplexers[multiplexer]]
        unknown = ~np.isin(raw[index].view(np.int64), defined)
        present = self.present(raw, index)
        return unknown if present is None else unknown & present

    def decode(self, frames: Frames) -> dict[str, Column]:
        """Decode every signal of the given frames, in DBC order.

        Args:
            frames: `FRAME` records, shape (n,), each at least as long as the message.

        Raises:
            ValueError: If a frame is shorter than the message.
        """
        length = self.layout.length
        if len(frames) and int(frames["len"].min()) < length:
            raise ValueError(
                f"frames of {self.layout.name} must have at least {length} bytes, got {int(frames['len'].min())}"
            )
        raw = self.extract(payload_words(frames, length))
        indices = [self._index[field.name] for field in self.layout.fields]
        return {self.fields[p].name: Column(self.values(raw, p), self.present(raw, p)) for p in indices}


def raw_range(field: Field) -> range:
    """Return the range of raw codes of an integer field."""
    if field.kind == "signed":
        return range(-(1 << field.length - 1), 1 << field.length - 1)
    return range(1 << field.length)


def as_int64(code: int) -> int:
    """Return the int64 with the same 64 bits as a raw code. Raw codes of at least 2**63 become negative."""
    return code - (1 << 64) if code >= 1 << 63 else code


def named_codes(field: Field) -> dict[int, str]:
    """Return the value table of an integer field as a dictionary from `as_int64(raw code)` to the name.

    Raw codes that the field cannot have are omitted.
    """
    codes = raw_range(field)
    return {as_int64(code): text for code, text in field.choices.items() if code in codes}


def _integer_type(field: Field) -> Any:
    """Return an integer type that can represent all raw and physical values of a field.

    Factor and offset of the field must be integers. The type is int64, uint64, or `object` for Python integers.
    """
    factor, offset = int(field.factor), int(field.offset)
    codes = raw_range(field)
    reached = [x for code in (codes[0], codes[-1]) for x in (code, code * factor, code * factor + offset)]
    reached += [factor, offset]
    if all(x in _INT64 for x in reached):
        return np.int64
    return np.uint64 if all(x in _UINT64 for x in reached) else np.object_


# -- CRC of E2E Profile 5 ------------------------------------------------------------------------------------------------


@cache
def _byte_table(followed_by: int) -> npt.NDArray[np.uint16]:
    """Return the contribution of one payload byte to the CRC, for each value of this byte. Shape (256,).

    The contribution is the CRC of this byte followed by `followed_by` zero bytes, computed with start value 0.

    Args:
        followed_by: number of bytes that follow in the CRC calculation, in the payload and in the Data ID.
    """
    zeros = bytes(followed_by)
    return np.array([crc_hqx(bytes([byte]) + zeros, 0) for byte in range(256)], np.uint16)


@cache
def _pair_table(followed_by: int) -> npt.NDArray[np.uint16]:
    """Return the contribution of each pair of adjacent payload bytes to the CRC. Shape (65536,).

    The index into the result is the pair as a little-endian number.

    Args:
        followed_by: number of bytes that follow the two bytes in the CRC calculation, in the payload and in the Data ID.
    """
    return np.bitwise_xor.outer(_byte_table(followed_by), _byte_table(followed_by + 1)).reshape(-1)


def crc_of_zeros(length: int, data_id: int) -> int:
    """Return the CRC of a payload of zeros.

    The CRC of any other payload is this CRC, XORed with the contributions of all payload bytes.

    Args:
        length: payload length with the CRC, bytes.
        data_id: Data ID of the message (E2E Profile 5).
    """
    return crc(bytes(length - CRC_BYTES), data_id_bytes(data_id))


def crc_differences(frames: Frames, length: int) -> npt.NDArray[np.uint16]:
    """Return the check value of each frame, shape (n,). It equals `crc_of_zeros` if the CRC of the frame is right.

    The check value is the received CRC, XORed with the contributions of all payload bytes to the CRC. The CRC is affine over
    GF(2), so a frame is intact if and only if the check value is `crc_of_zeros(length, data_id)`, with the Data ID of the
    message. A lookup table of 65536 entries gives the contribution of each pair of bytes.

    Args:
        frames: `FRAME` records, shape (n,), whose payloads begin with the CRC, low byte first.
        length: payload length with the CRC, bytes.
    """
    data_id_length = len(data_id_bytes(0))
    payload = frames.view(np.uint16).reshape(-1, FRAME_BYTES // 2)[:, 4:]
    found: npt.NDArray[np.uint16] = payload[:, 0].copy()
    for pair in range(1, length // 2):
        found ^= _pair_table(length - 2 * pair - 2 + data_id_length).take(payload[:, pair])
    if length % 2:
        last = frames.view(np.uint8).reshape(-1, FRAME_BYTES)[:, 8 + length - 1]
        found ^= _byte_table(data_id_length).take(last)
    return found
