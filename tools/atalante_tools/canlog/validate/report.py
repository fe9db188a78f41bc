"""Report of one log: text for the terminal, JUnit XML for a CI server, and the list of all rules."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from atalante_tools.canlog.validate.coverage import Unchecked, applicable, unchecked
from atalante_tools.canlog.validate.findings import Finding
from atalante_tools.canlog.validate.project import Silence
from atalante_tools.canlog.validate.rules import RULE_OF, RULES
from atalante_tools.canlog.validate.validator import Validator
from atalante_tools.console.terminal import table

#: Maximum number of unchecked items that the text report lists per reason. The HTML report lists all unchecked items.
_NAMES = 12
#: Verdict on a log or bus without frames.
_NO_FRAME = "no frame was checked"
#: Characters that XML 1.0 does not allow. The name of a log, or text quoted from a log, may contain such characters.
_NOT_IN_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class Report:
    """Report of the check of one log or one live bus."""

    name: str  # name of the log or the bus
    validator: Validator
    findings: tuple[Finding, ...]
    silenced: tuple[tuple[Finding, Silence], ...]
    unchecked: tuple[Unchecked, ...]

    @property
    def duration_s(self) -> float:
        """Return the time from the first to the last frame of the log [s]."""
        return 0.0 if self.validator.begin is None else (self.validator.end - self.validator.begin) * 1e-9


@dataclass(frozen=True)
class Unread:
    """Log that could not be read."""

    name: str  # name of the log
    reason: str  # reason and remedy, for the user


def report(name: str, validator: Validator, *, live: bool = False) -> Report:
    """Create the report of a finished validator, with the silenced findings in a separate list.

    Args:
        name: name of the log or of the bus.
        validator: validator after `finish`.
        live: whether the frames came from a live bus.
    """
    findings, silenced = [], []
    for finding in validator.findings.all():
        silence = validator.project.silence(finding.rule, finding.message)
        if silence is None:
            findings.append(finding)
        else:
            silenced.append((finding, silence))
    return Report(name, validator, tuple(findings), tuple(silenced), tuple(unchecked(validator, live=live)))


# -- text ---------------------------------------------------------------------------------------------------------------


def text(result: Report) -> str:
    """Return the report as text for the terminal.

    The text describes the log, then lists the findings, the silenced findings, and everything that was not checked.
    """
    validator = result.validator
    channels = ", ".join(name or "without a name" for name in validator.channels) or "none"
    lines = [
        f"{result.name}: {validator.frames} frames in {result.duration_s:.3f} s on {len(validator.channels)} channels "
        f"({channels}), "
        f"checked by {len(RULES)} rules against {validator.plan.catalogue.path.name} ({validator.plan.catalogue.hash32:08X})"
    ]
    if result.findings:
        lines += ["", _table(result.findings), ""]
        found = {finding.rule for finding in result.findings}
        lines += [f"{rule.id}: {rule.meaning} [{rule.source}]" for rule in RULES if rule.id in found]
    if result.silenced:
        lines += ["", "Silenced by the project:"]
        lines += [f"  {f.rule} {_where(f)}, {f.count} times: {silence.reason}" for f, silence in result.silenced]
    if result.unchecked:
        lines += ["", "Not checked:", *(f"  {_short(item)}" for item in result.unchecked)]
    lines += ["", verdict(result)]
    return "\n".join(lines)


def verdict(result: Report) -> str:
    """Return the result of the check in one line, such as "2 findings (5 occurrences)".

    Without findings, the line says that there are no findings, or that no frame was checked.
    """
    if result.findings:
        count = sum(finding.count for finding in result.findings)
        findings = "1 finding" if len(result.findings) == 1 else f"{len(result.findings)} findings"
        return f"{findings} ({count} {'occurrence' if count == 1 else 'occurrences'})"
    if not result.validator.frames:
        return _NO_FRAME
    silenced = f", {len(result.silenced)} silenced" if result.silenced else ""
    return f"no findings{silenced}; see above for the items that were not checked"


def _table(findings: Sequence[Finding]) -> str:
    head = ("rule", "message", "node", "count", "first s", "last s", "worst")
    rows = [
        (f.rule, f.message or "-", f.node or "-", str(f.count), f"{f.first_s:.6f}", f"{f.last_s:.6f}", f.worst or "-")
        for f in findings
    ]
    return table([head, *rows])


def _where(finding: Finding) -> str:
    return f"{finding.message}.{finding.signal}" if finding.signal else finding.message or "log"


def _short(item: Unchecked) -> str:
    if len(item.items) <= _NAMES:
        return str(item)
    shown = Unchecked(item.rules, (*item.items[:_NAMES], "..."), item.reason)
    return str(shown).replace(f"({len(shown.items)})", f"({len(item.items)})")


# -- JUnit -----------------------------------------------------------------------------------------------------------------


def write_junit(results: Sequence[Report | Unread], path: Path) -> None:
    """Write JUnit XML with one test suite per log and one test case per rule.

    A test case is skipped if the rule is silenced or was not checked for any message. If the rule was not checked for some
    messages, signals or channels, the `system-out` of the test case lists them. The test suite of a log that could not be
    read has one test case, which contains the error. A test suite without any frame and any finding has an additional
    test case with an error.
    """
    suites = ET.Element("testsuites", name="atalante validate")
    for result in results:
        if isinstance(result, Unread):
            _add_unread(suites, result)
            continue
        suite = ET.SubElement(suites, "testsuite", name=result.name, time=f"{result.duration_s:.3f}")
        errors = failures = skipped = 0
        if not (result.validator.frames or result.findings):
            errors = 1
            _add_error(suite, "frames", _NO_FRAME)
        for rule in RULES:
            case = ET.SubElement(suite, "testcase", classname="atalante.validate", name=rule.id)
            of_rule = [finding for finding in result.findings if finding.rule == rule.id]
            reason = _skipped(result, rule.id)
            if of_rule:
                failures += 1
                failure = ET.SubElement(case, "failure", message=f"{rule.meaning} [{rule.source}]")
                failure.text = "\n".join(
                    f"{_where(f)} ({f.node or 'no sender'}): {f.count} times, first {f.first_s:.6f} s, last {f.last_s:.6f} s, "
                    f"worst {f.worst or '-'}"
                    for f in of_rule
                )
            elif reason:
                skipped += 1
                ET.SubElement(case, "skipped", message=reason)
            partly = [item for item in result.unchecked if rule.id in item.rules and item.items]
            if partly and not reason:
                ET.SubElement(case, "system-out").text = "\n".join(f"not checked: {item}" for item in partly)
        suite.set("tests", str(len(suite)))
        suite.set("errors", str(errors))
        suite.set("failures", str(failures))
        suite.set("skipped", str(skipped))
    for element in suites.iter():
        element.attrib = {key: _xml_text(value) for key, value in element.attrib.items()}
        element.text = element.text and _xml_text(element.text)
    ET.indent(suites)
    ET.ElementTree(suites).write(path, encoding="utf-8", xml_declaration=True)


def _xml_text(text: str) -> str:
    r"""Replace each character that XML does not allow by an escape sequence, such as \x00, and return the new text."""
    return _NOT_IN_XML.sub(lambda found: ascii(found[0])[1:-1], text)


def _add_unread(suites: ET.Element, log: Unread) -> None:
    """Add the test suite of a log that could not be read."""
    suite = ET.SubElement(
        suites, "testsuite", name=log.name, tests="1", time="0.000", errors="1", failures="0", skipped="0"
    )
    _add_error(suite, "read", log.reason)


def _add_error(suite: ET.Element, name: str, reason: str) -> None:
    """Add a test case with an error to a test suite."""
    case = ET.SubElement(suite, "testcase", classname="atalante.validate", name=name)
    ET.SubElement(case, "error", message=reason).text = reason


def _skipped(result: Report, rule: str) -> str:
    """Return the reason why a rule was silenced or not checked; empty if the rule was checked."""
    if not result.validator.frames:
        return _NO_FRAME
    reasons = [f"silenced for {_where(f)}: {s.reason}" for f, s in result.silenced if f.rule == rule]
    of_rule = [item for item in result.unchecked if rule in item.rules]
    uncovered = applicable(result.validator, rule) - {name for item in of_rule for name in item.items}
    reasons += [f"not checked: {item.reason}" for item in of_rule if not (item.items and uncovered)]
    return "; ".join(reasons)


def rules_text() -> str:
    """Return every rule with its thresholds as a table, for `--list-rules`."""
    rows = [("rule", "meaning", "source", "thresholds")]
    for rule in RULE_OF.values():
        thresholds = ", ".join(f"{name} = {_toml(value)}" for name, value in rule.thresholds.items())
        rows.append((rule.id, rule.meaning, rule.source, thresholds or "-"))
    return table(rows)


def rules_json() -> list[dict[str, object]]:
    """Return every rule with its thresholds as JSON objects, for `--list-rules --json`."""
    return [
        {"rule": rule.id, "meaning": rule.meaning, "source": rule.source, "thresholds": dict(rule.thresholds)}
        for rule in RULE_OF.values()
    ]


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(f'"{item}"' for item in value) + "]"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"
