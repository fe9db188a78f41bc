"""Rule for the bus load, computed from the wire time of every frame."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_ERROR, ID_EXTENDED, ID_REMOTE
from atalante_tools.canlog.plan import UNKNOWN, Plan, Rows
from atalante_tools.canlog.reader.chunk import Chunk
from atalante_tools.canlog.validate.buses import ChannelMap
from atalante_tools.canlog.validate.findings import Findings
from atalante_tools.canlog.validate.project import Project

#: Minimum length of an error frame [bit], including the error delimiter and the pause before the next frame.
_ERROR_BITS = 17


@cache
def wire_time(extended: bool, fd: bool, switch: bool, length: int, nominal: float, data: float) -> float:
    """Return the worst-case time of a frame on the wire [s], with stuff bits and interframe space (ISO 11898-1).

    Classic CAN follows Davis et al. 2007. CAN FD follows `atalante_dbc.wire_time`. A 29-bit identifier adds 20 bits
    plus stuff bits to the arbitration phase.

    Args:
        extended: whether the identifier has 29 bits.
        fd: whether the frame is CAN FD.
        switch: whether the data phase uses the data bit rate.
        length: payload length [bytes].
        nominal: nominal bit rate, bit/s.
        data: bit rate of the data phase, bit/s.
    """
    if not fd:
        stuffed = (54 if extended else 34) + 8 * length
        return (stuffed + 13 + (stuffed - 1) // 4) / nominal
    arbitration = 33 + (25 if extended else 0)
    stuffed = 5 + 8 * length
    rest = stuffed + stuffed // 4 + (33 if length > 16 else 28)
    return arbitration / nominal + rest / (data if switch else nominal)


class LoadRules:
    """Rule for the bus load: the total wire time of the frames in a time window, divided by the length of the window."""

    def __init__(
        self, plan: Plan, findings: Findings, project: Project, channel_map: ChannelMap, *, keeps_flags: bool
    ) -> None:
        self._plan, self._findings, self._channel_map, self._keeps_flags = plan, findings, channel_map, keeps_flags
        catalogue = plan.catalogue
        self._nominal = catalogue.nominal_bitrate or 0.0
        self._data = catalogue.data_bitrate or self._nominal
        #: Whether a frame switched to a data bit rate that the DBC does not define. Then the bus load is unknown.
        self.unknown_bitrate = False
        self._window_ns = int(project.number("bus-load", "window_s") * 1e9)
        self._over, self._limit = project.number("bus-load", "over_nominal"), project.number("bus-load", "limit")
        self._of_row = np.array([self._layout_time(row) for row in range(len(plan.layouts))] + [0.0])
        self._bus_of_row = np.append(plan.bus_of_row, 0)
        #: For each chunk: indices of the time windows that contain frames, shape (windows,).
        #: The index of a time window is its start time divided by the window length.
        self._numbers: list[npt.NDArray[np.int64]] = []
        #: For each chunk: sum of the wire times of the frames [s] per time window and column of `load`, shape (windows, columns).
        self._busy: list[npt.NDArray[np.float64]] = []
        #: Start time of each time window with at least one frame [s], set by `finish`. Shape (windows,).
        self.begins: npt.NDArray[np.float64] = np.zeros(0)
        #: Bus load in each time window, set by `finish`; 1.0 if frames fill the whole window. Shape (windows, columns).
        #: The first columns are the buses of the DBC. The other columns are the log channels, for frames with an unknown bus.
        self.load: npt.NDArray[np.float64] = np.zeros((0, len(plan.buses)))

    @property
    def checked(self) -> bool:
        """Return whether the bus load is checked. The check needs a bit rate in the DBC."""
        return self._nominal > 0

    @property
    def windows(self) -> int:
        """Return the number of time windows that `finish` checks.

        The first and the last time window are not checked, because the log may cover only a part of them.
        """
        return max(0, len(self.load) - 2)

    def _layout_time(self, row: int) -> float:
        layout = self._plan.layouts[row]
        if not self._nominal:
            return 0.0
        fd, switch = bool(layout.fd), layout.bit_rate_switch is not False
        return wire_time(layout.extended, fd, switch, layout.length, self._nominal, self._data)

    def expected(self, bus: int) -> float | None:
        """Return the largest bus load that the DBC allows. A load of 1.0 means frames without a pause.

        A cyclic message is sent once per cycle time. Any other message is sent at most once per inhibit time.

        Args:
            bus: index of the bus in the plan.

        Returns:
            The load, or None if it cannot be computed: the DBC has no message on this bus, or a message on this bus has
            neither cycle time nor inhibit time.
        """
        rows = (
            np.flatnonzero(self._plan.bus_of_row == bus) if self._plan.has_buses else np.arange(len(self._plan.layouts))
        )
        period = np.where(self._plan.cycle_ns[rows] > 0, self._plan.cycle_ns[rows], self._plan.inhibit_ns[rows])
        if not len(rows) or not bool((period > 0).all()):
            return None
        return float((self._of_row[rows] / (period * 1e-9)).sum())

    def check(self, chunk: Chunk, rows: Rows) -> None:
        """Sum the wire times of the frames in a chunk, for each bus and time window. `finish` checks the sums.

        Args:
            chunk: n frames of the log.
            rows: index of the message of each frame in the plan, shape (n,).
        """
        if not self.checked or not len(chunk):
            return
        if self._plan.catalogue.data_bitrate is None and bool((chunk.frames["flags"] & FLAG_BRS).any()):
            self.unknown_bitrate = True
        known = (rows >= 0) & (rows < len(self._plan.layouts))
        at = np.where(known, rows, 0)
        seconds = self._of_row[at]
        if self._keeps_flags:
            usual = known & (chunk.headers == self._plan.headers[rows])
        else:  # the log does not show which frames are CAN FD, so the DBC gives the wire time of a known message
            usual = known & ((chunk.can_ids & np.uint32(ID_REMOTE)) == 0)
        if not bool(usual.all()):
            self._time_unusual(chunk, np.flatnonzero(~usual), seconds)
        bus = self._bus(chunk, known, at)
        window = chunk.stamps // self._window_ns
        begins = np.flatnonzero(np.diff(window, prepend=window[0] - 1))
        number = np.repeat(np.arange(len(begins)), np.diff(begins, append=len(chunk)))
        width = max(len(self._plan.buses), int(bus.max()) + 1)
        busy: npt.NDArray[np.float64] = (
            np.bincount(number * width + bus, weights=seconds, minlength=len(begins) * width)
            .astype(np.float64)
            .reshape(-1, width)
        )
        self._numbers.append(window[begins])
        self._busy.append(busy)

    def _time_unusual(self, chunk: Chunk, indices: npt.NDArray[np.intp], seconds: npt.NDArray[np.float64]) -> None:
        frames = chunk.frames[indices]
        key = (
            frames["can_id"].astype(np.int64) & (ID_EXTENDED | ID_ERROR | ID_REMOTE)
            | frames["flags"].astype(np.int64) << 8
        )
        key |= frames["len"]
        for value in np.unique(key).tolist():
            flags, length = value >> 8 & 0xFF, value & 0xFF
            if value & ID_ERROR:
                time = _ERROR_BITS / self._nominal
            else:
                fd, switch = bool(flags & FLAG_FDF), bool(flags & FLAG_BRS)
                payload = 0 if value & ID_REMOTE else length
                time = wire_time(bool(value & ID_EXTENDED), fd, switch, payload, self._nominal, self._data)
            seconds[indices[key == value]] = time

    def _bus(self, chunk: Chunk, known: npt.NDArray[np.bool_], rows: npt.NDArray[np.int16]) -> npt.NDArray[np.int64]:
        """Return the column of `load` to which each frame belongs. Shape (n,).

        A frame on a channel with a bus belongs to the column of this bus. A frame on a channel without a bus belongs to
        the column of the bus of its message, or to the column of the channel if the bus of the message is unknown.
        """
        buses = len(self._plan.buses)
        of_channel = np.array(self._channel_map.bus_of_channel, np.int64)
        mixed = np.arange(len(of_channel)) + buses
        fixed = np.where(of_channel == UNKNOWN, mixed, of_channel)[chunk.channels]
        if not self._plan.has_buses or not bool((of_channel == UNKNOWN).any()):
            return fixed
        by_message = known & (of_channel[chunk.channels] == UNKNOWN)
        return np.where(by_message, self._bus_of_row[rows], fixed)

    def names(self, channels: list[str]) -> list[str]:
        """Return the name of each column of `load`.

        Args:
            channels: names of the channels of the log.
        """
        return [*self._plan.buses, *channels][: self.load.shape[1]]

    def finish(self, channels: list[str]) -> None:
        """Check the bus load in every time window, except in the incomplete first and last windows.

        Args:
            channels: names of the channels of the log.
        """
        if not self._numbers or self.unknown_bitrate:
            return
        width = max(busy.shape[1] for busy in self._busy)
        numbers, indices = np.unique(np.concatenate(self._numbers), return_inverse=True)
        busy: npt.NDArray[np.float64] = np.zeros((len(numbers), width))
        np.add.at(busy, indices, np.concatenate([np.pad(b, ((0, 0), (0, width - b.shape[1]))) for b in self._busy]))
        window_s = self._window_ns * 1e-9
        self.begins = numbers.astype(np.float64) * window_s
        self.load = np.divide(busy, window_s, out=busy)
        for bus, name in enumerate(self.names(channels)):
            expected = self.expected(bus) if bus < len(self._plan.buses) or not self._plan.has_buses else None
            limit = self._limit if expected is None else self._over * expected
            over = np.flatnonzero(self.load[1:-1, bus] > limit) + 1
            if len(over):
                self._findings.add(
                    "bus-load", name, numbers[over] * self._window_ns, shown=100.0 * self.load[over, bus]
                )
