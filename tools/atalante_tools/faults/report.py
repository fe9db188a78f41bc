"""The report of a campaign: one line a fault, how long each is survived, and what pairs of them do. Markdown and JSON.

results -> Summary -> table on the terminal, report.md, report.json
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from atalante_tools.faults.matrix import load_matrix
from atalante_tools.faults.tasks import HORIZON, REPRESENTATIVES, Endurance, PairVerdict, Result
from atalante_tools.faults.verdict import Verdict


@dataclass(frozen=True)
class Line:
    """One fault over all its cases: the keys of `--json`."""

    id: str
    passed: bool
    state: str
    cycles: int | None  # of the worst case: the first that failed, else the one nearest to its bound
    bound: int
    dtc: str
    cases: int
    failures: tuple[str, ...]  # each with the name of its case


def line_of(verdicts: Sequence[Verdict]) -> Line:
    """The cases of one fault."""
    worst = max(verdicts, key=lambda v: (not v.passed, (v.cycles or 0) / max(1, v.bound)))
    failures = tuple(f"{v.case}: {failure}" for v in verdicts for failure in v.failures)
    return Line(worst.id, not failures, worst.state, worst.cycles, worst.bound, worst.dtc, len(verdicts), failures)


@dataclass(frozen=True)
class Summary:
    """A campaign."""

    lines: tuple[Line, ...]
    endurance: tuple[Endurance, ...]
    pairs: tuple[PairVerdict, ...]
    seconds: float  # it took

    @classmethod
    def of(cls, results: Iterable[Result], seconds: float = 0.0) -> Summary:
        """From results in any order."""
        every = list(results)
        by_id: dict[str, list[Verdict]] = {}
        for verdict in every:
            if isinstance(verdict, Verdict):
                by_id.setdefault(verdict.id, []).append(verdict)
        lasting = [one for one in every if isinstance(one, Endurance)]
        pairs = [one for one in every if isinstance(one, PairVerdict)]
        return cls(
            tuple(line_of(sorted(by_id[id_], key=lambda v: v.case)) for id_ in load_matrix() if id_ in by_id),
            tuple(sorted(lasting, key=lambda one: one.id)),
            tuple(sorted(pairs, key=lambda pair: (pair.first, pair.second))),
            seconds,
        )

    @property
    def passed(self) -> bool:
        """Every case and every pair."""
        return all(line.passed for line in self.lines) and not any(pair.failures for pair in self.pairs)

    def write(self, folder: Path) -> None:
        """report.md and report.json."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "report.md").write_text(self.markdown())
        (folder / "report.json").write_text(json.dumps(self.as_dict(), indent=2) + "\n")

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"version": version("atalante-hal"), "passed": self.passed, **asdict(self)}

    def markdown(self) -> str:
        """For people."""
        matrix = load_matrix()
        rows = [
            [
                line.id,
                matrix[line.id].fault,
                "yes" if line.passed else "**NO**",
                line.state,
                number(line.cycles),
                str(line.bound),
                line.dtc,
                str(line.cases),
            ]
            for line in self.lines
        ]
        head = ["ID", "Fault", "Passed", "State", "Cycles", "Bound", "DTC", "Cases"]
        passed, cases = sum(line.passed for line in self.lines), sum(line.cases for line in self.lines)
        parts = [
            "# Fault campaign",
            f"atalante-hal {version('atalante-hal')}: {passed} of {len(self.lines)} faults passed, {cases} cases, "
            f"{self.seconds:.0f} s. Cycles and state are those of the worst case.",
            _table([head, *rows]),
        ]
        if failed := [f"- {line.id} {failure}" for line in self.lines for failure in line.failures]:
            parts += ["## What failed", "\n".join(failed)]
        if self.endurance:
            lasting = [[e.id, matrix[e.id].fault, e.case, survived(e)] for e in self.endurance]
            parts += ["## How long the walk survives it", _table([["ID", "Fault", "Case", "Cycles"], *lasting])]
        if self.pairs:
            parts += ["## Two at a time", self._pairs()]
        return "\n\n".join(parts) + "\n"

    def _pairs(self) -> str:
        """The state in which each pair ends, the first fault of it down, the second across."""
        names = [f"{id_} {name}" for id_, name in REPRESENTATIVES]
        found = {(pair.first, pair.second): pair for pair in self.pairs}
        rows = [["", *(name.split()[0] for name in names)]]
        for first in names:
            row = [found.get((first, second)) for second in names]
            rows.append([first, *("" if p is None else f"{'**FAILED** ' if p.failures else ''}{p.state}" for p in row)])
        failed = [f"- {p.first} and {p.second}: {failure}" for p in self.pairs for failure in p.failures]
        return "\n\n".join([_table(rows), *(["\n".join(failed)] if failed else [])])


def survived(endurance: Endurance) -> str:
    """Cycles, for people."""
    return f"{HORIZON} and more" if endurance.survived is None else str(endurance.survived)


def number(value: int | None) -> str:
    """For people."""
    return "-" if value is None else str(value)


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *rest = rows
    lines = [head, ["---"] * len(head), *rest]
    return "\n".join(f"| {' | '.join(row)} |" for row in lines)
