"""Which interface carries which of the robot's buses: the command line's `-c`, as text, as a map, as open buses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from atalante_hal.bus import Bus, BusError, open_bus


class ChannelMapError(ValueError):
    """The channel map is not one; the message says what one looks like."""


def parse_channel_map(text: str, buses: Sequence[str]) -> dict[str, str]:
    """Channel of each bus, in the order of `buses`.

    `vcan0` puts all buses on one channel; `left_leg=can0,right_leg=can1,...` names one for each. Raises
    `ChannelMapError`.
    """
    example = ",".join(f"{bus}=can{index}" for index, bus in enumerate(buses))
    entries = [entry.strip() for entry in text.split(",")]
    if "" in entries:
        raise ChannelMapError(
            f"channel map {text!r} has an empty entry; write one channel for all (vcan0) or {example}"
        )
    if "=" not in text:
        if len(entries) > 1:
            raise ChannelMapError(f"channel map {text!r} does not say which bus is on which channel; write {example}")
        return dict.fromkeys(buses, entries[0])
    channels: dict[str, str] = {}
    for entry in entries:
        bus, equals, channel = (part.strip() for part in entry.partition("="))
        if not equals or not bus or not channel:
            raise ChannelMapError(f"{entry!r} in the channel map is not BUS=CHANNEL; write {example}")
        if bus not in buses:
            raise ChannelMapError(f"there is no bus {bus!r}; the buses are {', '.join(buses)}")
        if bus in channels:
            raise ChannelMapError(f"the channel map names {bus} twice: {channels[bus]} and {channel}")
        channels[bus] = channel
    missing = [bus for bus in buses if bus not in channels]
    if missing:
        raise ChannelMapError(f"the channel map gives no channel for {', '.join(missing)}; write {example}")
    return {bus: channels[bus] for bus in buses}


def open_channels(interface: str, channels: Mapping[str, str], **options: Any) -> dict[str, Bus]:
    """The open bus of each of the robot's buses; those that share a channel share one `Bus` object.

    Raises `BusAbsent`, after closing what was already open.
    """
    opened: dict[str, Bus] = {}
    try:
        for channel in channels.values():
            if channel not in opened:
                opened[channel] = open_bus(interface, channel, **options)
    except BusError:
        for bus in opened.values():
            bus.close()
        raise
    return {name: opened[channel] for name, channel in channels.items()}
