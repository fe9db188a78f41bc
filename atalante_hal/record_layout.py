"""Names of the places of one contiguous float64 vector: what a record holds, for whoever reads it later."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator

#: Controller fields carry this prefix in the record.
CONTROLLER = "controller."


class Layout:
    """Ordered fields of a vector, each a slice.

    Raises:
        ValueError: a name twice, or a length that is not positive.
    """

    def __init__(self, fields: Iterable[tuple[str, int]]) -> None:
        self.fields = tuple((str(name), int(length)) for name, length in fields)
        self._slices: dict[str, slice] = {}
        place = 0
        for name, length in self.fields:
            if name in self._slices or length <= 0:
                raise ValueError(f"field {name!r} needs a name of its own and a positive length, not {length}")
            self._slices[name] = slice(place, place + length)
            place += length
        #: Length of the whole vector.
        self.size = place

    def __getitem__(self, name: str) -> slice:
        try:
            return self._slices[name]
        except KeyError:
            raise KeyError(f"no field {name!r}; there are {', '.join(self._slices)}") from None

    def __contains__(self, name: object) -> bool:
        return name in self._slices

    def __iter__(self) -> Iterator[str]:
        return iter(self._slices)

    def to_json(self) -> str:
        """The fields as a JSON list of [name, length]."""
        return json.dumps(self.fields)

    @classmethod
    def from_json(cls, text: str) -> Layout:
        """The inverse of `to_json`."""
        return cls((name, length) for name, length in json.loads(text))
