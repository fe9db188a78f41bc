"""What was found: one finding a rule, message and signal, with count, first, last and worst occurrence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_tools.validate.plan import Plan
from atalante_tools.validate.rules import RULE_OF

Stamps = npt.NDArray[np.int64]
#: Messages told apart by an identifier or a channel that somebody else chose are unbounded; more than this many are one.
MOST = 100
OTHERS = "(others)"
_UNBOUNDED = ("unknown-id",)


@dataclass
class Finding:
    """One rule broken by one signal, message or bus, however often."""

    rule: str
    message: str
    node: str
    signal: str
    count: int
    first: int  # ns
    last: int  # ns
    worst: str
    badness: float

    @property
    def first_s(self) -> float:
        """Time of the first occurrence [s], as the log gives it."""
        return self.first * 1e-9

    @property
    def last_s(self) -> float:
        """Time of the last occurrence [s]."""
        return self.last * 1e-9

    def as_json(self) -> dict[str, Any]:
        """The finding as one object: exactly rule, message, node, count, first_s, last_s and worst."""
        return {
            "rule": self.rule,
            "message": self.message,
            "node": self.node,
            "count": self.count,
            "first_s": self.first_s,
            "last_s": self.last_s,
            "worst": self.worst,
        }


class Findings:
    """Gathers occurrences; the functions that judge hand them over as columns."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._found: dict[tuple[str, str, str], Finding] = {}

    def __len__(self) -> int:
        return len(self._found)

    def all(self) -> list[Finding]:
        """In the order of the rules, then by message."""
        order = list(RULE_OF)
        return sorted(self._found.values(), key=lambda f: (order.index(f.rule), f.first, f.message, f.signal))

    def add(
        self,
        rule: str,
        message: str,
        stamps: Stamps,
        *,
        node: str = "",
        signal: str = "",
        shown: Sequence[float | str] | npt.NDArray[Any] | None = None,
        badness: npt.NDArray[Any] | None = None,
        unit: str | None = None,
    ) -> None:
        """Occurrences of one message.

        Args:
            stamps: shape (n,) [ns], n >= 1.
            shown: what the worst value of each reads, shape (n,).
            badness: how bad each is, shape (n,); by default `shown`.
            unit: of `shown`, by default the rule's.
        """
        if badness is None:
            badness = np.asarray(shown, np.float64) if shown is not None else np.zeros(len(stamps))
        at = int(np.argmax(badness))
        worst = "" if shown is None else _text(shown[at], RULE_OF[rule].worst if unit is None else unit, signal)
        found = Finding(
            rule, message, node, signal, len(stamps), int(stamps.min()), int(stamps.max()), worst, float(badness[at])
        )
        self._merge(found)

    def add_rows(
        self,
        rule: str,
        rows: npt.NDArray[Any],
        stamps: Stamps,
        *,
        signal: str = "",
        shown: npt.NDArray[Any] | None = None,
        badness: npt.NDArray[Any] | None = None,
        unit: str | None = None,
    ) -> None:
        """Occurrences of many messages, told apart by their row. Shapes (n,)."""
        for row in np.unique(rows).tolist():
            of_row = rows == row
            self.add(
                rule,
                self._plan.name(row),
                stamps[of_row],
                node=self._plan.sender(row),
                signal=signal,
                shown=None if shown is None else shown[of_row],
                badness=None if badness is None else badness[of_row],
                unit=unit,
            )

    def add_whole(self, rule: str, row: int, first: int, last: int, *, shown: float, count: int = 1) -> None:
        """Something about a message over a stretch of the log [ns]."""
        worst = _text(shown, RULE_OF[rule].worst, "")
        self._merge(Finding(rule, self._plan.name(row), self._plan.sender(row), "", count, first, last, worst, shown))

    def add_log(self, rule: str, stamp: int, count: int, sentence: str) -> None:
        """Something about the log itself; the sentence says what."""
        self._merge(Finding(rule, "", "", "", count, stamp, stamp, sentence, 0.0))

    def _merge(self, found: Finding) -> None:
        key = (found.rule, found.message, found.signal)
        full = sum(rule == found.rule for rule, _, _ in self._found) >= MOST
        if found.rule in _UNBOUNDED and key not in self._found and full:
            found.message = OTHERS
            key = (found.rule, found.message, "")
        known = self._found.setdefault(key, found)
        if known is found:
            return
        known.count += found.count
        known.first, known.last = min(known.first, found.first), max(known.last, found.last)
        if found.badness > known.badness:
            known.badness, known.worst = found.badness, found.worst


def _text(value: Any, unit: str, signal: str) -> str:
    if isinstance(value, str):
        text = value
    else:
        number = float(value)
        text = str(int(number)) if number.is_integer() and abs(number) < 1e15 else f"{number:.6g}"
        text = f"{text} {unit}" if unit and unit != "1" else text
    return f"{signal} = {text}" if signal else text
