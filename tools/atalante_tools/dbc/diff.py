"""Comparison of two versions of a DBC file.

A change is breaking if a node with the old version and a node with the new version cannot communicate. The criterion is
the behaviour of the receivers in this project: they reject frames with a wrong length, a wrong Data ID or a value out
of range, and they report a message as late after the timeout of the message.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from atalante_dbc import Message, Network, Signal


@dataclass(frozen=True)
class Change:
    """One difference between two DBC files. `subject` is the changed property; `where` names the message, signal or node."""

    breaking: bool
    subject: str
    where: str
    text: str


def changes(old: Network, new: Network) -> list[Change]:
    """Return all differences between two networks, in the order of the network `new`; removed items come last."""
    return [*_network(old, new), *_messages(old, new)]


def _network(old: Network, new: Network) -> Iterator[Change]:
    if old.hash32 != new.hash32:
        text = f"{old.hash32:#010x} -> {new.hash32:#010x}: a HAL stays in OFF until every node reports the new hash"
        yield Change(False, "hash", "network", text)
    for rate, before, after in (
        ("nominal bit rate", old.nominal_bitrate, new.nominal_bitrate),
        ("data bit rate", old.data_bitrate, new.data_bitrate),
    ):
        if before != after:
            yield Change(True, "bit rate", "network", f"{rate} {before} -> {after} bit/s")
    was, now = ({node.name: node for node in network.nodes} for network in (old, new))
    for name, node in now.items():
        known = was.get(name)
        if known is None:
            yield Change(False, "node", name, f"new node of kind {node.kind}")
        elif known != node:
            yield Change(False, "node", name, f"{known.kind} {known.number} -> {node.kind} {node.number}")
    for name in was.keys() - now.keys():
        yield Change(False, "node", name, "node removed")


def _messages(old: Network, new: Network) -> Iterator[Change]:
    was, now = ({m.name: m for m in network.messages} for network in (old, new))
    # A message with another name, but the same identifier and Data ID, is a renamed message.
    lost = {(m.frame_id, m.data_id): m for name, m in was.items() if name not in now}
    for name, message in now.items():
        before = was.get(name)
        if before is None:
            before = lost.pop((message.frame_id, message.data_id), None)
            if before is None:
                yield Change(False, "message", name, f"new message {message.frame_id:#x} from {message.sender}")
                continue
            yield Change(False, "name", name, f"renamed from {before.name}; identifier and Data ID are unchanged")
        yield from _message(before, message)
    for message in lost.values():
        yield Change(True, "message", message.name, f"message {message.frame_id:#x} removed")


def _message(old: Message, new: Message) -> Iterator[Change]:
    def breaking(subject: str, text: str) -> Change:
        return Change(True, subject, new.name, text)

    if old.frame_id != new.frame_id:
        yield breaking("id", f"identifier {old.frame_id:#x} -> {new.frame_id:#x}")
    if old.length != new.length:
        yield breaking("length", f"{old.length} -> {new.length} bytes; receivers accept only the exact length")
    if old.data_id != new.data_id:
        yield breaking("data id", f"E2E Data ID {old.data_id:#06x} -> {new.data_id:#06x}: every CRC check fails")
    if old.sender != new.sender:
        yield breaking(
            "sender", f"sender {old.sender} -> {new.sender}: with mixed versions both nodes send, or neither"
        )
    if old.bus != new.bus:
        yield breaking("bus", f"bus {old.bus} -> {new.bus}")
    yield from _timing(old, new)
    yield from _signals(old, new)


def _timing(old: Message, new: Message) -> Iterator[Change]:
    if old.send_type != new.send_type:
        yield Change(True, "timing", new.name, f"{old.send_type} -> {new.send_type}")
    elif old.cycle_ms != new.cycle_ms:
        yield Change(True, "timing", new.name, f"cycle {old.cycle_ms} -> {new.cycle_ms} ms")
    if old.timeout_ms != new.timeout_ms:
        # A changed timeout prevents communication only if the timeout in one DBC is at most the cycle time in the other DBC.
        # Example: with a timeout of 5 ms and a cycle time of 10 ms, the receiver times out before the next frame.
        breaks = 0 < old.timeout_ms <= new.cycle_ms or 0 < new.timeout_ms <= old.cycle_ms
        yield Change(breaks, "timing", new.name, f"timeout {old.timeout_ms} -> {new.timeout_ms} ms")
    if old.inhibit_ms != new.inhibit_ms:
        yield Change(False, "timing", new.name, f"inhibit time {old.inhibit_ms} -> {new.inhibit_ms} ms")


def _signals(old: Message, new: Message) -> Iterator[Change]:
    was, now = ({s.name: s for s in message.signals} for message in (old, new))
    # A signal with another name, but the same bits, is a renamed signal.
    lost = {(s.start, s.length): s for name, s in was.items() if name not in now}
    for name, signal in now.items():
        where = f"{new.name}.{name}"
        before = was.get(name)
        if before is None:
            before = lost.get((signal.start, signal.length))
            if before is None:
                yield _new_signal(old, signal, where)
                continue
            del lost[signal.start, signal.length]
            yield Change(False, "name", where, f"renamed from {before.name}; the bits are unchanged")
        yield from _signal(before, signal, where)
    for signal in lost.values():
        text = f"signal removed; bits {signal.start} to {signal.start + signal.length - 1} are now 0"
        yield Change(True, "signal", f"{new.name}.{signal.name}", text)


def _new_signal(old: Message, signal: Signal, where: str) -> Change:
    bits = set(range(signal.start, signal.start + signal.length))
    taken = [s.name for s in old.signals if bits & set(range(s.start, s.start + s.length))]
    if taken:
        return Change(True, "signal", where, f"new signal in bits of {', '.join(taken)}")
    if signal.start + signal.length > 8 * old.length:
        return Change(True, "signal", where, "new signal after the old end of the message")
    zero = signal.minimum <= signal.offset <= signal.maximum
    text = f"new signal in reserved bits; an old sender sends {signal.offset:g} {signal.unit}"
    return Change(not zero, "signal", where, text if zero else f"{text}, which is out of range")


def _signal(old: Signal, new: Signal, where: str) -> Iterator[Change]:
    def layout(s: Signal) -> str:
        return f"{s.start}|{s.length}@1{'-' if s.signed else '+'}"

    if layout(old) != layout(new):
        yield Change(True, "layout", where, f"{layout(old)} -> {layout(new)}")
    if (old.factor, old.offset) != (new.factor, new.offset):
        yield Change(
            True,
            "scaling",
            where,
            f"({old.factor!r},{old.offset:g}) -> ({new.factor!r},{new.offset:g}) [factor,offset]",
        )
    if old.unit != new.unit:
        yield Change(True, "unit", where, f"{old.unit} -> {new.unit}")
    if (old.minimum, old.maximum) != (new.minimum, new.maximum):
        text = f"[{old.minimum:.10g}|{old.maximum:.10g}] -> [{new.minimum:.10g}|{new.maximum:.10g}]"
        wider = new.minimum < old.minimum or new.maximum > old.maximum
        narrower = new.minimum > old.minimum or new.maximum < old.maximum
        rejecting = [version for version, rejects in (("an old", wider), ("a new", narrower)) if rejects]
        yield Change(
            True, "range", where, f"{text}; {' and '.join(rejecting)} receiver rejects values out of its range"
        )
    if old.invalid_raw != new.invalid_raw:
        code = [f"{raw:#x}" if raw is not None else "none" for raw in (old.invalid_raw, new.invalid_raw)]
        yield Change(True, "invalid code", where, f"{code[0]} -> {code[1]}")
    yield from _values(old, new, where)
    if old.receivers != new.receivers:
        text = f"receivers {' '.join(old.receivers)} -> {' '.join(new.receivers)}"
        yield Change(False, "receivers", where, text)


def _values(old: Signal, new: Signal, where: str) -> Iterator[Change]:
    for raw in sorted(old.choices.keys() | new.choices.keys()):
        before, after = old.choices.get(raw), new.choices.get(raw)
        if before == after:
            continue
        if before is None:
            yield Change(False, "value", where, f"{raw} is now {after}")
        elif after is None:
            yield Change(True, "value", where, f"{raw} no longer means {before}")
        else:
            yield Change(True, "value", where, f"{raw} meant {before} and now means {after}")
