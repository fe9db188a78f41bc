"""Plan: properties of the DBC messages as arrays, and a lookup table from CAN identifiers to message indices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_dbc.foreign import Catalogue, Layout, Refused
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_EXTENDED, ID_MASK, header_word
from atalante_tools.canlog.column_codec import ColumnCodec, crc_of_zeros

#: Message index for an identifier that is not in the DBC.
UNKNOWN = -1
_STANDARD = 1 << 11

Rows = npt.NDArray[np.int16]


@dataclass(frozen=True)
class Family:
    """Family of messages: all messages with the same signal layout, which are decoded together."""

    rows: range
    codec: ColumnCodec

    @property
    def length(self) -> int:
        """Return the payload length of the messages [bytes]."""
        return self.codec.layout.length


class Plan:
    """Arrays of message properties. The index of a message is the same in all arrays; the code calls this index `row`.

    The messages are ordered by length, then by layout, so the indices of messages with equal fields (a family) are
    contiguous. Messages with an unsupported layout come last. Frames of these messages are counted but not decoded.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self.catalogue = catalogue
        keys = [_shape(layout) for layout in catalogue.layouts]
        first = {key: index for index, key in reversed(list(enumerate(keys)))}
        order = sorted(range(len(keys)), key=lambda index: (catalogue.layouts[index].length, first[keys[index]], index))
        self.layouts: tuple[Layout, ...] = tuple(catalogue.layouts[index] for index in order)
        self.refused: tuple[Refused, ...] = catalogue.refused
        self.row_of = {layout.name: row for row, layout in enumerate(self.layouts)}
        self.families = _families(self.layouts, [keys[index] for index in order])
        self._index_identifiers()
        count = len(self.layouts)
        headers = [header_word(_can_id(m), m.length, _flags(m)) for m in self.layouts]
        #: Identifier, length and flags that the frames of each message must have, as one number (`header_word`).
        #: The element of a message with an unsupported layout is 0. The last element, with the index `UNKNOWN` (-1), is also 0.
        self.headers = np.array([*headers, *([0] * len(self.refused)), 0], np.uint64)
        self.lengths = np.array([m.length for m in self.layouts], np.int64)
        self.cycle_ns = np.array([1e6 * (m.cycle_ms or 0.0) if m.cyclic else 0.0 for m in self.layouts])
        self.timeout_ns = np.array([1e6 * (m.timeout_ms or 0.0) for m in self.layouts])
        self.inhibit_ns = np.array([0.0 if m.cyclic else 1e6 * (m.inhibit_ms or 0.0) for m in self.layouts])
        self.protected = np.array([m.data_id is not None for m in self.layouts], np.bool_)
        self.crc_constants = np.array(
            [0 if m.data_id is None else crc_of_zeros(m.length, m.data_id) for m in self.layouts], np.uint16
        )
        self.buses: tuple[str, ...] = tuple(catalogue.buses) or ("",)
        numbers = {name: number for number, name in enumerate(self.buses)}
        self.bus_of_row = np.array([numbers.get(m.bus or "", 0) for m in self.layouts], np.int64)
        senders = sorted({m.sender for m in self.layouts if m.sender})
        self.senders: tuple[str, ...] = tuple(senders)
        self.sender_of_row = np.array(
            [senders.index(m.sender) if m.sender else UNKNOWN for m in self.layouts], np.int64
        )
        assert len(self.row_of) == count

    @property
    def has_buses(self) -> bool:
        """Return whether the DBC assigns messages to buses."""
        return bool(self.catalogue.buses)

    def name(self, row: int) -> str:
        """Return the name of the message with the index `row`."""
        count = len(self.layouts)
        return self.layouts[row].name if row < count else self.refused[row - count].name

    def sender(self, row: int) -> str:
        """Return the name of the node that sends the message with the index `row`.

        The name is empty if the DBC names no sender, or if the layout of the message is not supported.
        """
        return self.layouts[row].sender or "" if row < len(self.layouts) else ""

    # -- identifiers -------------------------------------------------------------------------------------------------

    def _index_identifiers(self) -> None:
        standard = np.full(_STANDARD, UNKNOWN, np.int16)
        extended: dict[int, int] = {}
        groups: dict[int, dict[int, int]] = {}
        items = [(m.frame_id, m.extended, m.pgn_mask) for m in self.layouts]
        items += [(m.frame_id, m.extended, ID_MASK) for m in self.refused]
        for row, (frame_id, is_extended, mask) in enumerate(items):
            if not is_extended:
                standard[frame_id] = row
                continue
            extended[frame_id] = row
            if mask != ID_MASK:
                # Two messages of one J1939 parameter group have the same masked identifier.
                # A masked identifier that several messages share is ambiguous, so it is treated as unknown.
                known = groups.setdefault(mask, {})
                known[frame_id & mask] = UNKNOWN if frame_id & mask in known else row
        self._standard = standard
        self._extended = _Table(extended)
        self._groups = [(np.uint32(mask), _Table(rows)) for mask, rows in groups.items()]

    def rows(self, can_ids: npt.NDArray[np.uint32]) -> Rows:
        """Return the message index of each identifier; `UNKNOWN` if the identifier is not in the DBC. Shape (n,).

        Args:
            can_ids: identifiers with SocketCAN flags, shape (n,).
        """
        if int(can_ids.max(initial=0)) < _STANDARD:
            return self._standard[can_ids]
        is_standard = can_ids < _STANDARD
        rows = self._standard[np.where(is_standard, can_ids, 0)]
        rows[~is_standard] = UNKNOWN
        indices = np.flatnonzero((can_ids & np.uint32(0xE0000000)) == ID_EXTENDED)
        rows[indices] = self._rows_extended(can_ids[indices] & np.uint32(ID_MASK))
        return rows

    def _rows_extended(self, numbers: npt.NDArray[np.uint32]) -> Rows:
        rows = self._extended.find(numbers)
        for mask, table in self._groups:
            left = np.flatnonzero(rows == UNKNOWN)
            if not len(left):
                break
            rows[left] = table.find(numbers[left] & mask)
        return rows

    def rows_in_other_format(self, can_ids: npt.NDArray[np.uint32]) -> Rows:
        """Look up each 11-bit identifier as a 29-bit identifier, and vice versa, and return the message indices. Shape (n,).

        Example: the 11-bit identifier 0x123 gives the message with the 29-bit identifier 0x00000123.
        The index is `UNKNOWN` if the DBC has no such message.

        Args:
            can_ids: identifiers with SocketCAN flags, shape (n,).
        """
        numbers = can_ids & np.uint32(ID_MASK)
        short = self._standard[np.where(numbers < _STANDARD, numbers, 0)]
        short[numbers >= _STANDARD] = UNKNOWN
        is_extended = (can_ids & np.uint32(ID_EXTENDED)) != 0
        return np.where(is_extended, short, self._extended.find(numbers))


class _Table:
    """Lookup table from identifiers to message indices, searched by bisection."""

    def __init__(self, rows: dict[int, int]) -> None:
        self._numbers = np.array(sorted(rows), np.uint32)
        self._rows = np.array([rows[number] for number in sorted(rows)], np.int16)

    def find(self, numbers: npt.NDArray[np.uint32]) -> Rows:
        if not len(self._numbers):
            return np.full(len(numbers), UNKNOWN, np.int16)
        at = np.minimum(np.searchsorted(self._numbers, numbers), len(self._numbers) - 1)
        return np.where(self._numbers[at] == numbers, self._rows[at], np.int16(UNKNOWN))


def _can_id(layout: Layout) -> int:
    return layout.frame_id | (ID_EXTENDED if layout.extended else 0)


def _flags(layout: Layout) -> int:
    if not layout.fd:
        return 0
    return FLAG_FDF | (FLAG_BRS if layout.bit_rate_switch else 0)


def _shape(layout: Layout) -> tuple[object, ...]:
    """Return the properties that are equal for all messages of one family."""
    fields = tuple(
        (
            *(f.name, f.start, f.length, f.big_endian, f.kind, f.factor, f.offset, f.minimum, f.maximum, f.invalid_raw),
            tuple(sorted(f.choices.items())),
            tuple((multiplexer, tuple(sorted(ids))) for multiplexer, ids in f.selectors),
        )
        for f in layout.fields
    )
    return (layout.length, fields, tuple(sorted((m, tuple(sorted(v))) for m, v in layout.multiplexers.items())))


def _families(layouts: Sequence[Layout], keys: Sequence[tuple[object, ...]]) -> tuple[Family, ...]:
    families: list[Family] = []
    begin = 0
    for row in range(1, len(layouts) + 1):
        if row == len(layouts) or keys[row] != keys[begin]:
            families.append(Family(range(begin, row), ColumnCodec(layouts[begin])))
            begin = row
    return tuple(families)
