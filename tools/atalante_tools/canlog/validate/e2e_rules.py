"""Rules for end-to-end protection (E2E): CRC of every frame, and increments of the alive counters."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.e2e import COUNTER_BYTE
from atalante_hal.wire.frame import FRAME_BYTES, HEADER_BYTES
from atalante_tools.canlog.column_codec import crc_differences
from atalante_tools.canlog.plan import Plan, Rows
from atalante_tools.canlog.stream import Stream
from atalante_tools.canlog.validate.findings import Findings

Steps = npt.NDArray[np.int64]

#: The increment is `REPEATED` if the alive counter did not change: the frame repeats the previous frame.
#: The increment is `NO_STEP` if it is unknown: the frame has no alive counter or is the first frame of its message.
REPEATED, NO_STEP = 0, -1


def counter_steps(counters: npt.NDArray[np.uint8], before: npt.NDArray[np.uint8]) -> Steps:
    """Return the increment of the alive counter since the previous frame, 0 to 255. Shape (n,).

    Args:
        counters: alive counter of each frame, shape (n,).
        before: alive counter of the previous frame of the same message, shape (n,).
    """
    return np.subtract(counters, before).astype(np.int64)


class CrcRules:
    """Rules for the CRC of each frame.

    The CRC covers the payload and the Data ID, a number that the DBC assigns to each message with a CRC.
    """

    def __init__(self, plan: Plan, findings: Findings) -> None:
        self._plan, self._findings = plan, findings
        lengths = np.where(plan.protected, plan.lengths, 0)
        #: Ranges of message indices, one range for each payload length of the messages with a CRC.
        #: A range also contains messages of the same length without a CRC. `check` ignores these messages.
        self._spans = [
            range(int(r[0]), int(r[-1]) + 1) for n in np.unique(lengths[lengths > 0]) for r in [_at(plan, n)]
        ]
        self._names = {
            (m.length, int(constant)): m.name
            for m, constant in zip(plan.layouts, plan.crc_constants.tolist(), strict=True)
            if m.data_id is not None
        }

    def check(self, stream: Stream) -> npt.NDArray[np.bool_] | None:
        """Report the frames with a wrong CRC.

        Args:
            stream: n frames of the chunk, sorted by message.

        Returns:
            Mask of the intact frames, shape (n,); None if all frames are intact.
        """
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
        """Report wrong CRCs.

        If a CRC matches the Data ID of another message, the report says that the identifier of the frame is wrong.

        Args:
            of: for each frame, index of the message in the plan, shape (k,).
            stamps: time stamp of each frame [ns], shape (k,).
            differences: result of `crc_differences`, shape (k,).
            length: payload length of the frames, bytes.
        """
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
    """Calculator of alive counter increments. It stores the last counter of each message."""

    def __init__(self, plan: Plan) -> None:
        self._protected = plan.protected
        self._last = np.zeros(len(plan.layouts), np.uint8)
        self._seen = np.zeros(len(plan.layouts), np.bool_)

    def steps(self, stream: Stream) -> Steps:
        """Return the counter increment at each frame. Shape (n,).

        The increment is `NO_STEP` if the frame has no counter or no previous frame.
        """
        counters = stream.frames.view(np.uint8).reshape(-1, FRAME_BYTES)[:, HEADER_BYTES + COUNTER_BYTE].copy()
        steps = counter_steps(counters, stream.before(counters, self._last))
        steps[stream.starts[~self._seen[stream.present]]] = NO_STEP
        if not bool(self._protected[stream.present].all()):
            steps[~self._protected[stream.rows]] = NO_STEP
        stream.last(counters, self._last)
        self._seen[stream.present] = True
        return steps
