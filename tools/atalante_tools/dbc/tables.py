"""Tables of a network: messages, signals, and the bus load of each message."""

from __future__ import annotations

from atalante_dbc import Network, wire_time

Row = dict[str, object]


def message_rows(network: Network) -> list[Row]:
    """Return one row per message, in the order of the DBC file."""
    return [
        {
            "id": f"{m.frame_id:#05x}",
            "name": m.name,
            "sender": m.sender,
            "receivers": m.receivers,
            "bus": m.bus,
            "cycle_ms": m.cycle_ms or None,
            "inhibit_ms": m.inhibit_ms or None,
            "timeout_ms": m.timeout_ms or None,
            "bytes": m.length,
            "data_id": f"{m.data_id:#06x}",
        }
        for m in network.messages
    ]


def signal_rows(network: Network) -> list[Row]:
    """Return one row per signal, in the order of the DBC file."""
    return [
        {
            "message": m.name,
            "signal": s.name,
            "start": s.start,
            "bits": s.length,
            "signed": "yes" if s.signed else "no",
            "factor": s.factor,
            "offset": s.offset,
            "min": s.minimum,
            "max": s.maximum,
            "unit": s.unit,
            "invalid": None if s.invalid_raw is None else f"{s.invalid_raw:#x}",
            "values": [f"{raw}={name}" for raw, name in sorted(s.choices.items())],
        }
        for m in network.messages
        for s in m.signals
    ]


def load_rows(network: Network, bus: str) -> list[Row]:
    """Return one row per message with its worst-case bus load. The message with the largest load comes first.

    The period of a cyclic message is its cycle time. The shortest period of an event message is its inhibit time.

    Args:
        network: network with the bus.
        bus: name of the bus.
    """
    rows: list[tuple[float, Row]] = []
    for m in network.messages:
        if m.bus == bus:
            period_ms = m.cycle_ms or m.inhibit_ms
            time = wire_time(m.length, network.nominal_bitrate, network.data_bitrate)
            percent = 100.0 * time / (period_ms * 1e-3)
            row: Row = {"name": m.name, "bytes": m.length, "us": time * 1e6, "every_ms": period_ms, "percent": percent}
            rows.append((percent, row))
    return [row for _, row in sorted(rows, key=lambda entry: -entry[0])]
