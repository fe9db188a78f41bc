"""List of all rules, messages and signals that were not checked in a log, each with the reason.

If this list were missing, a report without findings would look like an approval of the whole log.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from atalante_dbc.foreign import Field, Layout
from atalante_tools.canlog.plan import UNKNOWN
from atalante_tools.canlog.validate.validator import Validator
from atalante_tools.canlog.validate.value_rules import is_enumeration, is_hash, is_limited

_E2E = ("Crc", "Counter")
_ORDER = ("sync-order", "state-late")
_DRIVES = ("cia402-transition", "cia402-response")
_MOTION = ("velocity", "quaternion-norm", "stuck", "step")


@dataclass(frozen=True)
class Unchecked:
    """Messages, signals or channels that some rules did not check, and the reason."""

    rules: tuple[str, ...]  # identifiers of the rules that did not check the items; empty means all rules
    items: tuple[str, ...]  # messages, signals or channels; empty means the whole log
    reason: str

    def __str__(self) -> str:
        rules = ", ".join(self.rules) or "all rules"
        return f"{rules}: {self.reason}" + (f" ({len(self.items)}): {', '.join(self.items)}" if self.items else "")


def unchecked(validator: Validator, *, live: bool = False) -> list[Unchecked]:
    """Return the rules, messages and signals that were not checked, each with the reason.

    Args:
        validator: finished validator of the log.
        live: whether the frames came from a live bus. Only a live bus reports how many frames were lost.
    """
    found = [
        *_of_the_log(validator, live),
        *_of_the_network(validator),
        *_of_layouts(validator),
        *_of_messages(validator),
    ]
    signals = tuple(f"{layout.name}.{name}" for layout, name in unseen_signals(validator))
    if signals:
        reason = "every raw value is allowed, so no rule checked the values of these signals"
        found.append(Unchecked((), signals, reason))
    return found


def applicable(validator: Validator, rule: str) -> set[str]:
    """Return the names of the messages in the log to which a rule applies.

    The rule wrong-bus applies to channels. For this rule, return the names of the channels of the log.

    Args:
        validator: finished validator of the log.
        rule: identifier of the rule.
    """
    if rule == "wrong-bus":
        return set(validator.channels)
    rows: set[int] = set(_seen(validator))
    if rule in _DRIVES:
        rows &= {drive.row for drives in validator.drives.drives.values() for drive in drives}
    elif rule in _MOTION:
        families = [family for family in validator.plan.families if rule in validator.motion.checked(family)]
        rows &= {row for family in families for row in family.rows}
    return {validator.plan.name(row) for row in rows}


def _seen(validator: Validator) -> list[int]:
    """Return the indices of the messages in the log, without the messages whose DBC layout is not supported."""
    return [row for row in range(len(validator.plan.layouts)) if validator.counts[row]]


def _of_the_log(validator: Validator, live: bool) -> Iterator[Unchecked]:
    frames = validator.frame_rules
    if not validator.keeps_flags:
        yield Unchecked(("frame-fdf", "frame-brs", "frame-esi"), (), "this log format does not keep CAN FD flags")
    if not validator.keeps_errors:
        yield Unchecked(("error-frame",), (), "not all bus errors of this log format are read")
    if not frames.recorder:
        reason = "the log marks no frame as sent by the recording node"
        if frames.recorder == "":
            reason = "the log marks frames of several nodes as sent, so the recording node is unknown"
        yield Unchecked(("sender",), (), reason)
    if not live:
        yield Unchecked(("dropped",), (), "a log records lost frames only if the CAN controller reported an overflow")


def _of_the_network(validator: Validator) -> Iterator[Unchecked]:
    plan = validator.plan
    mixed = tuple(
        name
        for name, bus in zip(validator.channels, validator.channel_map.bus_of_channel, strict=False)
        if bus == UNKNOWN and plan.has_buses
    )
    if not plan.has_buses:
        yield Unchecked(
            ("wrong-bus",),
            (),
            "the DBC has no attribute Bus; the channel of the first frame is taken as the bus of a message",
        )
    elif mixed:
        reason = "these channels carry messages of several buses; if that is wrong, assign them in [channels] of a rules file"
        yield Unchecked(("wrong-bus",), mixed, reason)
    if not validator.load.checked:
        yield Unchecked(("bus-load",), (), "the DBC has neither NominalBitrate nor Baudrate")
    elif validator.load.unknown_bitrate:
        reason = "frames switch to the data bit rate, but the DBC has neither DataBitrate nor BaudrateCANFD"
        yield Unchecked(("bus-load",), (), reason)
    elif not validator.load.windows:
        window = validator.project.number("bus-load", "window_s")
        yield Unchecked(("bus-load",), (), f"the log has no complete time window of {window:g} s")
    if not validator.order.buses:
        yield Unchecked(_ORDER, (), "the DBC has no cyclic message SYNC...")
    elif not any(validator.counts[bus.sync] for bus in validator.order.buses):
        yield Unchecked(_ORDER, (), "no cyclic message SYNC... is in the log")
    if not validator.drives.drives:
        yield Unchecked(_DRIVES, (), f"no message has a signal {validator.drives.state}")
    elif not applicable(validator, "cia402-transition"):
        yield Unchecked(_DRIVES, (), f"no message with a signal {validator.drives.state} is in the log")
    else:
        uncommanded = tuple(
            plan.name(drive.row)
            for drives in validator.drives.drives.values()
            for drive in drives
            if drive.command_row == UNKNOWN
        )
        if uncommanded:
            yield Unchecked(
                ("cia402-response",),
                uncommanded,
                f"no message of the DBC carries a {validator.drives.command} for the senders of these messages",
            )
    absent = tuple(rule for rule in _MOTION if not applicable(validator, rule))
    if absent:
        yield Unchecked(
            absent, (), "no signal in the log has a name that these rules use; set other names in a rules file"
        )
    if plan.refused:
        reasons = tuple(f"{m.name} ({m.reason})" for m in plan.refused)
        yield Unchecked((), reasons, "the DBC layout of these messages is not supported")


def _of_layouts(validator: Validator) -> Iterator[Unchecked]:
    """Yield the rules that need a signal or an attribute which no message in the log has."""
    seen = _seen(validator)
    layouts = [validator.plan.layouts[row] for row in seen]
    fields = [field for layout in layouts for field in layout.fields]
    signal = validator.values.hash_signal
    for rule, applies, reason in (
        ("range", any(is_limited(f) for f in fields), "no signal in the log has a limited range"),
        ("invalid-code", any(f.invalid_raw is not None for f in fields), "no signal in the log has an InvalidRaw code"),
        ("value-table", any(is_enumeration(f) for f in fields), "no signal in the log has a complete value table"),
        ("multiplexer", any(layout.multiplexers for layout in layouts), "no message in the log has a multiplexer"),
        ("inhibit", any(validator.plan.inhibit_ns[seen]), "no message in the log has GenMsgDelayTime"),
        (
            "dbc-hash",
            any(is_hash(f, signal) for f in fields),
            f"no message in the log has a signal {signal} of 32 bits",
        ),
    ):
        if seen and not applies:
            yield Unchecked((rule,), (), reason)


def _of_messages(validator: Validator) -> Iterator[Unchecked]:
    plan, counts = validator.plan, validator.counts
    seen = _seen(validator)
    for_jitter = validator.project.number("cycle-jitter", "min_intervals")
    for_mean = validator.project.number("cycle-mean", "min_intervals")
    for rules, rows, reason in (
        (("crc", "crc-data-id", "counter-repeated", "counter-lost", "counter-sequence"),
         [r for r in seen if not plan.protected[r]],
         "messages without E2EDataId, or without the signals Crc and Counter of E2E Profile 5"),
        (("cycle-mean", "cycle-jitter", "cycle-gap", "cycle-fast", "timeout", "recovered", "late-start"),
         [r for r in seen if not plan.cycle_ns[r] and r not in validator.shared],
         "messages that are not cyclic"),
        (("inhibit",),
         [r for r in seen if not plan.cycle_ns[r] and not plan.inhibit_ns[r]],
         "events without GenMsgDelayTime"),
        (("cycle-mean", "cycle-jitter", "cycle-gap", "cycle-fast", "timeout", "recovered", "late-start", "inhibit"),
         sorted(validator.shared),
         "parameter groups with several sender addresses"),
        (("cycle-jitter",),
         [r for r in seen if validator.timing.intervals[r] < for_jitter and plan.cycle_ns[r]],
         "too few intervals in the log for the 99 % quantile"),
        (("cycle-mean",),
         [r for r in seen if validator.timing.intervals[r] < for_mean and plan.cycle_ns[r]],
         "too few intervals in the log"),
    ):  # fmt: skip
        if rows:
            yield Unchecked(rules, _names(validator, rows), reason)
    for (rule, required), rows in validator.motion.too_short(counts).items():
        yield Unchecked((rule,), _names(validator, rows), f"fewer than {required} frames in the log")
    absent_rows = [row for row in range(len(plan.layouts)) if not counts[row]]
    reported = {f.message for f in validator.findings.all() if f.rule == "never-seen"}
    if unseen := [row for row in absent_rows if plan.name(row) not in reported]:
        yield Unchecked((), _names(validator, unseen), "messages of the DBC that are neither in the log nor required")


def unseen_signals(validator: Validator) -> list[tuple[Layout, str]]:
    """Return (message layout, signal) for each received signal that no rule checked."""
    plan = validator.plan
    found = []
    for family in plan.families:
        motion = {name for names in validator.motion.checked(family).values() for name in names}
        drives = {validator.drives.state} if family.rows.start in validator.drives.drives else set()
        family_layout = family.codec.layout
        checked = {f.name for f in family_layout.fields if _is_checked(validator, family_layout, f)}
        for row in family.rows:
            layout = plan.layouts[row]
            if not validator.counts[row]:
                continue
            commands = _commands(validator, row)
            covered = checked | motion | drives | commands | (set(_E2E) if plan.protected[row] else set())
            found += [(layout, f.name) for f in layout.fields if f.name not in covered]
    return found


def _is_checked(validator: Validator, layout: Layout, field: Field) -> bool:
    """Return whether a rule can reject a value of the field.

    A rule can reject a value if the field has a limited range, an invalid code or a complete value table, if the field
    contains the DBC hash, or if the field is a multiplexer with unused codes.
    """
    if is_limited(field) or is_enumeration(field) or field.invalid_raw is not None:
        return True
    if is_hash(field, validator.values.hash_signal):
        return True
    known = layout.multiplexers.get(field.name)
    return known is not None and len(known) < 1 << min(field.length, 62)


def _commands(validator: Validator, row: int) -> set[str]:
    codec = next(family.codec for family in validator.plan.families if row in family.rows)
    return {
        codec.fields[drive.command_index].name
        for drives in validator.drives.drives.values()
        for drive in drives
        if drive.command_row == row
    }


def _names(validator: Validator, rows: Sequence[int]) -> tuple[str, ...]:
    return tuple(validator.plan.name(row) for row in np.sort(np.array(rows)).tolist())
