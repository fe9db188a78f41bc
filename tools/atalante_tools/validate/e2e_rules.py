"""End-to-end protection of whole columns: the CRC of every frame, and what the alive counters say about lost ones."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from atalante_hal.bulk import crc_differences
from atalante_hal.e2e import COUNTER_BYTE
from atalante_hal.frame import FRAME_BYTES, HEADER_BYTES
from atalante_tools.validate.findings import Findings
from atalante_tools.validate.plan import Plan, Rows
from atalante_tools.validate.stream import Stream

Steps = npt.NDArray[np.int64]

#: Steps of a message without a counter, or before which nothing was received.
NO_STEPS = 0


def counter_steps(counters: npt.NDArray[np.uint8], before: npt.NDArray[np.uint8]) -> Steps:
    """How far each counter moved since the frame before: 1 is in order, 0 repeated. Shape (n,), 0 to 255."""
    return np.subtract(counters, before).astype(np.int64)


class CrcRules:
    """CRC against payload and Data ID."""

    def __init__(self, plan: Plan, findings: Findings) -> None:
        self._plan, self._findings = plan, findings
        lengths = np.where(plan.protected, plan.lengths, 0)
        #: Rows of each payload length; they are neighbours.
        self._spans = [
            range(int(r[0]), int(r[-1]) + 1) for n in np.unique(lengths[lengths > 0]) for r in [_at(plan, n)]
        ]
        self._names = {
            (m.length, int(constant)): m.name
            for m, constant in zip(plan.layouts, plan.crc_constants.tolist(), strict=True)
            if m.data_id is not None
        }

    def judge(self, stream: Stream) -> npt.NDArray[np.bool_] | None:
        """Report damaged frames. Returns None if all are intact, otherwise where they are; shape (n,)."""
        intact: npt.NDArray[np.bool_] | None = None
        for rows in self._spans:
            span = stream.span(rows)
            if span.start == span.stop:
                continue
            length = int(self._plan.lengths[rows.start])
            of = stream.rows[span]
            differences = crc_differences(stream.frames[span], length)
            wrong = (differences != self._plan.crc_constants[of]) & self._plan.protected[of]
            if bool(wrong.any()):
                if intact is None:
                    intact = np.ones(len(stream), np.bool_)
                intact[span] = ~wrong
                self._report(of[wrong], stream.stamps[span][wrong], differences[wrong], length)
        return intact

    def _report(
        self, of: Rows, stamps: npt.NDArray[np.int64], differences: npt.NDArray[np.uint16], length: int
    ) -> None:
        """A CRC that is right for another message of this length says whose frame it is."""
        names = [self._names.get((length, difference), "") for difference in differences.tolist()]
        foreign = np.array([bool(name) for name in names])
        if not bool(foreign.all()):
            self._findings.add_rows("crc", of[~foreign], stamps[~foreign])
        if bool(foreign.any()):
            shown = np.array(names, object)[foreign]
            self._findings.add_rows(
                "crc-data-id", of[foreign], stamps[foreign], shown=shown, badness=np.zeros(len(shown))
            )


def _at(plan: Plan, length: int) -> npt.NDArray[np.intp]:
    return np.flatnonzero(plan.lengths == length)


class Counters:
    """Alive counters of all messages; remembers the last of each."""

    def __init__(self, plan: Plan) -> None:
        self._protected = plan.protected
        self._last = np.zeros(len(plan.layouts), np.uint8)
        self._seen = np.zeros(len(plan.layouts), np.bool_)

    def steps(self, stream: Stream) -> Steps:
        """Counter steps of each frame; `NO_STEPS - 1` where there is nothing to compare with. Shape (n,)."""
        counters = stream.frames.view(np.uint8).reshape(-1, FRAME_BYTES)[:, HEADER_BYTES + COUNTER_BYTE].copy()
        steps = counter_steps(counters, stream.before(counters, self._last))
        steps[stream.starts[~self._seen[stream.present]]] = NO_STEPS - 1
        if not bool(self._protected[stream.present].all()):
            steps[~self._protected[stream.rows]] = NO_STEPS - 1
        stream.last(counters, self._last)
        self._seen[stream.present] = True
        return steps
