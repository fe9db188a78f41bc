"""All rules over all frames of one log: chunk after chunk, then what can only be said at the end.

chunk -> headers (frame_rules) -> by message (stream) -> CRC, counters, time -> payloads by family -> values, motion, drives
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from atalante_tools.validate.buses import Homes
from atalante_tools.validate.chunk import Chunk
from atalante_tools.validate.drive_rules import DriveRules
from atalante_tools.validate.e2e_rules import Counters, CrcRules, Steps
from atalante_tools.validate.findings import Findings
from atalante_tools.validate.frame_rules import FrameRules, Sorted
from atalante_tools.validate.load_rules import LoadRules
from atalante_tools.validate.log import Remark
from atalante_tools.validate.motion_rules import MotionRules
from atalante_tools.validate.order_rules import OrderRules
from atalante_tools.validate.plan import Plan, Rows
from atalante_tools.validate.project import Project
from atalante_tools.validate.stream import Stream, sort
from atalante_tools.validate.timing_rules import TimingRules
from atalante_tools.validate.value_rules import Decoded, ValueRules

_ALL_BITS = 0x1FFF_FFFF


class Judge:
    """Judges one log against one DBC; after `finish`, `findings` has everything."""

    def __init__(
        self, plan: Plan, project: Project | None = None, *, node: str | None = None, keeps_flags: bool = True
    ) -> None:
        """Get ready.

        Args:
            plan: of the DBC; several judges may share it.
            project: thresholds, silences and channels.
            node: expect the messages of this node alone; the others may be missing.
            keeps_flags: whether the log has the flags of CAN FD frames.
        """
        self.project = project or Project()
        self.plan = plan
        self.node = node
        self.findings = Findings(self.plan)
        self.homes = Homes(self.plan, self.project.channels)
        self.frame_rules = FrameRules(self.plan, self.findings, self.homes, keeps_flags=keeps_flags)
        self.keeps_flags = keeps_flags
        self._crc = CrcRules(self.plan, self.findings)
        self._counters = Counters(self.plan)
        self.timing = TimingRules(self.plan, self.findings, self.project)
        self.order = OrderRules(self.plan, self.findings, self.project)
        self.load = LoadRules(self.plan, self.findings, self.project, self.homes)
        self.values = ValueRules(self.plan, self.findings, self.project)
        self.motion = MotionRules(self.plan, self.findings, self.project)
        self.drives = DriveRules(self.plan, self.findings, self.project)
        self._family_of = {row: family for family in self.plan.families for row in family.rows}
        self._pending = np.zeros(len(self.plan.layouts), np.int64)  # refused frames since the last good one
        self._groups = [row for row, m in enumerate(self.plan.layouts) if m.pgn_mask != _ALL_BITS]
        self._address: dict[int, int] = {}
        #: Messages that several addresses send, so that nothing can be said about their time.
        self.shared: set[int] = set()
        self.frames = 0
        self.counts = np.zeros(len(self.plan.layouts) + len(self.plan.refused), np.int64)
        self.begin: int | None = None
        self.end = 0
        self.channels: list[str] = []

    def judge(self, chunk: Chunk, channels: list[str]) -> None:
        """Judge a chunk; `channels` are the names of the log's channels so far."""
        if not len(chunk):
            return
        self.channels = channels
        self.frames += len(chunk)
        self.begin = int(chunk.stamps[0]) if self.begin is None else self.begin
        self.end = max(self.end, int(chunk.stamps[-1]))
        rows = self.frame_rules.rows(chunk)
        self.counts += np.bincount(rows[rows >= 0], minlength=len(self.counts))
        sorted_out = self.frame_rules.judge(chunk, rows, channels)
        self.load.judge(chunk, rows)
        stream = sort(chunk, rows, sorted_out.good)
        if len(self._groups):
            self._find_shared(stream)
        stream, refused = self._judge_crc(stream, sorted_out)
        explained = self._explain(stream, *refused)
        self.timing.arrived(refused[0], chunk.stamps[refused[1]])
        steps = self._counters.steps(stream)
        self.timing.judge(stream, steps, explained)
        self.order.judge(stream, steps)
        self._judge_payloads(stream, steps)

    def _judge_crc(self, stream: Stream, sorted_out: Sorted) -> tuple[Stream, tuple[Rows, npt.NDArray[np.intp]]]:
        """Only intact frames go on; the damaged ones join those that were refused before."""
        refused = sorted_out.rejected_rows, sorted_out.rejected_places
        intact = self._crc.judge(stream)
        if intact is not None:
            rows = np.concatenate([refused[0], stream.rows[~intact]])
            places = np.concatenate([refused[1], stream.places[~intact]])
            refused, stream = (rows, places), stream.select(intact)
        return stream, refused

    def _explain(self, stream: Stream, rows: Rows, places: npt.NDArray[np.intp]) -> Steps | None:
        """For each good frame, how many refused frames of its message came since the last good one; None: none at all."""
        if not len(rows) and not bool(self._pending.any()):
            return None
        explained = np.zeros(len(stream), np.int64)
        waiting = self._pending[stream.present] > 0
        explained[stream.starts[waiting]] += self._pending[stream.present[waiting]]
        self._pending[stream.present] = 0
        if len(rows):
            behind = np.int64(max(int(stream.places.max(initial=0)), int(places.max())) + 1)
            good = stream.rows.astype(np.int64) * behind + stream.places
            at = np.searchsorted(good, rows.astype(np.int64) * behind + places)
            inside = at < len(stream)
            inside[inside] = stream.rows[at[inside]] == rows[inside]
            np.add.at(explained, at[inside], 1)
            np.add.at(self._pending, rows[~inside], 1)
        return explained

    def _find_shared(self, stream: Stream) -> None:
        """J1939: one parameter group may come from several addresses, each with its own cycle."""
        for row in self._groups:
            can_ids = np.unique(stream.frames[stream.of(row)]["can_id"]).tolist()
            if can_ids and (len(can_ids) > 1 or self._address.setdefault(row, can_ids[0]) != can_ids[0]):
                self.shared.add(row)
                self.timing.exclude(row)

    def _judge_payloads(self, stream: Stream, steps: Steps) -> None:
        decoded: dict[int, Decoded] = {}
        kept = {self._family_of[row].rows.start for row in self.drives.command_rows} | self.drives.drives.keys()
        for family in self.plan.families:
            of_family = self.values.judge(family, stream)
            if of_family is not None:
                self.motion.judge(of_family, stream, steps)
                if family.rows.start in kept:
                    decoded[family.rows.start] = of_family
        self.drives.judge(decoded, self._family_of, stream, steps)

    def finish(self, remarks: Iterable[Remark] = (), *, dropped: int = 0) -> None:
        """The log is over.

        Args:
            remarks: what is wrong with the log itself.
            dropped: frames that the receiver says it lost.
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
        """Messages that should be in the log: of the node asked for, of the buses that are in it. Shape (rows,)."""
        count = len(self.plan.layouts)
        wanted = np.ones(count, np.bool_)
        if self.node is not None:
            wanted &= np.array([m.sender == self.node for m in self.plan.layouts], np.bool_)
        if self.plan.is_ours and self.homes.bus_of_channel and -1 not in self.homes.bus_of_channel:
            wanted &= np.isin(self.plan.bus_of_row, self.homes.bus_of_channel)
        return wanted & bool(self.frames)
