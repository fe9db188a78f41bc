"""Acceptance report: each requirement with its test, the measured values and the verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from textwrap import wrap
from typing import Any

from atalante_tools.conform.node_tester import NodeTester
from atalante_tools.conform.requirement import Result, Verdict

_WIDTH = 110


def as_object(tester: NodeTester, result: Result) -> dict[str, Any]:
    """Return one result as a JSON object."""
    requirement = result.requirement
    return {
        "node": tester.node.name,
        "id": requirement.id,
        "verdict": result.verdict.value.lower(),
        "requirement": requirement.text,
        "tested": requirement.how,
        "measured": result.measured,
        "source": requirement.source,
    }


def heading(tester: NodeTester, target: str, date: str) -> str:
    """Return the heading of the report: node, bus, date, network hash and torque limit."""
    torque = f", at most {tester.limits.torque:g} Nm" if tester.node.kind == "drive" else ""
    return (
        f"ACCEPTANCE REPORT  {tester.node.name} ({tester.node.kind})\n"
        f"on {target}, {date}; network {tester.network.hash32:#010x}{torque}\n"
    )


def entry(result: Result) -> str:
    """Return one result as lines of text."""
    requirement = result.requirement
    lines = [f"{requirement.id:<11}{result.verdict.value:<11}{requirement.text}"]
    for label, text in (("tested", requirement.how), ("measured", result.measured), ("source", requirement.source)):
        indent = " " * 22
        lines += wrap(f"{label}: {text}", _WIDTH, initial_indent=indent, subsequent_indent=indent + "  ")
    return "\n".join(lines)


def conclusion(tester: NodeTester, results: Sequence[Result]) -> str:
    """Return the last line of the report: the number of passed requirements, and the identifiers of the other requirements."""
    counts = Counter(result.verdict for result in results)
    missed = [r.requirement.id for r in results if r.verdict is not Verdict.PASSED]
    text = f"{tester.node.name}: {counts[Verdict.PASSED]} of {len(results)} requirements passed"
    return f"{text}; not passed: {', '.join(missed)}" if missed else text
