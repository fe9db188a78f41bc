"""The acceptance protocol: every requirement with how it was tested, what was measured, and the verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from textwrap import wrap
from typing import Any

from atalante_tools.conform.bench import Bench
from atalante_tools.conform.requirement import Result, Verdict

_WIDTH = 110


def as_object(bench: Bench, result: Result) -> dict[str, Any]:
    """One requirement for programs."""
    requirement = result.requirement
    return {
        "node": bench.node.name,
        "id": requirement.id,
        "verdict": result.verdict.value.lower(),
        "requirement": requirement.text,
        "tested": requirement.how,
        "measured": result.measured,
        "source": requirement.source,
    }


def heading(bench: Bench, where: str, date: str) -> str:
    """What was examined, against what."""
    torque = f", at most {bench.limits.torque:g} Nm" if bench.node.kind == "drive" else ""
    return (
        f"ACCEPTANCE PROTOCOL  {bench.node.name} ({bench.node.kind})\n"
        f"on {where}, {date}; network {bench.network.hash32:#010x}{torque}\n"
    )


def entry(result: Result) -> str:
    """One requirement for people."""
    requirement = result.requirement
    lines = [f"{requirement.id:<11}{result.verdict.value:<11}{requirement.text}"]
    for label, text in (("tested", requirement.how), ("measured", result.measured), ("source", requirement.source)):
        indent = " " * 22
        lines += wrap(f"{label}: {text}", _WIDTH, initial_indent=indent, subsequent_indent=indent + "  ")
    return "\n".join(lines)


def conclusion(bench: Bench, results: Sequence[Result]) -> str:
    """One line."""
    counts = Counter(result.verdict for result in results)
    missed = [r.requirement.id for r in results if r.verdict is not Verdict.PASSED]
    text = f"{bench.node.name}: {counts[Verdict.PASSED]} of {len(results)} requirements passed"
    return f"{text}; not passed: {', '.join(missed)}" if missed else text
