"""Array codec for a whole log: every signal of a message, over any number of its frames at once, of any DBC.

The codec of the loop (`codec.Codec`) decodes many messages of one cycle and leans on our rule that no signal crosses a 64-bit
word. Here it is one layout and many rows, and nothing is asked of the layout: Intel and Motorola, straddling, 64-bit, IEEE
floats and multiplexed signals come out exactly as cantools decodes them. The E2E check of a column is here as well.
"""

from __future__ import annotations

from binascii import crc_hqx
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_dbc.foreign import Field, Layout
from atalante_hal.e2e import CRC_BYTES, crc, data_id_bytes
from atalante_hal.frame import FRAME_BYTES, Frames, as_words

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
    """One signal over many frames.

    `values` is shape (n,): int64 or uint64 where the DBC's factor and offset are integers (Python integers where neither is
    wide enough), float64 otherwise. `present` is None, or shape (n,) and False where the multiplexer puts another signal into
    the frame; the value there means nothing.
    """

    values: Values
    present: Mask | None


def payload_words(frames: Frames, length: int) -> Words:
    """Payloads of records of `length` bytes as little-endian words, one word of all frames after the other. Shape (words, n)."""
    count = (length + 7) // 8
    return np.ascontiguousarray(as_words(frames)[:, 1 : 1 + count].T)


class BulkCodec:
    """Compiled plan of one layout. `fields` is its own order: signed, unsigned, float; `place` tells where a signal is."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        kinds = ("signed", "unsigned", "float")
        self.fields: tuple[Field, ...] = tuple(sorted(layout.fields, key=lambda f: kinds.index(f.kind)))
        self._place = {field.name: place for place, field in enumerate(self.fields)}
        self._signed = sum(f.kind == "signed" for f in self.fields)
        self._plan()

    def place(self, name: str) -> int:
        """Row of a signal in what `extract` returns.

        Raises:
            KeyError: with the names there are.
        """
        try:
            return self._place[name]
        except KeyError:
            raise KeyError(f"no signal {name!r} in {self.layout.name}: {', '.join(self._place)}") from None

    def _plan(self) -> None:
        """Where each field is taken from: an Intel word, a Motorola word, or one put together from two."""
        rows: dict[tuple[str, int], int] = {}
        self._little: list[int] = []  # words used as they are
        self._big: list[int] = []  # words used byte-swapped
        self._joined: list[tuple[bool, int, int]] = []  # (Motorola, first word, shift) of straddling fields
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
        """Raw codes: signed ones as two's complement of 64 bits, floats as their bits. Shape (fields, n).

        Args:
            words: of `payload_words`.
        """
        stack = np.empty((len(self._little) + len(self._big) + len(self._joined), words.shape[1]), np.uint64)
        place = len(self._little)
        stack[:place] = words[self._little]
        if self._big:
            stack[place : place + len(self._big)] = words[self._big].byteswap()
            place += len(self._big)
        for big_endian, word, bit in self._joined:
            first, second = words[word], words[word + 1]
            if big_endian:
                stack[place] = (first.byteswap() << np.uint64(bit)) | (second.byteswap() >> np.uint64(_WORD - bit))
            else:
                stack[place] = (first >> np.uint64(bit)) | (second << np.uint64(_WORD - bit))
            place += 1
        raw: Words = stack.take(self._sources, axis=0)
        np.left_shift(raw, self._left, out=raw)
        signed = raw[: self._signed].view(np.int64)
        np.right_shift(signed, self._right_signed, out=signed)
        np.right_shift(raw[self._signed :], self._right_unsigned, out=raw[self._signed :])
        return raw

    def values(self, raw: Words, place: int) -> Values:
        """Physical values of one field, integers exact. Shape (n,), DBC units."""
        field, codes = self.fields[place], raw[place]
        if field.kind == "float":
            unsigned, floating = _FLOATS[field.length]
            with np.errstate(invalid="ignore", over="ignore"):  # a payload may well hold a signalling NaN
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

    def present(self, raw: Words, place: int) -> Mask | None:
        """Frames that carry the field; None: all of them. Shape (n,)."""
        mask: Mask | None = None
        for multiplexer, allowed in self.fields[place].selectors:
            there = np.isin(raw[self._place[multiplexer]].view(np.int64), list(allowed))
            mask = there if mask is None else mask & there
        return mask

    def undefined(self, raw: Words, multiplexer: str) -> Mask:
        """Frames whose multiplexer has a value for which the DBC gives no layout. Shape (n,)."""
        place = self._place[multiplexer]
        unknown = ~np.isin(raw[place].view(np.int64), list(self.layout.multiplexers[multiplexer]))
        there = self.present(raw, place)
        return unknown if there is None else unknown & there

    def decode(self, frames: Frames) -> dict[str, Column]:
        """Every signal of frames of this message, in DBC order.

        Args:
            frames: `FRAME` records, shape (n,), each at least as long as the message.

        Raises:
            ValueError: a frame is shorter than the message.
        """
        length = self.layout.length
        if len(frames) and int(frames["len"].min()) < length:
            raise ValueError(f"{self.layout.name} has {length} bytes; a frame has {int(frames['len'].min())}")
        raw = self.extract(payload_words(frames, length))
        places = [self._place[field.name] for field in self.layout.fields]
        return {self.fields[p].name: Column(self.values(raw, p), self.present(raw, p)) for p in places}


def raw_range(field: Field) -> range:
    """Raw codes an integer field can hold."""
    if field.kind == "signed":
        return range(-(1 << field.length - 1), 1 << field.length - 1)
    return range(1 << field.length)


def _integer_type(field: Field) -> Any:
    """Type that holds every raw and physical value of a field with integer factor and offset: int64, uint64 or Python's own."""
    factor, offset = int(field.factor), int(field.offset)
    codes = raw_range(field)
    reached = [x for code in (codes[0], codes[-1]) for x in (code, code * factor, code * factor + offset)]
    reached += [factor, offset]
    if all(x in _INT64 for x in reached):
        return np.int64
    return np.uint64 if all(x in _UINT64 for x in reached) else np.object_


# -- E2E Profile 5 of a column ---------------------------------------------------------------------------------------------


@cache
def _byte_table(followed_by: int) -> npt.NDArray[np.uint16]:
    """What a byte adds to the CRC (over GF(2), start 0) with that many bytes behind it. Shape (256,)."""
    zeros = bytes(followed_by)
    return np.array([crc_hqx(bytes([byte]) + zeros, 0) for byte in range(256)], np.uint16)


@cache
def _pair_table(followed_by: int) -> npt.NDArray[np.uint16]:
    """The same for two bytes read as one little-endian number. Shape (65536,)."""
    return np.bitwise_xor.outer(_byte_table(followed_by), _byte_table(followed_by + 1)).reshape(-1)


def crc_of_zeros(length: int, data_id: int) -> int:
    """CRC of an empty payload of `length` bytes under a Data ID: the constant of the affine map."""
    return crc(bytes(length - CRC_BYTES), data_id_bytes(data_id))


def crc_differences(frames: Frames, length: int) -> npt.NDArray[np.uint16]:
    """Received CRC xor what the payload contributes to it. Shape (n,).

    The CRC is affine over GF(2): a frame is intact exactly when this is `crc_of_zeros(length, data_id)`. Payloads go through
    the map two bytes at a time, one gather in a table of 65536 a pair.

    Args:
        frames: records whose payloads have `length` bytes and begin with the CRC, low byte first.
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
