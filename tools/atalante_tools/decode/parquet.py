"""Decoded signals as Parquet: one row a value, so that any DBC gives the same seven columns.

| column | what |
|---|---|
| time | of the frame, ns |
| channel, message, signal | names |
| value | physical, float64 |
| integer | the exact integer where float64 cannot hold every value of the signal, otherwise null |
| text | its name in the value table, null where there is none |

Rows of one signal lie together: `pandas.read_parquet(file, filters=[("signal", "==", "Position")])` reads little else.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from atalante_dbc.foreign import Field
from atalante_hal.bulk import Column, raw_range
from atalante_tools.decode.signals import Piece
from atalante_tools.validate.plan import Plan

_EXACT = 1 << 53  # integers up to here are exact in float64
_DECIMAL = pa.decimal128(38, 0)
_NAMES = pa.dictionary(pa.int32(), pa.string())
_SCHEMA = pa.schema(
    [
        ("time", pa.timestamp("ns")),
        ("channel", _NAMES),
        ("message", _NAMES),
        ("signal", _NAMES),
        ("value", pa.float64()),
        ("integer", _DECIMAL),
        ("text", _NAMES),
    ]
)


class ParquetSink:
    """Writes one row group a chunk."""

    def __init__(self, path: Path, plan: Plan) -> None:
        self._plan = plan
        self.values = 0
        self._messages = pa.array([layout.name for layout in plan.layouts], pa.string())
        signals = sorted({f.name for layout in plan.layouts for f in layout.fields})
        texts = sorted({text for layout in plan.layouts for f in layout.fields for text in f.choices.values()})
        self._signal_number = {name: number for number, name in enumerate(signals)}
        self._text_number = {text: number for number, text in enumerate(texts)}
        self._signals, self._texts = pa.array(signals, pa.string()), pa.array(texts, pa.string())
        self._rows: list[tuple[npt.NDArray[Any], ...]] = []
        self._integers: list[Any] = []
        self._channels: Sequence[str] = ()
        metadata = {"dbc": plan.catalogue.path.name, "dbc_crc32": f"{plan.catalogue.hash32:08X}", **_units(plan)}
        self._writer = pq.ParquetWriter(
            path,
            _SCHEMA.with_metadata(metadata),
            compression="zstd",
            use_dictionary=["channel", "message", "signal", "text"],
            column_encoding={"time": "DELTA_BINARY_PACKED", "value": "BYTE_STREAM_SPLIT"},
        )

    def write(self, piece: Piece, channels: Sequence[str]) -> None:
        """Add the values of a piece."""
        self._channels = channels
        for place, field in enumerate(piece.codec.fields):
            column, stamps, on = piece.column(place), piece.stamps, piece.channels
            texts = self._texts_of(field, piece.raw[place].view(np.int64))
            if column.present is not None:
                there = column.present
                column, stamps, on = Column(column.values[there], None), stamps[there], on[there]
                texts = None if texts is None else texts[there]
            count = len(stamps)
            if not count:
                continue
            if texts is None:
                texts = np.full(count, -1, np.int32)
            message = np.full(count, piece.row, np.int32)
            signal = np.full(count, self._signal_number[field.name], np.int32)
            values = column.values.astype(np.float64)
            self._rows.append((stamps, on.astype(np.int32), message, signal, values, texts))
            self._integers.append(_exact(field, column.values))
            self.values += count

    def flush(self) -> None:
        """Write what was gathered as a row group."""
        if not self._rows:
            return
        times, on, messages, signals, values, texts = (
            np.concatenate(column) for column in zip(*self._rows, strict=True)
        )
        channels = pa.array(list(self._channels), pa.string())
        columns = [
            pa.array(times, pa.timestamp("ns")),
            pa.DictionaryArray.from_arrays(on, channels),
            pa.DictionaryArray.from_arrays(messages, self._messages),
            pa.DictionaryArray.from_arrays(signals, self._signals),
            pa.array(values),
            pa.chunked_array(self._integers, _DECIMAL).combine_chunks(),
            pa.DictionaryArray.from_arrays(pa.array(texts, mask=texts < 0), self._texts),
        ]
        self._writer.write_table(pa.Table.from_arrays(columns, schema=self._writer.schema), row_group_size=len(times))
        self._rows.clear()
        self._integers.clear()

    def _texts_of(self, field: Field, codes: npt.NDArray[np.int64]) -> npt.NDArray[np.int32] | None:
        """Number of each code's name in the value table, -1 where it has none."""
        if not field.choices:
            return None
        known = np.array(sorted(field.choices), np.int64)
        numbers = np.array([self._text_number[field.choices[code]] for code in known.tolist()], np.int32)
        at = np.minimum(np.searchsorted(known, codes), len(known) - 1)
        return np.where(known[at] == codes, numbers[at], np.int32(-1))

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


def _exact(field: Field, values: npt.NDArray[Any]) -> Any:
    """The integers of a field that float64 cannot hold, as decimals; nulls for any other field."""
    codes = raw_range(field) if field.kind != "float" else range(0)
    if values.dtype.kind == "f" or not codes or max(-codes[0], codes[-1]) * abs(field.factor) <= _EXACT:
        return pa.nulls(len(values), _DECIMAL)
    if values.dtype.kind == "O":
        return pa.array(values.tolist(), _DECIMAL)
    # A decimal is 16 bytes, two's complement, low word first.
    words = np.zeros((len(values), 2), np.int64)
    words[:, 0] = values.view(np.int64)
    if values.dtype.kind == "i":
        words[:, 1] = values >> 63
    return pa.Array.from_buffers(_DECIMAL, len(values), [None, pa.py_buffer(words.tobytes())])


def _units(plan: Plan) -> dict[str, str]:
    return {f"unit:{m.name}.{f.name}": f.unit for m in plan.layouts for f in m.fields if f.unit not in ("", "1")}
