"""Writer of decoded signals as Parquet: one row per value, with the same seven columns for every DBC.

| column | content |
|---|---|
| time | time stamp of the frame, ns |
| channel, message, signal | names |
| value | physical value, float64 |
| integer | exact integer if float64 cannot hold every value of the signal, otherwise null |
| text | name of the value in the value table, null if the value has no name |

The rows of one signal are contiguous. Therefore `pandas.read_parquet(file, filters=[("signal", "==", "Position")])` reads only
a small part of the file.
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
from atalante_tools.canlog.column_codec import Column, named_codes, raw_range
from atalante_tools.canlog.decode.signals import DecodedFrames
from atalante_tools.canlog.plan import Plan

_EXACT = 1 << 53  # largest magnitude up to which float64 represents all integers exactly
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
    """Parquet file with one row group per chunk of the log."""

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

    def write(self, decoded: DecodedFrames, channels: Sequence[str]) -> None:
        """Add the signal values of the decoded frames of one message.

        Args:
            decoded: decoded frames of one message.
            channels: names of the channels of the log.
        """
        self._channels = channels
        for index, field in enumerate(decoded.codec.fields):
            column, stamps, channel_of_row = decoded.column(index), decoded.stamps, decoded.channels
            texts = self._texts_of(field, decoded.raw[index].view(np.int64))
            if column.present is not None:
                present = column.present
                column, stamps, channel_of_row = (
                    Column(column.values[present], None),
                    stamps[present],
                    channel_of_row[present],
                )
                texts = None if texts is None else texts[present]
            count = len(stamps)
            if not count:
                continue
            if texts is None:
                texts = np.full(count, -1, np.int32)
            message = np.full(count, decoded.row, np.int32)
            signal = np.full(count, self._signal_number[field.name], np.int32)
            values = column.values.astype(np.float64)
            self._rows.append((stamps, channel_of_row.astype(np.int32), message, signal, values, texts))
            self._integers.append(_exact(field, column.values))
            self.values += count

    def flush(self) -> None:
        """Write the values added since the last flush as one row group."""
        if not self._rows:
            return
        times, channel_of_row, messages, signals, values, texts = (
            np.concatenate(column) for column in zip(*self._rows, strict=True)
        )
        channels = pa.array(list(self._channels), pa.string())
        columns = [
            pa.array(times, pa.timestamp("ns")),
            pa.DictionaryArray.from_arrays(channel_of_row, channels),
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
        """Return the index in `_texts` of the name of each raw code; -1 if the raw code has no name.

        Returns:
            The indices, shape (n,); None if no raw code of the field has a name.
        """
        names = named_codes(field)
        if not names:
            return None
        known = np.array(sorted(names), np.int64)
        numbers = np.array([self._text_number[names[code]] for code in known.tolist()], np.int32)
        at = np.minimum(np.searchsorted(known, codes), len(known) - 1)
        return np.where(known[at] == codes, numbers[at], np.int32(-1))

    def close(self) -> None:
        """Write the file footer and close the file."""
        self._writer.close()


def _exact(field: Field, values: npt.NDArray[Any]) -> Any:
    """Return the values of a signal for the column `integer`: decimals if float64 may round an integer value, otherwise nulls.

    float64 represents all integers only up to 2**53. An integer signal of more than 53 bits may have larger values. For such a
    signal, the column `integer` has the exact values, and the column `value` has the rounded values. A signal that can have
    integers of more than 38 digits has only rounded values, because the column cannot store them.
    """
    codes = raw_range(field) if field.kind != "float" else range(0)
    largest = (
        max((abs(code * field.factor + field.offset) for code in (codes[0], codes[-1])), default=0) if codes else 0
    )
    if values.dtype.kind == "f" or not _EXACT < largest < 10**_DECIMAL.precision:
        return pa.nulls(len(values), _DECIMAL)
    if values.dtype.kind == "O":
        return pa.array(values.tolist(), _DECIMAL)
    # Arrow stores a decimal as 16 bytes in two's complement, low word first.
    words = np.zeros((len(values), 2), np.int64)
    words[:, 0] = values.view(np.int64)
    if values.dtype.kind == "i":
        words[:, 1] = values >> 63
    return pa.Array.from_buffers(_DECIMAL, len(values), [None, pa.py_buffer(words.tobytes())])


def _units(plan: Plan) -> dict[str, str]:
    return {f"unit:{m.name}.{f.name}": f.unit for m in plan.layouts for f in m.fields if f.unit not in ("", "1")}
