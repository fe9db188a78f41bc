"""Layout of a record: the name and the slice of each field of a contiguous float64 vector."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator

#: Prefix of the controller's field names in a record.
CONTROLLER = "controller."


class Layout:
    """Names and slices of the fields of a record, in order.

    Args:
        fields: Name and length of each field, in order.

    Raises:
        ValueError: If a name is repeated or a length is not positive.
    """

    def __init__(self, fields: Iterable[tuple[str, int]]) -> None:
        self.fields = tuple((str(name), int(length)) for name, length in fields)
        self._slices: dict[str, slice] = {}
        offset = 0
        for name, length in self.fields:
            if name in self._slices:
                raise ValueError(f"field {name!r} must be defined once, got it twice: give each field a unique name")
            if length <= 0:
                raise ValueError(f"field {name!r} must have a length of at least 1, got {length}")
            self._slices[name] = slice(offset, offset + length)
            offset += length
        #: Length of the whole vector.
        self.size = offset

    def __getitem__(self, name: str) -> slice:
        try:
            return self._slices[name]
        except KeyError:
            raise KeyError(f"field must be one of {', '.join(self._slices)}, got {name!r}") from None

    def __contains__(self, name: object) -> bool:
        return name in self._slices

    def __iter__(self) -> Iterator[str]:
        return iter(self._slices)

    def to_json(self) -> str:
        """Return the fields as a JSON list of [name, length]."""
        return json.dumps(self.fields)

    @classmethod
    def from_json(cls, text: str) -> Layout:
        """Create a layout from the text that `to_json` returned.

        Args:
            text: JSON list of [name, length].

        Returns:
            The layout.
        """
        return cls((name, length) for name, length in json.loads(text))


#: Number of bits in the field "diagnostics". A value of the record (float64) represents integers of up to 53 bits exactly.
LOW_BITS = 48


def split_bits(bits: int) -> tuple[int, int]:
    """Split a bit set of diagnostics into the values of the fields "diagnostics" and "diagnostics_high".

    Args:
        bits: Bit set of codes, see `diagnostics.Dtc.bit`.
    """
    return bits & (1 << LOW_BITS) - 1, bits >> LOW_BITS


def joined_bits(low: float, high: float) -> int:
    """Return the bit set of diagnostics from the values of the fields "diagnostics" and "diagnostics_high"."""
    return int(low) | int(high) << LOW_BITS
