"""Assignment of the robot's buses to CAN channels, as given with the option `-c`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from atalante_hal.bus import Bus, BusError, open_bus


class ChannelMapError(ValueError):
    """Error in the text of a channel map; the message states what is expected."""


def parse_channel_map(text: str, buses: Sequence[str]) -> dict[str, str]:
    """Parse the text of a channel map.

    Args:
        text: One channel for all buses, such as `vcan0`, or a channel for each bus, such as `left_leg=can0,right_leg=can1,...`.
        buses: Names of the robot's buses.

    Returns:
        Channel of each bus, in the order of `buses`.

    Raises:
        ChannelMapError: If the text is not valid or does not assign every bus exactly once.
    """
    example = ",".join(f"{bus}=can{index}" for index, bus in enumerate(buses))
    entries = [entry.strip() for entry in text.split(",")]
    if "" in entries:
        raise ChannelMapError(
            f"channel map {text!r} has an empty entry; write one channel for all (vcan0) or {example}"
        )
    if "=" not in text:
        if len(entries) > 1:
            raise ChannelMapError(
                f"a channel map with several channels must name the bus of each channel, got {text!r}; write {example}"
            )
        return dict.fromkeys(buses, entries[0])
    channels: dict[str, str] = {}
    for entry in entries:
        bus, equals, channel = (part.strip() for part in entry.partition("="))
        if not equals or not bus or not channel:
            raise ChannelMapError(f"an entry of the channel map must be BUS=CHANNEL, got {entry!r}; write {example}")
        if bus not in buses:
            raise ChannelMapError(f"a bus of the channel map must be one of {', '.join(buses)}, got {bus!r}")
        if bus in channels:
            raise ChannelMapError(
                f"the channel map must assign {bus} once, got it twice: {channels[bus]} and {channel}"
            )
        channels[bus] = channel
    missing = [bus for bus in buses if bus not in channels]
    if missing:
        raise ChannelMapError(f"the channel map has no channel for {', '.join(missing)}; write {example}")
    return {bus: channels[bus] for bus in buses}


def open_channels(interface: str, channels: Mapping[str, str], **options: Any) -> dict[str, Bus]:
    """Open the channels of the robot's buses.

    Args:
        interface: Name of the CAN interface, see `open_bus`.
        channels: Channel of each bus.
        **options: Keyword arguments of `open_bus`.

    Returns:
        Open bus of each of the robot's buses. Buses on the same channel share one `Bus` object.

    Raises:
        BusAbsent: If a channel cannot be opened. The channels that are already open are closed.
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
