"""Message monitor, which decides from E2E result, age and trust of each cyclic message whether its data is valid.

    process image -> message monitor -> validity of each message; diagnostics -> fault memory -> state machine

A message that was not committed raises a pending diagnostic. The diagnostic is confirmed when the data is as old as the timeout
in the DBC. A leaky bucket for each message fills when more than a fifth of its frames are lost. A message whose bucket is full
loses its trust. It is trusted again after 16 good cycles in a row.

Two senders of one message are detected by a second intact frame in the same cycle. This frame has the same counter as the
accepted frame and other bytes, or a counter out of sequence. Four such cycles in a row confirm the diagnostic, and the message
loses its trust.

In single support it is safer to finish the walking step than to stop. So if a joint of the swing leg times out, the robot first
finishes the step. If no message has arrived after twice the timeout (10 cycles), the robot goes to HOLD as for any other joint.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from atalante_dbc import Network
from atalante_hal.robot import SIDES
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.wire.e2e import FULL, SETTLED, Check, Qualification, qualify, suspect
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: Check result of a rejected message -> diagnostic that becomes pending in the same cycle.
PENDING = {
    Check.REPEATED: Dtc.E2E_REPEATED,
    Check.CONFLICT: Dtc.E2E_REPEATED,  # only for one frame in a cycle; two frames are evidence of two senders, see `rivals_of`
    Check.WRONG_SEQUENCE: Dtc.E2E_SEQUENCE,
    Check.CRC: Dtc.E2E_CRC,
    Check.LENGTH: Dtc.FRAME_LENGTH,
    Check.RANGE: Dtc.SIGNAL_RANGE,
    Check.INVALID: Dtc.SIGNAL_RANGE,
}
#: Last check result of a message -> diagnostic that is confirmed when the message times out.
CONFIRMED = {
    **PENDING,
    Check.OK: Dtc.NODE_LATE,
    Check.SOME_LOST: Dtc.NODE_LATE,
    Check.NO_DATA: Dtc.NODE_TIMEOUT,
    Check.REPEATED: Dtc.E2E_FROZEN,
    Check.CONFLICT: Dtc.E2E_FROZEN,
}
#: Check results that prove a second sender if another intact frame of the message arrived in the same cycle.
_RIVAL = (Check.CONFLICT, Check.WRONG_SEQUENCE)
#: Check results of rejected frames that have the correct format and CRC.
_INTACT = (*_RIVAL, Check.RANGE, Check.INVALID)
_FRESH = int(Check.SOME_LOST)
#: The robot goes to HOLD when the age of the data of a swing leg joint reaches this multiple of the message timeout.
SWING_TIMEOUTS = 2


class MessageMonitor:
    """Monitor of the cyclic messages in the 1 ms process image.

    The pendant message is monitored in the same way, but confirms no diagnostic here: its loss counts as a stop by the operator.
    """

    def __init__(self, network: Network, image: ReceiveImage) -> None:
        self._image = image
        messages = image.codec.messages
        self._senders = [m.sender for m in messages]
        self._messages = [m.name for m in messages]
        self._timeouts = [m.timeout_ms for m in messages]
        kinds = [network.node(m.sender).kind for m in messages]
        self._invalid = [Dtc.IMU_INVALID if kind == "imu" else Dtc.SIGNAL_RANGE for kind in kinds]
        self._legs = [_leg(self._senders[row]) if kind == "drive" else None for row, kind in enumerate(kinds)]
        self._joint_rows = [row for row, kind in enumerate(kinds) if kind == "drive"]
        self._confirms = [kind != "pendant" for kind in kinds]
        self._needed = [row for row, kind in enumerate(kinds) if kind != "pendant"]
        self.qualification = [Qualification()] * len(messages)
        #: For each row: evidence that its message has two senders, 0 to `FULL`.
        self._evidence = [0] * len(messages)
        #: True for each row that was trusted at least once. Other rows may belong to nodes that are not connected.
        self._known = [False] * len(messages)
        #: True for each row with new, intact, trusted and plausible data, shape (rows,).
        self.valid: npt.NDArray[np.bool_] = np.zeros(len(messages), np.bool_)
        self.joints_valid = False
        #: True if all rows are trusted and all leaky buckets are empty. Then a cycle with new data in all rows changes no result.
        self.settled = False

    @property
    def nodes_well(self) -> bool:
        """Return whether every message except the pendant message is trusted."""
        return all(self.qualification[row].trusted for row in self._needed)

    def trusts(self, row: int) -> bool:
        """Return whether the sender of the message in a row is trusted."""
        return self.qualification[row].trusted

    def hears(self, row: int) -> bool:
        """Return whether the data of a row is younger than the timeout of its message."""
        return bool(self._image.age[row] < self._timeouts[row])

    def judge(self, cycle: int, memory: FaultMemory, swing: int | None = None) -> None:
        """Check all rows in one cycle. While `settled` is True, the call may be omitted in a cycle with new data in all rows.

        Args:
            cycle: number of the current cycle.
            memory: fault memory in which diagnostics are raised.
            swing: index of the swing leg in SIDES; None if there is no swing leg.
        """
        image = self._image
        checks, ages = image.check.tolist(), image.age.tolist()
        rivals = rivals_of(image.refused, checks) if image.refused else frozenset()
        for row, result in image.refused:
            if result is Check.CONFLICT and row in rivals:
                continue  # `_judge_senders` raises this diagnostic
            dtc = self._invalid[row] if result is Check.INVALID else PENDING[result]
            value = ages[row] if ages[row] < NEVER else 0
            memory.raise_dtc(cycle, dtc, self._senders[row], value=value, confirmed=False)
        for row, check in enumerate(checks):
            rival = row in rivals
            if check or ages[row] or rival or self._evidence[row] or self.qualification[row] is not SETTLED:
                self._judge_row(cycle, memory, row, Check(check), ages[row], swing, rival)
        self.valid[:] = [check <= _FRESH and self.trusts(row) for row, check in enumerate(checks)]
        self.joints_valid = bool(self.valid[self._joint_rows].all())
        self.settled = image.all_fresh and not any(self._evidence) and all(q is SETTLED for q in self.qualification)

    def _judge_senders(self, cycle: int, memory: FaultMemory, row: int, rival: bool) -> bool:
        """Update the evidence that a message has two senders, and return whether two senders are confirmed.

        Args:
            cycle: number of the current cycle.
            memory: fault memory in which the diagnostic is raised.
            row: row of the message.
            rival: True if this cycle has a frame of a second sender in addition to the accepted frame.

        Returns:
            Whether two senders are confirmed in this cycle.
        """
        evidence = self._evidence[row] = suspect(self._evidence[row], rival=rival)
        confirmed = rival and evidence == FULL
        conflict = rival and (row, Check.CONFLICT) in self._image.refused
        if confirmed or conflict:
            sender, message = self._senders[row], self._messages[row]
            text = f"{sender}: {Dtc.NODE_DUPLICATE.meaning}, {message}: switch one of them off"
            memory.raise_dtc(cycle, Dtc.NODE_DUPLICATE, sender, value=evidence, confirmed=confirmed, text=text)
        return confirmed

    def _judge_row(
        self,
        cycle: int,
        memory: FaultMemory,
        row: int,
        check: Check,
        age: int,
        swing: int | None,
        rival: bool,
    ) -> None:
        sender, two_senders = self._senders[row], self._judge_senders(cycle, memory, row, rival)
        fresh, late = check <= Check.SOME_LOST, age >= self._timeouts[row]
        # Impossible signal values do not reduce the trust, because the frame was transmitted correctly.
        good = (fresh or check >= Check.RANGE) and not rival
        now = self.qualification[row] = qualify(self.qualification[row], good=good, timed_out=late or two_senders)
        self._known[row] |= now.trusted
        confirmed = late and self._known[row] and self._confirms[row]
        if confirmed and check is not Check.IMPLAUSIBLE:  # `plausibility` raises the diagnostic of this check result
            dtc = self._invalid[row] if check is Check.INVALID else CONFIRMED[check]
            text = f"{sender}: {dtc.meaning}; its data is {age} cycles old"
            in_swing = swing is not None and self._legs[row] == swing
            if brief := in_swing and age < SWING_TIMEOUTS * self._timeouts[row]:
                memory.raise_dtc(cycle, Dtc.SWING_TIMEOUT, sender, value=age)
            memory.raise_dtc(cycle, dtc, sender, value=age, confirmed=not brief, text=text)
        elif fresh and age and not late:
            memory.raise_dtc(cycle, Dtc.NODE_LATE, sender, value=age, confirmed=False)
        if check is Check.SOME_LOST:
            memory.raise_dtc(cycle, Dtc.E2E_SOME_LOST, sender, value=age, confirmed=False)
        if now.bucket == FULL and not now.trusted and self._known[row] and self._confirms[row]:
            memory.raise_dtc(cycle, Dtc.E2E_LOSS_RATE, sender, value=now.bucket)

    def missing(self) -> set[str]:
        """Return the required senders that are not trusted."""
        return {self._senders[row] for row in self._needed if not self.qualification[row].trusted}


def rivals_of(refused: Sequence[tuple[int, Check]], checks: Sequence[int]) -> frozenset[int]:
    """Return the rows with evidence of a second sender in this cycle.

    Each of these rows received at least two intact frames in this cycle that cannot be from the same sender.

    Args:
        refused: row and check result of each rejected frame.
        checks: `Check` of each row, shape (rows,).
    """
    intact = Counter(row for row, result in refused if result in _INTACT)
    for row in intact:
        intact[row] += checks[row] <= _FRESH or checks[row] == Check.IMPLAUSIBLE  # the committed frame counts as well
    return frozenset(row for row, result in refused if result in _RIVAL and intact[row] > 1)


def _leg(drive: str) -> int:
    """Return the index in SIDES of the leg of a drive."""
    return SIDES.index(drive.split("_")[0].lower())
