"""Whether what the nodes say every cycle may be used: E2E, age and trust of each message.

`process image -> message monitor -> validity of each message, diagnostics -> supervisor`

A message that was not committed is pending trouble; it is confirmed when its data is as old as the DBC's timeout. A message
that loses more than a fifth of its frames trips its leaky bucket. What tripped is trusted again after 16 good cycles in a row.

Two senders of one message are recognised by their frames: beside the accepted frame of a cycle comes an intact one with the same
counter and other bytes, or with a counter that is no successor. Four such cycles in a row are confirmed and take the trust away.

Who stands on one leg had better put the other one down: a joint of the swing leg that is not heard has its step finished, and
is held like any other when it still is not heard after twice the timeout, 10 cycles.
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

#: Why a message was not committed -> what is noted at once.
PENDING = {
    Check.REPEATED: Dtc.E2E_REPEATED,
    Check.CONFLICT: Dtc.E2E_REPEATED,  # alone in its cycle; beside another frame it is a rival, see `rivals_of`
    Check.WRONG_SEQUENCE: Dtc.E2E_SEQUENCE,
    Check.CRC: Dtc.E2E_CRC,
    Check.LENGTH: Dtc.FRAME_LENGTH,
    Check.RANGE: Dtc.SIGNAL_RANGE,
    Check.INVALID: Dtc.SIGNAL_RANGE,
}
#: What is confirmed when the data has become too old.
CONFIRMED = {
    **PENDING,
    Check.OK: Dtc.NODE_LATE,
    Check.SOME_LOST: Dtc.NODE_LATE,
    Check.NO_DATA: Dtc.NODE_TIMEOUT,
    Check.REPEATED: Dtc.E2E_FROZEN,
    Check.CONFLICT: Dtc.E2E_FROZEN,
}
#: Beside another intact frame of the same cycle these are a second sender's.
_RIVAL = (Check.CONFLICT, Check.WRONG_SEQUENCE)
#: Frames that were not committed, but whose format and CRC are right.
_INTACT = (*_RIVAL, Check.RANGE, Check.INVALID)
_FRESH = int(Check.SOME_LOST)
#: Timeouts for which a joint of the swing leg may not be heard before the robot holds.
SWING_TIMEOUTS = 2


class MessageMonitor:
    """Judges the rows of the fast image; the pendant's is judged alike, what follows from its loss is the operator's stop."""

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
        #: Evidence of two senders of each row, 0 to `FULL`.
        self._evidence = [0] * len(messages)
        #: Rows that were trusted once: of the others nobody knows whether they should speak.
        self._known = [False] * len(messages)
        #: New, intact, trusted and plausible data came in this cycle, shape (rows,).
        self.valid: npt.NDArray[np.bool_] = np.zeros(len(messages), np.bool_)
        self.joints_valid = False
        #: Everything is trusted and nothing is on its way to trip: a perfect cycle changes nothing here.
        self.settled = False

    @property
    def nodes_well(self) -> bool:
        """Every message but the pendant's is trusted and not too old."""
        return all(self.qualification[row].trusted for row in self._needed)

    def trusts(self, row: int) -> bool:
        """Whether a row's sender is trusted."""
        return self.qualification[row].trusted

    def hears(self, row: int) -> bool:
        """Return whether a row's data is younger than its timeout, trusted or not."""
        return bool(self._image.age[row] < self._timeouts[row])

    def judge(self, cycle: int, memory: FaultMemory, swing: int | None = None) -> None:
        """Judge a cycle that is not perfect, or follows one that was not.

        Args:
            swing: leg that swings while the other one stands, by its place in SIDES; None: none does.
        """
        image = self._image
        checks, ages = image.check.tolist(), image.age.tolist()
        rivals = rivals_of(image.refused, checks) if image.refused else frozenset()
        for row, why in image.refused:
            if why is Check.CONFLICT and row in rivals:
                continue  # raised with its evidence below
            dtc = self._invalid[row] if why is Check.INVALID else PENDING[why]
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
        """Return whether two senders of a row are confirmed in this cycle.

        Args:
            rival: a frame of a second sender came beside the accepted one.
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
        # What a frame says may be impossible: the way it came is good all the same.
        good = (fresh or check >= Check.RANGE) and not rival
        now = self.qualification[row] = qualify(self.qualification[row], good=good, timed_out=late or two_senders)
        self._known[row] |= now.trusted
        confirmed = late and self._known[row] and self._confirms[row]
        if confirmed and check is not Check.IMPLAUSIBLE:  # which `plausibility` tells
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
        """Senders that are not heard in time or not trusted yet."""
        return {self._senders[row] for row in self._needed if not self.qualification[row].trusted}


def rivals_of(refused: Sequence[tuple[int, Check]], checks: Sequence[int]) -> frozenset[int]:
    """Return the rows with a frame that the sender of another frame of the same cycle cannot have sent.

    Args:
        refused: frames that were not committed, row and why.
        checks: `Check` of each row.
    """
    intact = Counter(row for row, why in refused if why in _INTACT)
    for row in intact:
        intact[row] += checks[row] <= _FRESH or checks[row] == Check.IMPLAUSIBLE  # which was committed, then refused
    return frozenset(row for row, why in refused if why in _RIVAL and intact[row] > 1)


def _leg(drive: str) -> int:
    """Leg of a drive, by its place in SIDES."""
    return SIDES.index(drive.split("_")[0].lower())
