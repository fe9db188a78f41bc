"""Rules file of a project (TOML): thresholds, silenced rules with a reason, and the bus of each channel.

The loader rejects unknown keys, and values of the wrong type.

[cycle-jitter]
p99 = 0.4

[[silence]]
rule = "cycle-gap"
message = "*_STATUS"          # name or pattern; "*" is every message
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

from atalante_tools.canlog.validate.rules import RULE_OF, Threshold

_SILENCE_KEYS = ("rule", "message", "reason")


class ProjectError(ValueError):
    """Raised if a rules file is invalid. The message names the key and the valid values."""


@dataclass(frozen=True)
class Silence:
    """Table [[silence]] of a rules file, which silences a rule for some messages."""

    rule: str
    message: str  # name of the message, or pattern for the names of several messages
    reason: str

    def covers(self, rule: str, message: str) -> bool:
        """Return whether this [[silence]] table of the rules file silences a rule for a message.

        Args:
            rule: name of the rule.
            message: name of the message.
        """
        return rule == self.rule and fnmatch.fnmatchcase(message, self.message)


@dataclass(frozen=True)
class Project:
    """Content of a rules file. A threshold that is not in the file has the default value in `rules.RULES`."""

    thresholds: Mapping[str, Mapping[str, Threshold]] = field(default_factory=dict)
    silences: tuple[Silence, ...] = ()
    channels: Mapping[str, str] = field(default_factory=dict)  # name of the bus in the DBC for each channel of the log

    def threshold(self, rule: str, name: str) -> Threshold:
        """Return the threshold `name` of a rule."""
        return self.thresholds.get(rule, {}).get(name, RULE_OF[rule].thresholds[name])

    def number(self, rule: str, name: str) -> float:
        """Return a threshold that is a number, such as `limit_ms` of the rule cia402-response."""
        value = self.threshold(rule, name)
        assert isinstance(value, float)
        return value

    def text(self, rule: str, name: str) -> str:
        """Return a rule parameter that contains a name, such as the name of a signal."""
        return str(self.threshold(rule, name))

    def names(self, rule: str, name: str) -> tuple[str, ...]:
        """Return a rule parameter that contains a list of names."""
        value = self.threshold(rule, name)
        assert isinstance(value, tuple)
        return value

    def quantities(self, rule: str) -> dict[str, float]:
        """Return all numeric thresholds of a rule, by the name of the threshold."""
        found = {**RULE_OF[rule].thresholds, **self.thresholds.get(rule, {})}
        return {name: value for name, value in found.items() if isinstance(value, float)}

    def silence(self, rule: str, message: str) -> Silence | None:
        """Return the [[silence]] table that silences a rule for a message; None if the rule is not silenced."""
        return next((s for s in self.silences if s.covers(rule, message)), None)


#: Rules with one threshold for each signal name, for example for `Position`. A rules file may add signal names.
_OPEN = ("step",)
#: (rule, threshold name) -> smallest and largest valid value. All thresholds that are not listed must be at least 0.
_RANGE = {("bus-load", "window_s"): (0.001, 3600.0)}


def load_project(path: Path) -> Project:
    """Read a rules file.

    Raises:
        ProjectError: If a rule, threshold or key is unknown, a value has the wrong type, or a [[silence]] table has no
            reason.
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
        raise ProjectError(f"{path}: silence must be a list of tables, written as [[silence]], got {silences!r}")
    if not isinstance(channels, dict) or not all(isinstance(bus, str) for bus in channels.values()):
        raise ProjectError(f"{path}: [channels] must assign the name of a bus to each channel, got {channels!r}")
    return Project(
        {rule: _thresholds(path, rule, table) for rule, table in document.items()},
        tuple(_silence(path, entry) for entry in silences),
        channels,
    )


def _thresholds(path: Path, rule: str, table: Any) -> dict[str, Threshold]:
    if rule not in RULE_OF:
        raise ProjectError(f"{path}: a rule must be one of {', '.join(RULE_OF)}, got {rule!r}")
    known = RULE_OF[rule].thresholds
    if not known:
        raise ProjectError(f"{path}: {rule} has no threshold; remove the table [{rule}]")
    if not isinstance(table, dict):
        raise ProjectError(f"{path}: {rule} must be a table of thresholds, got {table!r}")
    found: dict[str, Threshold] = {}
    for name, value in table.items():
        like = known.get(name, 0.0 if rule in _OPEN else None)
        if like is None:
            raise ProjectError(
                f"{path}: the name of a threshold of {rule} must be one of {', '.join(known)}, got {name!r}"
            )
        found[name] = number = _value(f"{path}: {rule}.{name}", value, like)
        low, high = _RANGE.get((rule, name), (0.0, math.inf))
        if isinstance(number, float) and not low <= number <= high:
            raise ProjectError(f"{path}: {rule}.{name} must be from {low:g} to {high:g}, got {value!r}")
    return found


def _value(where: str, value: Any, like: Threshold) -> Threshold:
    if isinstance(like, float):
        if type(value) not in (int, float) or not math.isfinite(value) or value < 0:
            raise ProjectError(f"{where} must be a number of at least 0, got {value!r}")
        return float(value)
    if isinstance(like, tuple):
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise ProjectError(f"{where} must be a list of names, got {value!r}")
        return tuple(value)
    if not isinstance(value, str):
        raise ProjectError(f"{where} must be a name, got {value!r}")
    return value


def _silence(path: Path, entry: Any) -> Silence:
    if (
        not isinstance(entry, dict)
        or set(entry) - set(_SILENCE_KEYS)
        or not all(isinstance(v, str) for v in entry.values())
    ):
        raise ProjectError(
            f"{path}: a [[silence]] table must have only the keys {', '.join(_SILENCE_KEYS)}, each with a text, got {entry!r}"
        )
    if entry.get("rule") not in RULE_OF:
        raise ProjectError(
            f"{path}: the rule of a [[silence]] must be one of {', '.join(RULE_OF)}, got {entry.get('rule')!r}"
        )
    if not entry.get("reason", "").strip():
        raise ProjectError(
            f"{path}: the [[silence]] of {entry['rule']} must have a reason, which the report shows, got none"
        )
    return Silence(entry["rule"], entry.get("message", "*"), entry["reason"])
