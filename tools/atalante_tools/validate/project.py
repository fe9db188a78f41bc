"""A project's rules file: thresholds other than ours, rules silenced with a reason, channels by name. Read strictly.

[cycle-jitter]
p99 = 0.4

[[silence]]
rule = "cycle-gap"
message = "*_STATUS"          # a name, or a pattern; "*" is every message
reason = "sent by a task of low priority, see TICKET-17"

[channels]
can0 = "left_leg"
"""

from __future__ import annotations

import fnmatch
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from atalante_tools.validate.rules import RULE_OF, Threshold

_SILENCE_KEYS = ("rule", "message", "reason")


class ProjectError(ValueError):
    """The rules file does not make sense; the message names the key and what is valid."""


@dataclass(frozen=True)
class Silence:
    """A rule that a project does not want to hear about, and why."""

    rule: str
    message: str  # name or pattern
    reason: str

    def covers(self, rule: str, message: str) -> bool:
        """Whether a finding is silenced by this."""
        return rule == self.rule and fnmatch.fnmatchcase(message, self.message)


@dataclass(frozen=True)
class Project:
    """Thresholds by rule, over our own."""

    thresholds: Mapping[str, Mapping[str, Threshold]] = field(default_factory=dict)
    silences: tuple[Silence, ...] = ()
    channels: Mapping[str, str] = field(default_factory=dict)  # channel of the log -> bus of the DBC

    def threshold(self, rule: str, name: str) -> Threshold:
        """A threshold of a rule."""
        return self.thresholds.get(rule, {}).get(name, RULE_OF[rule].thresholds[name])

    def number(self, rule: str, name: str) -> float:
        """A threshold that is a number."""
        value = self.threshold(rule, name)
        assert isinstance(value, float)
        return value

    def text(self, rule: str, name: str) -> str:
        """A threshold that is a name."""
        return str(self.threshold(rule, name))

    def names(self, rule: str, name: str) -> tuple[str, ...]:
        """A threshold that is a list of names."""
        value = self.threshold(rule, name)
        assert isinstance(value, tuple)
        return value

    def quantities(self, rule: str) -> dict[str, float]:
        """A rule whose thresholds are one number a quantity."""
        found = {**RULE_OF[rule].thresholds, **self.thresholds.get(rule, {})}
        return {name: value for name, value in found.items() if isinstance(value, float)}

    def silence(self, rule: str, message: str) -> Silence | None:
        """What silences a finding, if anything does."""
        return next((s for s in self.silences if s.covers(rule, message)), None)


#: Rules whose thresholds are named by the quantities of the network, so that a project may add one.
_OPEN = ("step",)


def load_project(path: Path) -> Project:
    """Read a rules file.

    Raises:
        ProjectError: unknown rule, threshold or key, a value of the wrong kind, a silence without a reason.
    """
    try:
        document = tomllib.loads(path.read_text())
    except OSError as error:
        raise ProjectError(f"{path} cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ProjectError(f"{path} cannot be read as TOML: {error}") from error
    silences = document.pop("silence", [])
    channels = document.pop("channels", {})
    if not isinstance(silences, list):
        raise ProjectError(f"{path}: silence is a list of tables: write [[silence]]")
    if not isinstance(channels, dict) or not all(isinstance(bus, str) for bus in channels.values()):
        raise ProjectError(f"{path}: [channels] gives each channel the name of a bus")
    return Project(
        {rule: _thresholds(path, rule, table) for rule, table in document.items()},
        tuple(_silence(path, entry) for entry in silences),
        channels,
    )


def _thresholds(path: Path, rule: str, table: Any) -> dict[str, Threshold]:
    if rule not in RULE_OF:
        raise ProjectError(f"{path}: there is no rule {rule!r}; the rules are {', '.join(RULE_OF)}")
    known = RULE_OF[rule].thresholds
    if not isinstance(table, dict) or not known:
        raise ProjectError(f"{path}: {rule} {'is a table of thresholds' if known else 'has no threshold'}")
    found: dict[str, Threshold] = {}
    for name, value in table.items():
        like = known.get(name, 0.0 if rule in _OPEN else None)
        if like is None:
            raise ProjectError(f"{path}: {rule} has no threshold {name!r}; it has {', '.join(known)}")
        found[name] = _value(f"{path}: {rule}.{name}", value, like)
    return found


def _value(where: str, value: Any, like: Threshold) -> Threshold:
    if isinstance(like, float):
        if type(value) not in (int, float) or not math.isfinite(value) or value < 0:
            raise ProjectError(f"{where} is a number that is not negative, not {value!r}")
        return float(value)
    if isinstance(like, tuple):
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise ProjectError(f"{where} is a list of names, not {value!r}")
        return tuple(value)
    if not isinstance(value, str):
        raise ProjectError(f"{where} is a name, not {value!r}")
    return value


def _silence(path: Path, entry: Any) -> Silence:
    if (
        not isinstance(entry, dict)
        or set(entry) - set(_SILENCE_KEYS)
        or not all(isinstance(v, str) for v in entry.values())
    ):
        raise ProjectError(f"{path}: a [[silence]] has the keys {', '.join(_SILENCE_KEYS)}, all of them text")
    if entry.get("rule") not in RULE_OF:
        raise ProjectError(
            f"{path}: a [[silence]] names one of the rules {', '.join(RULE_OF)}, not {entry.get('rule')!r}"
        )
    if not entry.get("reason", "").strip():
        raise ProjectError(f"{path}: the [[silence]] of {entry['rule']} needs a reason, for whoever reads the report")
    return Silence(entry["rule"], entry.get("message", "*"), entry["reason"])
