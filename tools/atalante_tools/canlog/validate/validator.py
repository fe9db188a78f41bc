"""Validator of one log. It checks each chunk of frames, and at the end applies the rules about the whole log.

chunk -> headers (frame_rules) -> sort by message (stream) -> CRC, counters, time -> payloads by family -> values, motion, drives
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import ID_MASK
from atalante_tools.canlog.plan import Plan, Rows
from atalante_tools.canlog.reader.chunk import Chunk
from atalante_tools.canlog.reader.log_file import Remark
from atalante_tools.canlog.stream import Stream, sort
from atalante_tools.canlog.validate.buses import ChannelMap
from atalante_tools.canlog.validate.drive_rules import DriveRules
from atalante_tools.canlog.validate.e2e_rules import Counters, CrcRules, Steps
from atalante_tools.canlog.validate.findings import Findings
from atalante_tools.canlog.validate.frame_rules import FrameRules, Sorted
from atalante_tools.canlog.validate.load_rules import LoadRules
from atalante_tools.canlog.validate.motion_rules import MotionRules
from atalante_tools.canlog.validate.order_rules import OrderRules
from atalante_tools.canlog.validate.project import Project
from atalante_tools.canlog.validate.timing_rules import TimingRules
from atalante_tools.canlog.validate.value_rules import Decoded, ValueRules


class Validator:
    """Validator of one log against one DBC. The list of findings is complete after `finish`."""

    def __init__(
        self,
        plan: Plan,
        project: Project | None = None,
        *,
        node: str | None = None,
        keeps_flags: bool = True,
        keeps_errors: bool = True,
    ) -> None:
        """Create a validator for a new log.

        Args:
            plan: compiled DBC, which several validators may share.
            project: thresholds, silenced rules and channel names; None means the default thresholds.
            node: report missing messages of this node only; None means all nodes.
            keeps_flags: whether the log format records the flags of CAN FD frames.
            keeps_errors: whether all bus errors in the log are read.
        """
        self.project = project or Project()
        self.plan = plan
        self.node = node
        self.findings = Findings(self.plan)
        self.channel_map = ChannelMap(self.plan, self.project.channels)
        self.frame_rules = FrameRules(self.plan, self.findings, self.channel_map, keeps_flags=keeps_flags)
        self.keeps_flags, self.keeps_errors = keeps_flags, keeps_errors
        self._crc = CrcRules(self.plan, self.findings)
        self._counters = Counters(self.plan)
        self.timing = TimingRules(self.plan, self.findings, self.project)
        self.order = OrderRules(self.plan, self.findings, self.project)
        self.load = LoadRules(self.plan, self.findings, self.project, self.channel_map, keeps_flags=keeps_flags)
        self.values = ValueRules(self.plan, self.findings, self.project)
        self.motion = MotionRules(self.plan, self.findings, self.project)
        self.drives = DriveRules(self.plan, self.findings, self.project)
        self._family_of = {row: family for family in self.plan.families for row in family.rows}
        #: Number of rejected frames since the last valid frame, for each message.
        self._pending = np.zeros(len(self.plan.layouts), np.int64)
        self._groups = [row for row, m in enumerate(self.plan.layouts) if m.pgn_mask != ID_MASK]
        self._address: dict[int, int] = {}
        #: Indices of the J1939 messages that the timing rules do not check, because several sender addresses send them.
        self.shared: set[int] = set()
        self.frames = 0
        self.counts = np.zeros(len(self.plan.layouts) + len(self.plan.refused), np.int64)
        self.begin: int | None = None
        self.end = 0
        self.channels: list[str] = []

    def check(self, chunk: Chunk, channels: list[str]) -> None:
        """Check the next chunk of the log with all rules.

        Args:
            chunk: next frames of the log.
            channels: names of the known channels of the log.
        """
        if not len(chunk):
            return
        self.channels = channels
        self.frames += len(chunk)
        self.begin = int(chunk.stamps[0]) if self.begin is None else self.begin
        self.end = max(self.end, int(chunk.stamps[-1]))
        rows = self.frame_rules.rows(chunk)
        self.counts += np.bincount(rows[rows >= 0], minlength=len(self.counts))
        sorted_frames = self.frame_rules.check(chunk, rows, channels)
        self.load.check(chunk, rows)
        stream = sort(chunk, rows, sorted_frames.good)
        if len(self._groups):
            self._find_shared(stream)
        stream, refused = self._check_crc(stream, sorted_frames)
        rejected_before = self._rejected_before(stream, *refused)
        self.timing.arrived(refused[0], chunk.stamps[refused[1]])
        steps = self._counters.steps(stream)
        self.timing.check(stream, steps, rejected_before)
        self.order.check(stream, steps)
        self._check_payloads(stream, steps)

    def _check_crc(self, stream: Stream, sorted_frames: Sorted) -> tuple[Stream, tuple[Rows, npt.NDArray[np.intp]]]:
        """Check the CRC of each frame, and reject the frames with a wrong CRC.

        Returns:
            The frames with a valid CRC, and two arrays of shape (k,) for all rejected frames, including the frames that the
            header check rejected: the message index of each frame, and the position of each frame in the chunk.
        """
        refused = sorted_frames.rejected_rows, sorted_frames.rejected_indices
        intact = self._crc.check(stream)
        if intact is not None:
            rows = np.concatenate([refused[0], stream.rows[~intact]])
            indices = np.concatenate([refused[1], stream.indices[~intact]])
            refused, stream = (rows, indices), stream.select(intact)
        return stream, refused

    def _rejected_before(self, stream: Stream, rows: Rows, indices: npt.NDArray[np.intp]) -> Steps | None:
        """Count the rejected frames between consecutive valid frames of the same message.

        Args:
            stream: n valid frames of the chunk.
            rows: index of the message of each rejected frame in the plan, shape (k,).
            indices: index of each rejected frame in the chunk, shape (k,).

        Returns:
            Number of rejected frames between each valid frame and the previous valid frame of the same message, shape
            (n,); None if no frame was rejected.
        """
        if not len(rows) and not bool(self._pending.any()):
            return None
        rejected_before = np.zeros(len(stream), np.int64)
        waiting = self._pending[stream.present] > 0
        rejected_before[stream.starts[waiting]] += self._pending[stream.present[waiting]]
        self._pending[stream.present] = 0
        if len(rows):
            stride = np.int64(max(int(stream.indices.max(initial=0)), int(indices.max())) + 1)
            valid = stream.rows.astype(np.int64) * stride + stream.indices
            at = np.searchsorted(valid, rows.astype(np.int64) * stride + indices)
            inside = at < len(stream)
            inside[inside] = stream.rows[at[inside]] == rows[inside]
            np.add.at(rejected_before, at[inside], 1)
            np.add.at(self._pending, rows[~inside], 1)
        return rejected_before

    def _find_shared(self, stream: Stream) -> None:
        """Exclude each J1939 parameter group with several sender addresses from the timing rules.

        Frames from different addresses are not synchronous, so the interval between them is not the cycle time.
        """
        for row in self._groups:
            can_ids = np.unique(stream.frames[stream.of(row)]["can_id"]).tolist()
            if can_ids and (len(can_ids) > 1 or self._address.setdefault(row, can_ids[0]) != can_ids[0]):
                self.shared.add(row)
                self.timing.exclude(row)

    def _check_payloads(self, stream: Stream, steps: Steps) -> None:
        decoded: dict[int, Decoded] = {}
        kept = {self._family_of[row].rows.start for row in self.drives.command_rows} | self.drives.drives.keys()
        for family in self.plan.families:
            of_family = self.values.check(family, stream)
            if of_family is not None:
                self.motion.check(of_family, stream, steps)
                if family.rows.start in kept:
                    decoded[family.rows.start] = of_family
        self.drives.check(decoded, self._family_of, stream, steps)

    def finish(self, remarks: Iterable[Remark] = (), *, dropped: int = 0) -> None:
        """Apply the rules about the whole log.

        Args:
            remarks: defects of the log file.
            dropped: number of frames that the receiver reported as lost.
        """
        begin = self.begin or 0
        for remark in remarks:
            stamp = begin if remark.stamp < 0 else remark.stamp
            self.findings.add_log(remark.rule, stamp, remark.count, remark.sentence)
        if dropped:
            self.findings.add_log("dropped", self.end, dropped, f"{dropped} frames lost by the receiver")
        self.timing.finish(begin, self.end, self.expected())
        self.load.finish(self.channels)
        self.motion.finish(self.end)
        self.drives.finish()

    def expected(self) -> npt.NDArray[np.bool_]:
        """Return the mask of the messages that must be in the log. Shape (messages,).

        These messages are sent by `node` (None means any node) on the recorded buses. If a channel has no bus, the
        messages of all buses are selected.
        """
        count = len(self.plan.layouts)
        wanted = np.ones(count, np.bool_)
        if self.node is not None:
            wanted &= np.array([m.sender == self.node for m in self.plan.layouts], np.bool_)
        if self.plan.has_buses and self.channel_map.bus_of_channel and -1 not in self.channel_map.bus_of_channel:
            wanted &= np.isin(self.plan.bus_of_row, self.channel_map.bus_of_channel)
        return wanted & bool(self.frames)
