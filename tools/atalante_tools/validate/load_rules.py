"""Bus load over time, from the wire time of every frame."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from atalante_hal.frame import FLAG_BRS, FLAG_FDF, ID_ERROR, ID_EXTENDED, ID_REMOTE, as_words
from atalante_tools.validate.buses import Homes
from atalante_tools.validate.chunk import Chunk
from atalante_tools.validate.findings import Findings
from atalante_tools.validate.plan import UNKNOWN, Plan, Rows
from atalante_tools.validate.project import Project

#: Bits of an error frame at the least: flag, delimiter, intermission.
_ERROR_BITS = 17


@cache
def wire_time(extended: bool, fd: bool, switch: bool, length: int, nominal: float, data: float) -> float:
    """Longest time [s] a frame can take on the wire, stuff bits and interframe space included (ISO 11898-1).

    Classic frames after Davis et al. 2007; CAN FD as `atalante_dbc.wire_time`, a 29-bit identifier adding 20 bits and their
    stuff bits to the arbitration phase.
    """
    if not fd:
        stuffed = (54 if extended else 34) + 8 * length
        return (stuffed + 13 + (stuffed - 1) // 4) / nominal
    arbitration = 33 + (25 if extended else 0)
    stuffed = 5 + 8 * length
    rest = stuffed + stuffed // 4 + (33 if length > 16 else 28)
    return arbitration / nominal + rest / (data if switch else nominal)


class LoadRules:
    """Adds up wire time by bus and window."""

    def __init__(self, plan: Plan, findings: Findings, project: Project, homes: Homes) -> None:
        self._plan, self._findings, self._homes = plan, findings, homes
        catalogue = plan.catalogue
        self._nominal = catalogue.nominal_bitrate or 0.0
        self._data = catalogue.data_bitrate or self._nominal
        self._window_ns = int(project.number("bus-load", "window_s") * 1e9)
        self._over, self._limit = project.number("bus-load", "over_nominal"), project.number("bus-load", "limit")
        self._of_row = np.array([self._layout_time(row) for row in range(len(plan.layouts))] + [0.0])
        self._bus_of_row = np.append(plan.bus_of_row, 0)
        self._numbers: list[npt.NDArray[np.int64]] = []  # of the windows of each chunk
        self._busy: list[npt.NDArray[np.float64]] = []  # seconds on the wire, (windows, buses)
        #: After `finish`: begin [s] of each window that has a frame, and the load of each bus as a share, shape (windows, buses).
        #: Behind the DBC's buses come the channels that are no bus.
        self.begins: npt.NDArray[np.float64] = np.zeros(0)
        self.load: npt.NDArray[np.float64] = np.zeros((0, len(plan.buses)))

    @property
    def judged(self) -> bool:
        """Whether the bit rate is known."""
        return self._nominal > 0

    def _layout_time(self, row: int) -> float:
        layout = self._plan.layouts[row]
        if not self._nominal:
            return 0.0
        fd, switch = bool(layout.fd), layout.bit_rate_switch is not False
        return wire_time(layout.extended, fd, switch, layout.length, self._nominal, self._data)

    def expected(self, bus: int) -> float | None:
        """Load that the DBC's own messages make at the most, as a share; None: it does not say how often each is sent."""
        rows = (
            np.flatnonzero(self._plan.bus_of_row == bus) if self._plan.is_ours else np.arange(len(self._plan.layouts))
        )
        period = np.where(self._plan.cycle_ns[rows] > 0, self._plan.cycle_ns[rows], self._plan.inhibit_ns[rows])
        if not len(rows) or not bool((period > 0).all()):
            return None
        return float((self._of_row[rows] / (period * 1e-9)).sum())

    def judge(self, chunk: Chunk, rows: Rows) -> None:
        """Add the frames of a chunk."""
        if not self.judged or not len(chunk):
            return
        known = (rows >= 0) & (rows < len(self._plan.layouts))
        headers = as_words(chunk.frames)[:, 0]
        at = np.where(known, rows, 0)
        seconds = self._of_row[at]
        usual = known & (headers == self._plan.headers[rows])
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

    def _time_unusual(self, chunk: Chunk, places: npt.NDArray[np.intp], seconds: npt.NDArray[np.float64]) -> None:
        frames = chunk.frames[places]
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
            seconds[places[key == value]] = time

    def _bus(self, chunk: Chunk, known: npt.NDArray[np.bool_], rows: npt.NDArray[np.int16]) -> npt.NDArray[np.int64]:
        """Bus of each frame: its channel's, or on a channel with a mixture its message's."""
        buses = len(self._plan.buses)
        of_channel = np.array(self._homes.bus_of_channel, np.int64)
        mixed = np.arange(len(of_channel)) + buses
        fixed = np.where(of_channel == UNKNOWN, mixed, of_channel)[chunk.channels]
        if not self._plan.is_ours or not bool((of_channel == UNKNOWN).any()):
            return fixed
        by_message = known & (of_channel[chunk.channels] == UNKNOWN)
        return np.where(by_message, self._bus_of_row[rows], fixed)

    def names(self, channels: list[str]) -> list[str]:
        """Name of each column of `load`."""
        return [*self._plan.buses, *channels][: self.load.shape[1]]

    def finish(self, channels: list[str]) -> None:
        """Judge the whole log. Its first and its last window are not full and are left out."""
        if not self._numbers:
            return
        width = max(busy.shape[1] for busy in self._busy)
        numbers, places = np.unique(np.concatenate(self._numbers), return_inverse=True)
        busy: npt.NDArray[np.float64] = np.zeros((len(numbers), width))
        np.add.at(busy, places, np.concatenate([np.pad(b, ((0, 0), (0, width - b.shape[1]))) for b in self._busy]))
        window_s = self._window_ns * 1e-9
        self.begins = numbers.astype(np.float64) * window_s
        self.load = np.divide(busy, window_s, out=busy)
        for bus, name in enumerate(self.names(channels)):
            expected = self.expected(bus) if bus < len(self._plan.buses) or not self._plan.is_ours else None
            limit = self._limit if expected is None else self._over * expected
            over = np.flatnonzero(self.load[1:-1, bus] > limit) + 1
            if len(over):
                self._findings.add(
                    "bus-load", name, numbers[over] * self._window_ns, shown=100.0 * self.load[over, bus]
                )
