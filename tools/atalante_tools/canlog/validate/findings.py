"""Findings of the validator. One finding combines all violations of the same rule by the same message or signal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_tools.canlog.plan import Plan
from atalante_tools.canlog.validate.rules import RULE_OF

Stamps = npt.NDArray[np.int64]
#: Maximum number of findings for unknown identifiers, one finding per identifier. One more finding, `OTHERS`, counts the frames
#: of all other unknown identifiers.
MAX_UNKNOWN_IDS = 100
OTHERS = "(others)"
#: Rules for which `MAX_UNKNOWN_IDS` limits the number of findings.
_UNBOUNDED = ("unknown-id",)


@dataclass(kw_only=True)
class Finding:
    """All violations of the same rule by the same signal, message or bus."""

    rule: str
    message: str
    node: str
    signal: str
    count: int
    first: int  # time stamp of the first violation [ns]
    last: int  # time stamp of the last violation [ns]
    worst: str  # text for the report: value and unit of the worst violation
    badness: float  # number that ranks the violations of a rule; the worst violation has the largest number

    @property
    def first_s(self) -> float:
        """Return the time stamp of the first violation in the log [s]."""
        # The divisor is an integer, so only the quotient is rounded. With the float 1e9, the time stamp would also be rounded.
        return self.first / 10**9

    @property
    def last_s(self) -> float:
        """Return the time stamp of the last violation in the log [s]."""
        return self.last / 10**9

    def as_json(self) -> dict[str, Any]:
        """Return the finding as a JSON object with the keys rule, message, signal, node, count, first_s, last_s and worst.

        The signal is None in a finding about a whole frame, a bus or the log.
        """
        return {
            "rule": self.rule,
            "message": self.message,
            "signal": self.signal or None,
            "node": self.node,
            "count": self.count,
            "first_s": self.first_s,
            "last_s": self.last_s,
            "worst": self.worst,
        }


class Findings:
    """Collection of the findings of one log. The validator rules add violations as arrays."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._found: dict[tuple[str, str, str], Finding] = {}

    def __len__(self) -> int:
        return len(self._found)

    def all(self) -> list[Finding]:
        """Return the findings ordered by rule, then by the time of the first violation."""
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
        """Add violations of a rule by one message.

        Args:
            rule: identifier of the rule.
            message: name of the message. For the bus load, the name of the bus. For an unknown message, the identifier.
            stamps: time stamp of each violation, shape (n,) [ns], n >= 1.
            node: sender of the message, if known.
            signal: name of the signal; empty for a rule about the whole frame.
            shown: value of each violation for the report, shape (n,).
            badness: severity of each violation, shape (n,), larger is worse.  [default: `shown`]
            unit: unit of `shown`.  [default: unit of the rule]
        """
        if badness is None:
            badness = np.asarray(shown, np.float64) if shown is not None else np.zeros(len(stamps))
        at = int(np.argmax(badness))
        worst = "" if shown is None else _text(shown[at], RULE_OF[rule].worst if unit is None else unit, signal)
        self._merge(
            Finding(
                rule=rule,
                message=message,
                node=node,
                signal=signal,
                count=len(stamps),
                first=int(stamps.min()),
                last=int(stamps.max()),
                worst=worst,
                badness=float(badness[at]),
            )
        )

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
        """Add violations of a rule by several messages.

        Args:
            rule: identifier of the rule.
            rows: index of the message in the plan, for each violation, shape (n,).
            stamps: time stamp of each violation, shape (n,) [ns], n >= 1.
            signal: name of the signal; empty for a rule about the whole frame.
            shown: value of each violation for the report, shape (n,).
            badness: severity of each violation, shape (n,), larger is worse.  [default: `shown`]
            unit: unit of `shown`.  [default: unit of the rule]
        """
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
        """Add a finding with `count` violations by one message, from time stamp `first` to time stamp `last` [ns]."""
        worst = _text(shown, RULE_OF[rule].worst, "")
        self._merge(
            Finding(
                rule=rule,
                message=self._plan.name(row),
                node=self._plan.sender(row),
                signal="",
                count=count,
                first=first,
                last=last,
                worst=worst,
                badness=shown,
            )
        )

    def add_log(self, rule: str, stamp: int, count: int, sentence: str) -> None:
        """Add a finding about the log file. The sentence describes the defect of the file."""
        self._merge(
            Finding(
                rule=rule,
                message="",
                node="",
                signal="",
                count=count,
                first=stamp,
                last=stamp,
                worst=sentence,
                badness=0.0,
            )
        )

    def _merge(self, found: Finding) -> None:
        key = (found.rule, found.message, found.signal)
        full = sum(rule == found.rule for rule, _, _ in self._found) >= MAX_UNKNOWN_IDS
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
        text = str(int(number)) if number.is_integer() and abs(number) <= 2**53 else f"{number:.6g}"
        text = f"{text} {unit}" if unit and unit != "1" else text
    return f"{signal} = {text}" if signal else text
