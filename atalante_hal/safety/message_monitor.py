"""Decide whether the data of each cyclic message is valid, from its E2E result, its age and the trust in its sender.

    process image -> message monitor -> validity of each message; diagnostics -> fault memory -> state machine

A received message that fails a check raises a pending diagnostic. The diagnostic is confirmed when the age of the data
reaches the timeout in the DBC. Each message has a leaky bucket, which counts lost frames. The bucket fills if more than a fifth
of the frames are lost. A message with a full bucket is no longer trusted. The message is trusted again after 16 good cycles in
a row.

The robot tolerates single disturbances of a message: a frame that is received twice, a value outside its range or with the
invalid code, a sender that is error passive. Each message has one leaky bucket for each kind of disturbance. These buckets have
the same size as the bucket for lost frames. A bucket is full after 16 disturbed cycles in a row, or if more than a fifth of the
cycles are disturbed. Then the diagnostic is confirmed, until 16 cycles in a row are undisturbed.

Two senders of one message are detected by a second intact frame in the same cycle. The second frame has either the
alive counter of the accepted frame but other bytes, or an alive counter out of sequence. Four such cycles in a row
confirm the diagnostic. Then the message is no longer trusted.

In single support it is safer to finish the walking step than to stop. So if a joint of the swing leg times out, the robot first
finishes the step. If the joint has sent no message for twice the timeout (10 cycles), the robot goes to HOLD. If any other joint
times out, the robot goes to HOLD without a delay.

In a walk on the ground, both legs are treated like a swing leg, and the timeouts of the joints are three cycles longer. A walk
then continues after five lost frames in a row even if the messages are one cycle late: the first frame after five lost frames is
rejected (E2E_SEQUENCE), so the data is up to seven cycles old. A frame that is received after its timeout in the DBC ends the
walk (JOINT_TIMEOUT), because the plausibility checks do not use such old values.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_dbc import Network
from atalante_hal.robot import SIDES
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.wire.e2e import FULL, REQUALIFY, SETTLED, Check, Qualification, qualify, suspect
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: Result of the E2E check of a rejected message -> diagnostic that becomes pending.
PENDING = {
    Check.REPEATED: Dtc.E2E_REPEATED,
    Check.CONFLICT: Dtc.E2E_REPEATED,  # unless the frame proves a second sender, see `rivals_of`
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
#: E2E check results of rejected frames that may come from a second sender.
#: It is a sign of two senders if a message has at least two intact frames in one cycle, one of them with such a result.
_RIVAL = (Check.CONFLICT, Check.WRONG_SEQUENCE)
#: Results of the E2E check of a rejected frame whose format and CRC are correct.
_INTACT = (*_RIVAL, Check.RANGE, Check.INVALID)
_FRESH = int(Check.SOME_LOST)
#: Check result of a rejected frame -> diagnostic. Each message has one leaky bucket for each of these diagnostics.
#: The bucket fills in each cycle in which a frame is rejected with a check result that leads to the diagnostic.
#: A full bucket confirms the diagnostic.
#: Exception: frames of an IMU with the check result INVALID lead to the diagnostic IMU_INVALID.
_DISTURBANCES = {
    Check.REPEATED: Dtc.E2E_REPEAT_RATE,
    Check.RANGE: Dtc.SIGNAL_RANGE,
    Check.INVALID: Dtc.SIGNAL_RANGE,
}
#: Age of the data at which a joint in one of `Tolerance.legs` leads to HOLD, as a multiple of the DBC timeout.
BRIEF_TIMEOUTS = 2


class Tolerance(NamedTuple):
    """Legs in which a brief timeout of a joint message does not lead to HOLD.

    A swing leg is tolerated while the other foot is on the ground. In a walk on the ground, both legs are tolerated.
    """

    #: Indices in SIDES of the legs in which a brief timeout leads to FINISH_STEP instead of HOLD.
    legs: Collection[int] = ()
    #: Extra time until a joint in one of `legs` times out [cycles]: with 3, a DBC timeout of 5 cycles becomes 8 cycles.
    #: The extra time applies only in cycles in which no frame of the joint is accepted.
    #: In a cycle in which a frame is accepted, the joint times out if the age of the new data reaches the DBC timeout.
    longer: int = 0


NO_TOLERANCE = Tolerance()
GROUND_TOLERANCE = Tolerance(range(len(SIDES)), longer=3)


class MessageMonitor:
    """Monitor of the cyclic messages in the 1 ms process image.

    The pendant message is monitored like all other messages, but its timeout confirms no diagnostic. If the pendant
    message is lost, the robot stops as it does after the request STOP.
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
        #: Counters that detect two senders of a message, by row. Each counter is between 0 and `FULL`.
        self._evidence = [0] * len(messages)
        #: Leaky bucket of each disturbance, by row and diagnostic. A disturbance without an entry has an empty bucket.
        self._disturbed: dict[tuple[int, Dtc], Qualification] = {}
        #: For each message: whether its sender was trusted at least once. If not, the sender may not be connected.
        self._was_trusted = [False] * len(messages)
        #: True for each row with new, intact, trusted and plausible data, shape (rows,).
        self.valid: npt.NDArray[np.bool_] = np.zeros(len(messages), np.bool_)
        self.joints_valid = False
        #: True if no message is disturbed: all rows have new data and are trusted, and all counters and leaky buckets are 0.
        #: If `settled` is True and all rows have new data again, `evaluate` has nothing to update, so the call may be omitted.
        self.settled = False

    @property
    def nodes_ready(self) -> bool:
        """Return whether every message except the pendant message is trusted."""
        return all(self.qualification[row].trusted for row in self._needed)

    def is_trusted(self, row: int) -> bool:
        """Return whether the sender of a message is trusted.

        Args:
            row: row of the message in the process image.
        """
        return self.qualification[row].trusted

    def may_have_two_senders(self, row: int) -> bool:
        """Return whether accepted frames of a message may come from different senders.

        The result becomes True in a cycle with frames of two senders. It becomes False after `REQUALIFY` consecutive good
        cycles, or when the counter of `suspect` has fallen to 0. The diagnostic NODE_DUPLICATE has no effect on the result.

        Args:
            row: row of the message in the process image.
        """
        return self._evidence[row] > 0 and self.qualification[row].good < REQUALIFY

    def in_time(self, row: int) -> bool:
        """Return whether the data of a message is younger than the DBC timeout of the message.

        Args:
            row: row of the message in the process image.
        """
        return bool(self._image.age[row] < self._timeouts[row])

    def evaluate(self, cycle: int, memory: FaultMemory, tolerance: Tolerance = NO_TOLERANCE) -> None:
        """Check all rows in one cycle.

        If `settled` is True and all rows have new data, this call may be omitted.

        Args:
            cycle: number of the current cycle.
            memory: fault memory in which diagnostics are raised.
            tolerance: tolerance of timeouts in this cycle.
        """
        image = self._image
        checks, ages = image.check.tolist(), image.age.tolist()
        rivals = rivals_of(image.refused, checks) if image.refused else frozenset()
        for row, result in image.refused:
            if result is Check.CONFLICT and row in rivals:
                continue  # `_check_senders` raises NODE_DUPLICATE for this row
            dtc = self._invalid[row] if result is Check.INVALID else PENDING[result]
            value = ages[row] if ages[row] < NEVER else 0
            memory.raise_dtc(cycle, dtc, self._senders[row], value=value, confirmed=False)
        self._check_disturbances(cycle, memory)
        for row, check in enumerate(checks):
            rival = row in rivals
            if check or ages[row] or rival or self._evidence[row] or self.qualification[row] is not SETTLED:
                self._check_row(cycle, memory, row, Check(check), ages[row], tolerance, rival)
        self.valid[:] = [check <= _FRESH and self.is_trusted(row) for row, check in enumerate(checks)]
        self.joints_valid = bool(self.valid[self._joint_rows].all())
        undisturbed = not (self._disturbed or any(self._evidence))
        self.settled = image.all_fresh and undisturbed and all(q is SETTLED for q in self.qualification)

    def _check_disturbances(self, cycle: int, memory: FaultMemory) -> None:
        """Update the leaky buckets of all disturbances, and raise the diagnostics of full buckets.

        Args:
            cycle: number of the current cycle.
            memory: fault memory in which diagnostics are raised.
        """
        image = self._image
        for row in image.error_passive:
            memory.raise_dtc(cycle, Dtc.NODE_ERROR_PASSIVE, self._senders[row], confirmed=False)
        now = [(row, Dtc.NODE_ERROR_PASSIVE) for row in image.error_passive]
        now += [(row, self._disturbance_of(row, result)) for row, result in image.refused if result in _DISTURBANCES]
        for key in dict.fromkeys([*now, *self._disturbed]):
            bucket = self._disturbed[key] = qualify(self._disturbed.get(key, SETTLED), good=key not in now)
            row, dtc = key
            if bucket is SETTLED:
                del self._disturbed[key]
            elif not bucket.trusted:
                sender = self._senders[row]
                text = f"{sender}: {dtc.meaning}, more than a fifth of {self._messages[row]}"
                memory.raise_dtc(cycle, dtc, sender, value=bucket.bucket, text=text)

    def _disturbance_of(self, row: int, result: Check) -> Dtc:
        return self._invalid[row] if result is Check.INVALID else _DISTURBANCES[result]

    def _check_senders(self, cycle: int, memory: FaultMemory, row: int, rival: bool) -> bool:
        """Update the counter that detects two senders of one message, and return whether two senders are confirmed.

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

    def _check_row(
        self,
        cycle: int,
        memory: FaultMemory,
        row: int,
        check: Check,
        age: int,
        tolerance: Tolerance,
        rival: bool,
    ) -> None:
        sender, two_senders = self._senders[row], self._check_senders(cycle, memory, row, rival)
        tolerated, timeout = self._legs[row] in tolerance.legs, self._timeouts[row]
        fresh = check <= Check.SOME_LOST
        # `tolerance.longer` delays the timeout only in cycles without an accepted frame.
        # In a cycle with an accepted frame, the DBC timeout applies: the plausibility checks ignore data as old as this timeout.
        late = age >= timeout + tolerance.longer * (tolerated and not fresh)
        # Impossible signal values do not reduce the trust, because the frame was transmitted correctly.
        good = (fresh or check >= Check.RANGE) and not rival
        now = self.qualification[row] = qualify(self.qualification[row], good=good, timed_out=late or two_senders)
        self._was_trusted[row] |= now.trusted
        confirmed = late and self._was_trusted[row] and self._confirms[row]
        # A plausibility check that rejects the values of a message (IMPLAUSIBLE) raises its own diagnostic.
        if confirmed and check is not Check.IMPLAUSIBLE:
            dtc = self._invalid[row] if check is Check.INVALID else CONFIRMED[check]
            text = f"{sender}: {dtc.meaning}; its data is {age} cycles old"
            if brief := tolerated and age < BRIEF_TIMEOUTS * timeout:
                memory.raise_dtc(cycle, Dtc.JOINT_TIMEOUT, sender, value=age)
            memory.raise_dtc(cycle, dtc, sender, value=age, confirmed=not brief, text=text)
        elif fresh and age and not late:
            memory.raise_dtc(cycle, Dtc.NODE_LATE, sender, value=age, confirmed=False)
        if check is Check.SOME_LOST:
            memory.raise_dtc(cycle, Dtc.E2E_SOME_LOST, sender, value=age, confirmed=False)
        if now.bucket == FULL and not now.trusted and self._was_trusted[row] and self._confirms[row]:
            memory.raise_dtc(cycle, Dtc.E2E_LOSS_RATE, sender, value=now.bucket)

    def missing(self) -> set[str]:
        """Return the required senders that are not trusted."""
        return {self._senders[row] for row in self._needed if not self.qualification[row].trusted}


def rivals_of(refused: Sequence[tuple[int, Check]], checks: Sequence[int]) -> frozenset[int]:
    """Return the rows whose frames in this cycle cannot all be from one sender.

    Each of these rows has at least two intact frames in this cycle: frames with correct format and CRC, accepted or rejected.
    The check result of at least one rejected frame is CONFLICT or WRONG_SEQUENCE.

    Args:
        refused: row and check result of each rejected frame.
        checks: `Check` of each row, shape (rows,).
    """
    # Count the intact frames of each row: first the rejected ones, then the accepted one.
    intact = Counter(row for row, result in refused if result in _INTACT)
    for row in intact:
        intact[row] += checks[row] <= _FRESH or checks[row] == Check.IMPLAUSIBLE
    return frozenset(row for row, result in refused if result in _RIVAL and intact[row] > 1)


def _leg(drive: str) -> int:
    """Return the index in SIDES of the leg of a drive."""
    return SIDES.index(drive.split("_")[0].lower())
