"""What no rule looked at, and why. A firmware engineer must never take silence for approval."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from atalante_dbc.foreign import Field, Layout
from atalante_tools.validate.judge import Judge
from atalante_tools.validate.plan import UNKNOWN
from atalante_tools.validate.value_rules import is_enumeration, is_hash, is_limited

_E2E = ("Crc", "Counter")


@dataclass(frozen=True)
class Unjudged:
    """Rules that did not look at some things."""

    rules: tuple[str, ...]
    what: tuple[str, ...]  # messages, signals, identifiers, channels; empty: the whole log
    why: str

    def __str__(self) -> str:
        rules = ", ".join(self.rules) or "no rule"
        return f"{rules}: {self.why}" + (f" ({len(self.what)}): {', '.join(self.what)}" if self.what else "")


def unjudged(judge: Judge, *, live: bool = False) -> list[Unjudged]:
    """Everything that was not judged in a log that is finished."""
    found = [*_of_the_log(judge, live), *_of_the_network(judge), *_of_messages(judge)]
    signals = tuple(f"{layout.name}.{name}" for layout, name in unseen_signals(judge))
    if signals:
        why = "every raw value is allowed, so no rule looked at the values of these signals"
        found.append(Unjudged((), signals, why))
    return found


def _of_the_log(judge: Judge, live: bool) -> Iterator[Unjudged]:
    frames = judge.frame_rules
    if not judge.keeps_flags:
        yield Unjudged(("frame-fdf", "frame-brs", "frame-esi"), (), "this log format does not keep CAN FD flags")
    if not frames.recorder:
        why = "no frame of the log is marked as sent by the node that recorded it"
        if frames.recorder == "":
            why = "frames of several nodes are marked as sent: the log was recorded on a computer that plays them"
        yield Unjudged(("sender",), (), why)
    if not live:
        yield Unjudged(("dropped",), (), "a log tells of lost frames only where the controller reported an overflow")


def _of_the_network(judge: Judge) -> Iterator[Unjudged]:
    plan = judge.plan
    mixed = tuple(
        name
        for name, bus in zip(judge.channels, judge.homes.bus_of_channel, strict=False)
        if bus == UNKNOWN and plan.is_ours
    )
    if not plan.is_ours:
        yield Unjudged(("wrong-bus",), (), "the DBC has no attribute Bus; a message is at home where it came first")
    elif mixed:
        why = "these channels carry several buses; name them in [channels] of a rules file if that is wrong"
        yield Unjudged(("wrong-bus",), mixed, why)
    if not judge.load.judged:
        yield Unjudged(("bus-load",), (), "the DBC has neither NominalBitrate nor Baudrate")
    if not judge.order.buses:
        yield Unjudged(("sync-order", "state-late"), (), "the DBC has no cyclic message SYNC...")
    if not judge.drives.drives:
        yield Unjudged(("cia402-transition", "cia402-response"), (), f"no message has a signal {judge.drives.state}")
    else:
        deaf = tuple(
            plan.name(drive.row)
            for drives in judge.drives.drives.values()
            for drive in drives
            if drive.command_row == UNKNOWN
        )
        if deaf:
            yield Unjudged(("cia402-response",), deaf, f"the sender of these receives no {judge.drives.command}")
    looked = {rule for family in plan.families for rule in judge.motion.judged(family)}
    absent = tuple(rule for rule in ("velocity", "quaternion-norm", "stuck", "step") if rule not in looked)
    if absent:
        yield Unjudged(absent, (), "no signal has the names these rules look for; a rules file may name others")
    if plan.refused:
        reasons = tuple(f"{m.name} ({m.reason})" for m in plan.refused)
        yield Unjudged((), reasons, "messages whose DBC layout is not supported")


def _of_messages(judge: Judge) -> Iterator[Unjudged]:
    plan, counts = judge.plan, judge.counts
    seen = [row for row in range(len(plan.layouts)) if counts[row]]
    for rules, rows, why in (
        (("crc", "crc-data-id", "counter-repeated", "counter-lost", "counter-sequence"),
         [r for r in seen if not plan.protected[r]],
         "messages without E2EDataId and the Crc and Counter of E2E Profile 5"),
        (("cycle-mean", "cycle-jitter", "cycle-gap", "cycle-fast", "timeout", "recovered"),
         [r for r in seen if not plan.cycle_ns[r] and r not in judge.shared],
         "messages that are not sent in a cycle"),
        (("inhibit",),
         [r for r in seen if not plan.cycle_ns[r] and not plan.inhibit_ns[r]],
         "events without GenMsgDelayTime"),
        (("cycle-mean", "cycle-jitter", "cycle-gap", "cycle-fast", "timeout", "recovered", "inhibit"),
         sorted(judge.shared),
         "parameter groups that several addresses send"),
        (("cycle-jitter",),
         [r for r in seen if 0 < judge.timing.intervals[r] < judge.project.number("cycle-jitter", "min_intervals")
          and plan.cycle_ns[r]],
         "too few intervals in the log to speak of 99 %"),
        (("cycle-mean",),
         [r for r in seen if judge.timing.intervals[r] < judge.project.number("cycle-mean", "min_intervals")
          and plan.cycle_ns[r]],
         "too few intervals in the log"),
    ):  # fmt: skip
        if rows:
            yield Unjudged(rules, _names(judge, rows), why)
    silent = [row for row in range(len(plan.layouts)) if not counts[row]]
    accused = {f.message for f in judge.findings.all() if f.rule == "never-seen"}
    if left := [row for row in silent if plan.name(row) not in accused]:
        yield Unjudged((), _names(judge, left), "messages of the DBC that are not in the log, and need not be")


def unseen_signals(judge: Judge) -> list[tuple[Layout, str]]:
    """Signals of messages in the log whose values no rule looked at: anything they say is taken for good."""
    plan = judge.plan
    found = []
    for family in plan.families:
        motion = {name for names in judge.motion.judged(family).values() for name in names}
        drives = {judge.drives.state} if family.rows.start in judge.drives.drives else set()
        for row in family.rows:
            layout = plan.layouts[row]
            if not judge.counts[row]:
                continue
            commands = _commands(judge, row)
            covered = motion | drives | commands | (set(_E2E) if plan.protected[row] else set())
            found += [
                (layout, f.name) for f in layout.fields if f.name not in covered and not _is_judged(judge, layout, f)
            ]
    return found


def _is_judged(judge: Judge, layout: Layout, field: Field) -> bool:
    """Whether range, invalid code, value table, hash or multiplexer can find anything in it."""
    if is_limited(field) or is_enumeration(field) or field.invalid_raw is not None:
        return True
    if is_hash(field, judge.values.hash_signal):
        return True
    known = layout.multiplexers.get(field.name)
    return known is not None and len(known) < 1 << min(field.length, 62)


def _commands(judge: Judge, row: int) -> set[str]:
    codec = next(family.codec for family in judge.plan.families if row in family.rows)
    return {
        codec.fields[drive.command_place].name
        for drives in judge.drives.drives.values()
        for drive in drives
        if drive.command_row == row
    }


def _names(judge: Judge, rows: Sequence[int]) -> tuple[str, ...]:
    return tuple(judge.plan.name(row) for row in np.sort(np.array(rows)).tolist())
