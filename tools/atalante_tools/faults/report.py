"""Report of a fault campaign in Markdown and JSON: results of single faults, endurance runs and pairs of faults.

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
from atalante_tools.faults.moments import Moment, MomentVerdict
from atalante_tools.faults.tasks import HORIZON, REPRESENTATIVES, Endurance, PairVerdict, Result
from atalante_tools.faults.verdict import Verdict


@dataclass(frozen=True)
class Line:
    """Result of all test cases of one fault. The field names are the JSON keys of the command `atalante faults`.

    The fields `state`, `cycles`, `bound` and `dtc` come from the worst test case. If a case failed, a failed case is the worst.
    If all cases passed, the case closest to its time limit is the worst.
    """

    id: str
    passed: bool
    state: str
    #: number of cycles from the fault to the reaction, or to the diagnostic if there was no reaction; None if there was neither
    cycles: int | None
    bound: int  # time limit for `cycles`
    dtc: str
    cases: int
    failures: tuple[str, ...]  # description of each failure: name of the case and a sentence


def line_of(verdicts: Sequence[Verdict]) -> Line:
    """Summarize the verdicts of one fault.

    Args:
        verdicts: verdicts of all cases of the fault.
    """
    worst = max(verdicts, key=lambda v: (not v.passed, (v.cycles or 0) / max(1, v.bound)))
    failures = tuple(f"{v.case}: {failure}" for v in verdicts for failure in v.failures)
    return Line(worst.id, not failures, worst.state, worst.cycles, worst.bound, worst.dtc, len(verdicts), failures)


@dataclass(frozen=True)
class Summary:
    """All results of a fault campaign."""

    lines: tuple[Line, ...]
    endurance: tuple[Endurance, ...]
    pairs: tuple[PairVerdict, ...]
    moments: tuple[MomentVerdict, ...]  # results of runs with one or two faults that begin at a `Moment`, such as READY
    seconds: float  # duration of the campaign [s]

    @classmethod
    def of(cls, results: Iterable[Result], seconds: float = 0.0) -> Summary:
        """Summarize the results of a fault campaign.

        Args:
            results: results in any order.
            seconds: duration of the campaign [s].
        """
        every = list(results)
        by_id: dict[str, list[Verdict]] = {}
        for verdict in every:
            if isinstance(verdict, Verdict):
                by_id.setdefault(verdict.id, []).append(verdict)
        lasting = [one for one in every if isinstance(one, Endurance)]
        pairs = [one for one in every if isinstance(one, PairVerdict)]
        moments = [one for one in every if isinstance(one, MomentVerdict)]
        return cls(
            tuple(line_of(sorted(by_id[id_], key=lambda v: v.case)) for id_ in load_matrix() if id_ in by_id),
            tuple(sorted(lasting, key=lambda one: one.id)),
            tuple(sorted(pairs, key=lambda pair: (pair.first, pair.second))),
            tuple(sorted(moments, key=lambda one: (list(Moment).index(Moment(one.moment)), one.faults))),
            seconds,
        )

    @property
    def passed(self) -> bool:
        """Return whether all faults, all pairs, and all runs in `moments` passed."""
        failed = [*(pair.failures for pair in self.pairs), *(run.failures for run in self.moments)]
        return all(line.passed for line in self.lines) and not any(failed)

    def write(self, folder: Path) -> None:
        """Write the report as Markdown and JSON, to report.md and report.json.

        Args:
            folder: folder of the files, created if it is missing.
        """
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "report.md").write_text(self.markdown())
        (folder / "report.json").write_text(json.dumps(self.as_dict(), indent=2) + "\n")

    def as_dict(self) -> dict[str, Any]:
        """Return the content of report.json."""
        return {"version": version("atalante-hal"), "passed": self.passed, **asdict(self)}

    def markdown(self) -> str:
        """Return the content of report.md."""
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
            f"{self.seconds:.0f} s. Each row shows cycles and state of the worst case.",
            _table([head, *rows]),
        ]
        if failed := [f"- {line.id} {failure}" for line in self.lines for failure in line.failures]:
            parts += ["## Failures", "\n".join(failed)]
        if self.endurance:
            lasting = [[e.id, matrix[e.id].fault, e.case, survived(e)] for e in self.endurance]
            parts += [
                "## Longest duration of each fault that the walk survives",
                _table([["ID", "Fault", "Case", "Cycles"], *lasting]),
            ]
        if self.pairs:
            parts += ["## Pairs of faults", self._pairs()]
        if self.moments:
            parts += ["## Faults at all moments", self._moments()]
        return "\n\n".join(parts) + "\n"

    def _moments(self) -> str:
        """Return the Markdown table of all runs in `moments`, and a list of the failed runs.

        One row summarizes all runs with the same `Moment`, all random pairs, or all runs with the same fault.
        """
        single = [run for run in self.moments if len(run.faults) == 1]
        pairs = [run for run in self.moments if len(run.faults) > 1]
        groups = [(f"all, {moment}", [run for run in single if run.moment == moment]) for moment in Moment]
        groups.append(("random pairs", pairs))
        ids = dict.fromkeys(run.faults[0].split()[0] for run in single)
        groups += [(id_, [run for run in single if run.faults[0].split()[0] == id_]) for id_ in ids]
        head = ["Faults", "Runs", "Failed", "Restarted", "Joint speed / limit", "Torque step [Nm]", "Motion in the start [deg]",
                "Motion in HOLD [deg]"]  # fmt: skip
        rows = [[name, *_moment_row(runs)] for name, runs in groups if runs]
        failed = [
            f"- {' and '.join(run.faults)}, moment {run.moment}: {failure}"
            for run in self.moments
            for failure in run.failures
        ]
        return "\n\n".join([_table([head, *rows]), *(["\n".join(failed)] if failed else [])])

    def _pairs(self) -> str:
        """Return a table of the final states of all fault pairs: one row per first fault, and one column per second fault."""
        names = [f"{id_} {name}" for id_, name in REPRESENTATIVES]
        found = {(pair.first, pair.second): pair for pair in self.pairs}
        rows = [["", *(name.split()[0] for name in names)]]
        for first in names:
            row = [found.get((first, second)) for second in names]
            rows.append([first, *("" if p is None else f"{'**FAILED** ' if p.failures else ''}{p.state}" for p in row)])
        failed = [f"- {p.first} and {p.second}: {failure}" for p in self.pairs for failure in p.failures]
        return "\n\n".join([_table(rows), *(["\n".join(failed)] if failed else [])])


def _moment_row(runs: Sequence[MomentVerdict]) -> list[str]:
    """Return the cells of a table row for a group of runs.

    The row starts with the numbers of all runs, failed runs and restarted runs. The four measured values of `Extremes` follow:
    each cell contains the largest value of all runs, and its joint.
    """
    extremes = [run.extremes for run in runs if run.extremes is not None]
    counts = [len(runs), sum(bool(run.failures) for run in runs), sum(run.restarted for run in runs)]
    worst = [
        max((getattr(one, name) for one in extremes), default=None) for name in ("speed", "torque_step", "sag", "lost")
    ]
    return [*map(str, counts), *("-" if one is None else f"{one.value:.2f} {one.joint}" for one in worst)]


def survived(endurance: Endurance) -> str:
    """Return the longest fault duration that the walk survives [cycles], as text for a table.

    Args:
        endurance: result of the run.
    """
    return f"{HORIZON} and more" if endurance.survived is None else str(endurance.survived)


def number(value: int | None) -> str:
    """Return a number as text; None becomes "-".

    Args:
        value: number to show.
    """
    return "-" if value is None else str(value)


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *rest = rows
    lines = [head, ["---"] * len(head), *rest]
    return "\n".join(f"| {' | '.join(row)} |" for row in lines)
