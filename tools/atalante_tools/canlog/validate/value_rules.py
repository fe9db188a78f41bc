"""Rules for payloads: ranges, codes for "no value", value tables, reserved bits, multiplexers.

Messages with equal fields (a message family) are checked together. First, the smallest and the largest raw code of each
field are checked. If one of these codes is wrong, all values of the field are checked.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from atalante_dbc.foreign import Field, Layout
from atalante_tools.canlog.column_codec import ColumnCodec, Mask, Words, as_int64, named_codes, payload_words, raw_range
from atalante_tools.canlog.plan import Family, Plan
from atalante_tools.canlog.stream import Stream
from atalante_tools.canlog.validate.findings import Findings
from atalante_tools.canlog.validate.project import Project

#: float64 represents every integer from 0 to `_EXACT` exactly, but rounds some of the larger integers.
_EXACT: Final = 2**53
#: Largest field length [bit] for which the value table is stored as a lookup array over all raw codes.
#: For a longer field, the value table is stored as a list of the valid codes.
_TABLE_BITS = 16
_WORD = 64
_HASH_BITS = 32


@dataclass
class Decoded:
    """Raw codes of all fields in the frames of a message family, with masks of the invalid values."""

    family: Family
    span: slice  # slice of the stream that contains the frames
    raw: Words  # raw code of each field in each frame, shape (fields, n)
    bad: dict[int, Mask] = field(default_factory=dict)  # for each field index: mask of the frames with an invalid value

    @property
    def codes(self) -> npt.NDArray[np.int64]:
        """Return the raw codes as signed integers. Shape (fields, n)."""
        return self.raw.view(np.int64)


class ValueRules:
    """Rules for payloads, with the limits and tables of each message family."""

    def __init__(self, plan: Plan, findings: Findings, project: Project) -> None:
        self._findings = findings
        self._hash = plan.catalogue.hash32
        pattern = project.number("reserved-bits", "value")
        self.hash_signal = project.text("dbc-hash", "signal")
        self._checks = {
            family.rows.start: _FamilyChecks(family.codec, pattern, self.hash_signal) for family in plan.families
        }

    def check(self, family: Family, stream: Stream) -> Decoded | None:
        """Decode and check the frames of a message family; return None if the family has no field or no frame in the chunk."""
        span = stream.span(family.rows)
        if span.start == span.stop or not family.codec.fields:
            return None
        words = payload_words(stream.frames[span], family.length)
        decoded = Decoded(family, span, family.codec.extract(words))
        checks = self._checks[family.rows.start]
        self._check_multiplexers(decoded, stream)
        self._check_limits(checks, decoded, stream)
        self._check_tables(checks, decoded, stream)
        self._check_reserved(checks, words, decoded, stream)
        for index in checks.hashes:
            wrong = decoded.codes[index] != self._hash
            if bool(wrong.any()):
                hashes = np.array([f"{code:08X}" for code in decoded.codes[index].tolist()], object)
                self._report("dbc-hash", decoded, stream, wrong, index, shown=hashes, badness=np.zeros(len(hashes)))
        return decoded

    def _report(
        self,
        rule: str,
        decoded: Decoded,
        stream: Stream,
        wrong: Mask,
        index: int,
        *,
        shown: npt.NDArray[np.generic],
        badness: npt.NDArray[np.generic] | None = None,
        unit: str | None = None,
    ) -> None:
        self._findings.add_rows(
            rule,
            stream.rows[decoded.span][wrong],
            stream.stamps[decoded.span][wrong],
            signal=decoded.family.codec.fields[index].name,
            shown=shown[wrong],
            badness=None if badness is None else badness[wrong],
            unit=unit,
        )
        known = decoded.bad.get(index)
        decoded.bad[index] = wrong if known is None else known | wrong

    def _check_multiplexers(self, decoded: Decoded, stream: Stream) -> None:
        codec = decoded.family.codec
        for name in codec.layout.multiplexers:
            undefined = codec.undefined(decoded.raw, name)
            if bool(undefined.any()):
                index = codec.index(name)
                self._report("multiplexer", decoded, stream, undefined, index, shown=decoded.codes[index])

    def _check_limits(self, checks: _FamilyChecks, decoded: Decoded, stream: Stream) -> None:
        suspects = {index for index, code in checks.coded.items() if bool((decoded.codes[index] == code).any())}
        if len(checks.limited):
            codes = decoded.codes[checks.limited] if len(checks.limited) < len(decoded.raw) else decoded.codes
            outside = (codes.min(axis=1) < checks.low) | (codes.max(axis=1) > checks.high)
            suspects.update(checks.limited[outside].tolist())
        for index in sorted(suspects):
            self._check_limit(checks, decoded, stream, index)
        for index in checks.special:
            self._check_special(checks, decoded, stream, index)

    def _check_limit(self, checks: _FamilyChecks, decoded: Decoded, stream: Stream, index: int) -> None:
        """Report the frames in which the raw code of a signal is outside its range or means "no value"."""
        codec, codes = decoded.family.codec, decoded.codes[index]
        outside = np.zeros(len(codes), np.bool_)
        if index in checks.bounds:
            low, high = checks.bounds[index]
            outside = (codes < low) | (codes > high)
        self._check_outside(decoded, stream, index, outside, codec.values(decoded.raw, index).astype(np.float64))

    def _check_special(self, checks: _FamilyChecks, decoded: Decoded, stream: Stream, index: int) -> None:
        """Check the values of a float or 64-bit field.

        The signed raw codes of such a field are not ordered like the values, so they cannot be compared with the range. The
        physical values of a float field and the unsigned or signed raw codes of a 64-bit field are compared instead.
        """
        values = decoded.family.codec.values(decoded.raw, index).astype(np.float64)
        kind = decoded.family.codec.fields[index].kind
        low, high = checks.special[index]
        if kind == "float":
            outside = ~((values >= low) & (values <= high))
        else:
            codes = decoded.codes[index] if kind == "signed" else decoded.raw[index]
            outside = (codes < low) | (codes > high)
        self._check_outside(decoded, stream, index, outside, values)

    def _check_outside(
        self, decoded: Decoded, stream: Stream, index: int, outside: Mask, values: npt.NDArray[np.float64]
    ) -> None:
        """Report all values outside the range of a field, and all codes for "no value".

        The code for "no value" is reported under the rule invalid-code instead of the rule range, inside and outside the
        range. Any other value in the value table is valid, even outside the range.

        Args:
            decoded: decoded frames of a message family, in which this method marks the invalid values.
            stream: frames of the chunk, sorted by message.
            index: index of the field.
            outside: mask of the frames with a value outside the range, shape (n,).
            values: physical values of the field, shape (n,).
        """
        codec, codes = decoded.family.codec, decoded.codes[index]
        limits = codec.fields[index]
        present = codec.present(decoded.raw, index)
        invalid = np.zeros(len(codes), np.bool_)
        if limits.invalid_raw is not None:
            invalid = codes == _as_signed(limits, limits.invalid_raw)
        if present is not None:
            outside, invalid = outside & present, invalid & present
        if bool(invalid.any()):
            self._report("invalid-code", decoded, stream, invalid, index, shown=codes)
        wrong = outside & ~invalid
        if limits.choices and bool(wrong.any()):
            wrong &= ~np.isin(codes, list(named_codes(limits)))
        if bool(wrong.any()):
            low, high = limits.minimum or 0.0, limits.maximum or 0.0
            distance = np.maximum(low - values, values - high)
            distance = np.nan_to_num(distance, nan=np.inf)
            self._report("range", decoded, stream, wrong, index, shown=values, badness=distance, unit=limits.unit)

    def _check_tables(self, checks: _FamilyChecks, decoded: Decoded, stream: Stream) -> None:
        for index, table in checks.tables.items():
            codes = decoded.codes[index]
            limits = decoded.family.codec.fields[index]
            known = table.take(codes & len(table) - 1) if isinstance(table, np.ndarray) else np.isin(codes, table)
            if bool(known.all()):
                continue
            wrong = ~known
            if (present := decoded.family.codec.present(decoded.raw, index)) is not None:
                wrong &= present
            if (bad := decoded.bad.get(index)) is not None:
                wrong &= ~bad
            if limits.invalid_raw is not None:
                wrong &= codes != _as_signed(limits, limits.invalid_raw)
            if bool(wrong.any()):
                self._report("value-table", decoded, stream, wrong, index, shown=codes)

    def _check_reserved(self, checks: _FamilyChecks, words: Words, decoded: Decoded, stream: Stream) -> None:
        set_bits = np.zeros(0, np.uint64)
        for word, mask in checks.reserved.items():
            column = (words[word] ^ checks.pattern) & mask
            if bool(np.bitwise_or.reduce(column)):
                counted = np.bitwise_count(column).astype(np.uint64)
                set_bits = counted if not len(set_bits) else set_bits + counted
        if len(set_bits):
            wrong = set_bits > 0
            self._findings.add_rows(
                "reserved-bits",
                stream.rows[decoded.span][wrong],
                stream.stamps[decoded.span][wrong],
                shown=set_bits[wrong],
            )


class _FamilyChecks:
    """Limits, lookup tables and bit masks for the payloads of a message family, computed once."""

    def __init__(self, codec: ColumnCodec, pattern: float, hash_signal: str) -> None:
        fields = list(enumerate(codec.fields))
        ranged = [(p, f) for p, f in fields if is_limited(f)]
        #: Field index -> smallest and largest valid value (float field) or raw code (64-bit field).
        self.special = {
            p: _float_limits(f) if f.kind == "float" else raw_bounds(f)
            for p, f in ranged
            if f.kind == "float" or f.length == _WORD
        }
        self.bounds = {p: raw_bounds(f) for p, f in ranged if p not in self.special}
        self.limited = np.array(list(self.bounds), np.intp)
        self.low = np.array([low for low, _ in self.bounds.values()], np.int64)
        self.high = np.array([high for _, high in self.bounds.values()], np.int64)
        #: Field index -> raw code that means "no value". `_check_limits` searches the frames for each of these codes.
        #: Two kinds of fields are left out, because their code for "no value" is found without `coded`:
        #: - Fields whose code is outside their limits in `bounds`. `_check_limits` finds every code outside the limits.
        #: - Fields in `special`. `_check_special` compares each raw code with the code for "no value".
        self.coded = {
            p: code
            for p, f in fields
            if f.invalid_raw is not None and p not in self.special
            for code in [_as_signed(f, f.invalid_raw)]
            if p not in self.bounds or self.bounds[p][0] <= code <= self.bounds[p][1]
        }
        self.tables = {p: _table(f) for p, f in fields if is_enumeration(f)}
        self.hashes = [p for p, f in fields if is_hash(f, hash_signal)]
        self.pattern = np.uint64(2**64 - 1 if pattern else 0)
        unused = reserved_bits(codec.layout)
        self.reserved = {
            word: np.uint64(mask)
            for word in range((codec.layout.length + 7) // 8)
            if (mask := sum(1 << bit % _WORD for bit in unused if bit // _WORD == word))
        }


def reserved_bits(layout: Layout) -> list[int]:
    """Return the numbers of all payload bits that belong to no signal. Bit 0 is the least significant bit of byte 0."""
    used = {bit for f in layout.fields for bit in f.bits}
    return [bit for bit in range(8 * layout.length) if bit not in used]


def is_limited(limits: Field) -> bool:
    """Return whether a field can have a raw code outside its DBC range."""
    if limits.minimum is None or limits.maximum is None or limits.factor == 0:
        return False
    if limits.kind == "float":
        return True
    low, high = raw_bounds(limits)
    codes = raw_range(limits)
    return low > codes[0] or high < codes[-1]


def raw_bounds(limits: Field) -> tuple[int, int]:
    """Return the smallest and the largest raw code inside the DBC range.

    A tolerance of 1e-6 of a raw code is added, because the DBC limits are rounded decimals. float64 may have rounded a limit of
    2^53 or more. For such a limit, the rounding error is added, too.
    """
    assert limits.minimum is not None
    assert limits.maximum is not None
    return _codes_within(limits.minimum, limits.maximum, limits.factor, limits.offset, raw_range(limits))


@lru_cache(maxsize=4096)  # cached, because many signals of a DBC have equal limits
def _codes_within(minimum: float, maximum: float, factor: float, offset: float, codes: range) -> tuple[int, int]:
    # Compute with exact fractions. In a wide field, the rounding errors of float64 would exceed one raw code.
    scale, zero = Fraction(str(factor)), Fraction(str(offset))
    limits = []
    for limit in (minimum, maximum):
        x = min(max(limit, -sys.float_info.max), sys.float_info.max)  # a limit such as 1E999 is read as infinity
        rounded = 0.5 * math.ulp(x) if abs(x) >= _EXACT else 0.0
        limits.append(((Fraction(str(x)) - zero) / scale, Fraction("1e-6") + abs(Fraction(rounded) / scale)))
    (low, below), (high, above) = sorted(limits)
    return max(math.ceil(low - below), codes[0]), min(math.floor(high + above), codes[-1])


def _float_limits(limits: Field) -> tuple[float, float]:
    """Return the smallest and the largest physical value inside the DBC range of a float field.

    The raw value of each limit is rounded to the float format of the field. Therefore a limit that the format cannot
    represent, such as 0.1, is valid. For float64, a tolerance is added to each limit, because the DBC limits are rounded
    decimals. The tolerance is 1e-9 of the limit, but at least the rounding error of the offset.
    """
    assert limits.minimum is not None
    assert limits.maximum is not None
    low, high = (_as_sent(limits, x) for x in (limits.minimum, limits.maximum))
    if limits.length < _WORD:
        return low, high
    rounding = 1e-15 * abs(limits.offset)
    return low - max(1e-9 * abs(low), rounding), high + max(1e-9 * abs(high), rounding)


def _as_sent(limits: Field, value: float) -> float:
    """Round a physical value to the precision of the field's float format, as a sender does, and return the result.

    A value that is too large for the format is returned unchanged.
    """
    factor, offset = float(limits.factor), float(limits.offset)
    raw = np.float64((value - offset) / factor)
    with np.errstate(over="ignore"):
        sent = float(raw.astype(np.dtype(f"f{limits.length // 8}"))) * factor + offset
    return sent if math.isfinite(sent) else value


def is_enumeration(named: Field) -> bool:
    """Return whether the value table names all valid values of the field.

    Some value tables name only a few special values of a number, so they do not restrict the other values. For a
    field with a range, a table is considered complete if it names the minimum and the maximum of the range. For a field
    without a range, a table is considered complete if it names the value 0. A complete table has at least two names.
    If every raw code has a name, the result is False, because no value can be wrong.
    """
    if len(named.choices) < 2 or named.kind == "float" or named.factor != 1 or named.offset != 0:
        return False
    if all(code in named.choices for code in raw_range(named)[: len(named.choices) + 1]):
        return False
    if named.minimum is None or named.maximum is None:
        return 0 in named.choices
    return int(named.minimum) in named.choices and int(named.maximum) in named.choices


def is_hash(field: Field, signal: str) -> bool:
    """Return whether a field contains the DBC hash that a node reports.

    Args:
        field: field of a message.
        signal: signal name of the hash.
    """
    return field.name == signal and field.length == _HASH_BITS and field.kind == "unsigned"


def _table(named: Field) -> npt.NDArray[np.bool_] | Sequence[int]:
    if named.length > _TABLE_BITS:
        return list(named_codes(named))
    table = np.zeros(1 << named.length, np.bool_)
    for code in named.choices:
        if -len(table) <= code < len(table):
            table[code] = True
    return table


def _as_signed(limits: Field, raw: int) -> int:
    """Convert an unsigned raw code to a signed integer, such as 0xFF in a signed 8-bit field to -1.

    The result has the form of the raw codes in `Decoded.codes`.
    """
    if limits.kind == "signed" and raw >> limits.length - 1:
        return raw - (1 << limits.length)
    return as_int64(raw)
