"""What a judged log comes to: for people at the terminal, for a machine (JSON lines), for a CI server (JUnit XML)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from atalante_tools.terminal import table
from atalante_tools.validate.coverage import Unjudged, unjudged
from atalante_tools.validate.findings import Finding
from atalante_tools.validate.judge import Judge
from atalante_tools.validate.project import Silence
from atalante_tools.validate.rules import RULE_OF, RULES

#: Names listed at the terminal for one reason; the HTML report has all of them.
_NAMES = 12


@dataclass(frozen=True)
class Report:
    """One judged log."""

    name: str  # of the log or the bus
    judge: Judge
    findings: tuple[Finding, ...]
    silenced: tuple[tuple[Finding, Silence], ...]
    unjudged: tuple[Unjudged, ...]

    @property
    def duration_s(self) -> float:
        """From the first frame to the last [s]."""
        return 0.0 if self.judge.begin is None else (self.judge.end - self.judge.begin) * 1e-9


def report(name: str, judge: Judge, *, live: bool = False) -> Report:
    """Conclude a log whose judge has finished."""
    findings, silenced = [], []
    for finding in judge.findings.all():
        silence = judge.project.silence(finding.rule, finding.message)
        if silence is None:
            findings.append(finding)
        else:
            silenced.append((finding, silence))
    return Report(name, judge, tuple(findings), tuple(silenced), tuple(unjudged(judge, live=live)))


# -- people ----------------------------------------------------------------------------------------------------------------


def text(result: Report) -> str:
    """The report as text: what was judged, what was found, what was silenced, what was not judged."""
    judge = result.judge
    channels = ", ".join(name or "without a name" for name in judge.channels) or "none"
    lines = [
        f"{result.name}: {judge.frames} frames in {result.duration_s:.3f} s on {len(judge.channels)} channels ({channels}), "
        f"judged by {len(RULES)} rules with {judge.plan.catalogue.path.name} ({judge.plan.catalogue.hash32:08X})"
    ]
    if result.findings:
        lines += ["", _table(result.findings), ""]
        found = {finding.rule for finding in result.findings}
        lines += [f"{rule.id}: {rule.meaning} [{rule.source}]" for rule in RULES if rule.id in found]
    if result.silenced:
        lines += ["", "Silenced by the project:"]
        lines += [f"  {f.rule} {_where(f)}, {f.count} times: {silence.reason}" for f, silence in result.silenced]
    if result.unjudged:
        lines += ["", "Not judged:", *(f"  {_short(item)}" for item in result.unjudged)]
    lines += ["", verdict(result)]
    return "\n".join(lines)


def verdict(result: Report) -> str:
    """One sentence at the end."""
    if result.findings:
        count = sum(finding.count for finding in result.findings)
        findings = "1 finding" if len(result.findings) == 1 else f"{len(result.findings)} findings"
        return f"{findings} ({count} {'occurrence' if count == 1 else 'occurrences'})"
    if not result.judge.frames:
        return "nothing was judged"
    silenced = f", {len(result.silenced)} silenced" if result.silenced else ""
    return f"no findings{silenced}; what is listed as not judged was not looked at"


def _table(findings: Sequence[Finding]) -> str:
    head = ("rule", "message", "node", "count", "first s", "last s", "worst")
    rows = [
        (f.rule, f.message or "-", f.node or "-", str(f.count), f"{f.first_s:.6f}", f"{f.last_s:.6f}", f.worst or "-")
        for f in findings
    ]
    return table([head, *rows])


def _where(finding: Finding) -> str:
    return f"{finding.message}.{finding.signal}" if finding.signal else finding.message or "log"


def _short(item: Unjudged) -> str:
    if len(item.what) <= _NAMES:
        return str(item)
    shown = Unjudged(item.rules, (*item.what[:_NAMES], "..."), item.why)
    return str(shown).replace(f"({len(shown.what)})", f"({len(item.what)})")


# -- JUnit -----------------------------------------------------------------------------------------------------------------


def write_junit(results: Sequence[Report], path: Path) -> None:
    """One test suite a log, one test case a rule: failed, passed, or skipped where it was silenced or could not judge."""
    suites = ET.Element("testsuites", name="atalante validate")
    for result in results:
        suite = ET.SubElement(
            suites, "testsuite", name=result.name, tests=str(len(RULES)), time=f"{result.duration_s:.3f}"
        )
        failures = skipped = 0
        for rule in RULES:
            case = ET.SubElement(suite, "testcase", classname="atalante.validate", name=rule.id)
            mine = [finding for finding in result.findings if finding.rule == rule.id]
            why = _skipped(result, rule.id)
            if mine:
                failures += 1
                failure = ET.SubElement(case, "failure", message=f"{rule.meaning} [{rule.source}]")
                failure.text = "\n".join(
                    f"{_where(f)} ({f.node or 'no sender'}): {f.count} times, first {f.first_s:.6f} s, last {f.last_s:.6f} s, "
                    f"worst {f.worst or '-'}"
                    for f in mine
                )
            elif why:
                skipped += 1
                ET.SubElement(case, "skipped", message=why)
        suite.set("failures", str(failures))
        suite.set("skipped", str(skipped))
    ET.indent(suites)
    ET.ElementTree(suites).write(path, encoding="utf-8", xml_declaration=True)


def _skipped(result: Report, rule: str) -> str:
    """Why a rule found nothing, if that is not because all is well."""
    reasons = [f"silenced for {_where(f)}: {s.reason}" for f, s in result.silenced if f.rule == rule]
    reasons += [f"not judged: {item.why}" for item in result.unjudged if rule in item.rules and not item.what]
    return "; ".join(reasons)


def rules_text() -> str:
    """Every rule with its thresholds, for `--list-rules`."""
    rows = [("rule", "meaning", "source", "thresholds")]
    for rule in RULE_OF.values():
        thresholds = ", ".join(f"{name} = {_toml(value)}" for name, value in rule.thresholds.items())
        rows.append((rule.id, rule.meaning, rule.source, thresholds or "-"))
    return table(rows)


def rules_json() -> list[dict[str, object]]:
    """The same for scripts."""
    return [
        {"rule": rule.id, "meaning": rule.meaning, "source": rule.source, "thresholds": dict(rule.thresholds)}
        for rule in RULE_OF.values()
    ]


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(f'"{item}"' for item in value) + "]"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"
