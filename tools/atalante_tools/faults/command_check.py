"""Independent check that all command frames of the HAL respect the limits.

The frames are decoded with the bit positions in the DBC.

This module shares no code with the limiter, the codec and the process image of the HAL, so it can detect errors in
these modules.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message, Network, Signal
from atalante_hal.robot import LEG_JOINTS, SIDES, Robot
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.frame import FRAME, Frames

Vector = npt.NDArray[np.float64]
#: Resolution of the torque signals [Nm]. Because of rounding, a sent torque may exceed the torque limit by one resolution step.
_RESOLUTION: Final = 0.0125
_PERIOD: Final = 1e-3  # s


class SentFrames:
    """`FrameTap` that records each frame from the HAL and the HAL cycle of the frame."""

    def __init__(self) -> None:
        self.cycle = 0  # current HAL cycle, set by the runner
        self._cycles: list[int] = []
        self._sizes: list[int] = []
        self._memory = bytearray()

    def sent(self, frames: Frames) -> None:
        """Record frames that the HAL has sent.

        Args:
            frames: sent frames, shape (n,).
        """
        self._memory += frames.tobytes()
        self._sizes.append(len(frames))
        self._cycles.append(self.cycle)

    def received(self, frames: Frames, count: int) -> None:
        """Ignore frames from the nodes.

        Args:
            frames: receive buffer.
            count: number of received frames.
        """

    def frames(self) -> tuple[npt.NDArray[np.int64], Frames]:
        """Return the HAL cycle of each sent frame, and the sent frames. Both arrays have the shape (n,)."""
        return np.repeat(self._cycles, self._sizes).astype(np.int64), np.frombuffer(bytes(self._memory), FRAME)


class _Leg:
    """Decoded command frames of one leg: HAL cycle of each frame (shape (n,)), and values of each signal (shape (n, 6))."""

    def __init__(self, message: Message, cycles: npt.NDArray[np.int64], frames: Frames) -> None:
        selected = (frames["can_id"] == message.frame_id) & (frames["len"] == message.length)
        self.cycle = cycles[selected]
        words = np.ascontiguousarray(frames["data"][selected]).view("<u8")
        self.word, self.torque, self.limit = (
            np.column_stack([_decode(words, message.signal(f"{joint}_{name}")) for joint in LEG_JOINTS])
            for name in ("Controlword", "TargetTorque", "MaxTorque")
        )

    def consecutive(self) -> npt.NDArray[np.bool_]:
        """Return for each pair of successive frames and each joint whether both frames enable the drive, shape (n - 1, 6).

        Row k belongs to the frames k and k + 1. It is False if the two frames do not belong to consecutive cycles.
        """
        enabled = self.word == Controlword.ENABLE_OPERATION
        return np.asarray(enabled[1:] & enabled[:-1] & (np.diff(self.cycle) == 1)[:, None])


class Commands:
    """Decoded commands of a run, with a check of identifiers, torques, torque limits and torque rates."""

    def __init__(self, network: Network, cycles: npt.NDArray[np.int64], frames: Frames) -> None:
        """Decode the command frames.

        Args:
            network: messages of the DBC.
            cycles: HAL cycle of each frame, shape (n,).
            frames: frames sent by the HAL, shape (n,).
        """
        legs = [network.message(f"COMMAND_{side.upper()}_LEG") for side in SIDES]
        self._legs = [_Leg(message, cycles, frames) for message in legs]
        own = [message.frame_id for message in network.sent_by("HAL")]
        self._foreign_ids = np.setdiff1d(frames["can_id"], own)

    def words(self, cycle: int) -> list[int]:
        """Return the controlwords of all joints in the command frames of a HAL cycle, in the order of JOINTS.

        Args:
            cycle: HAL cycle.
        """
        return [int(word) for leg in self._legs for row in leg.word[leg.cycle == cycle] for word in row]

    def first_enabled(self) -> int | None:
        """Return the first HAL cycle with a command that enables the operation of a drive; None if there is none."""
        cycles = [leg.cycle[(leg.word == Controlword.ENABLE_OPERATION).any(axis=1)] for leg in self._legs]
        return min((int(one[0]) for one in cycles if len(one)), default=None)

    def torque_of(self, joint: int) -> tuple[npt.NDArray[np.int64], Vector]:
        """Return the HAL cycle and the target torque of every command of a joint.

        Args:
            joint: index into JOINTS.

        Returns:
            Cycles and torques [Nm], each of shape (n,).
        """
        leg = self._legs[joint // len(LEG_JOINTS)]
        return leg.cycle, leg.torque[:, joint % len(LEG_JOINTS)]

    def limit_of(self, joint: int) -> tuple[npt.NDArray[np.int64], Vector]:
        """Return the HAL cycle and the torque limit of every command of a joint.

        Args:
            joint: index into JOINTS.

        Returns:
            Cycles and torque limits [Nm], each of shape (n,).
        """
        leg = self._legs[joint // len(LEG_JOINTS)]
        return leg.cycle, leg.limit[:, joint % len(LEG_JOINTS)]

    def largest_step(self, joint: int) -> float:
        """Return the largest change [Nm] of a joint's target torque between consecutive cycles whose commands enable the drive.

        Args:
            joint: index into JOINTS.
        """
        leg, column = self._legs[joint // len(LEG_JOINTS)], joint % len(LEG_JOINTS)
        steps = np.abs(np.diff(leg.torque[:, column]))[leg.consecutive()[:, column]]
        return float(steps.max(initial=0.0))

    def violations(self, robot: Robot, drive_state: Vector | None = None) -> list[str]:
        """Return the errors in the sent frames as sentences: wrong CAN identifiers and wrong torques.

        Each identifier that the HAL must not send gives one sentence. Each leg gives at most one sentence for each of four
        errors: torque too large, torque limit too large, torque change too large, torque with QUICK STOP.

        Args:
            robot: torque limits of the joints.
            drive_state: true states of the drives, shape (cycles, 12). Row k belongs to HAL cycle k + 1. If given, a torque
                change counts only if the drive is in OPERATION ENABLED before and after the change, because a drive in any other
                state ignores the torque.
        """
        found = [
            f"the HAL must send only its own identifiers, got {can_id:#x}" for can_id in self._foreign_ids.tolist()
        ]
        for number, leg in enumerate(self._legs):
            joints = slice(number * len(LEG_JOINTS), (number + 1) * len(LEG_JOINTS))
            largest, rate = robot.torque_max[joints], robot.torque_rate_max[joints]
            stopped = leg.word == Controlword.QUICK_STOP
            both = leg.consecutive()
            if drive_state is not None:
                enabled = drive_state[leg.cycle - 1, joints] == DriveState.OPERATION_ENABLED
                both &= enabled[1:] & enabled[:-1]
            step = np.abs(np.diff(leg.torque, axis=0))
            for violation, wrong, cycles in (
                ("a torque above the joint's limit", np.abs(leg.torque) > largest + _RESOLUTION, leg.cycle),
                ("a torque limit above the joint's limit", leg.limit > largest + _RESOLUTION, leg.cycle),
                ("a torque with QUICK STOP", stopped & (leg.torque != 0.0), leg.cycle),
                (
                    "a torque change above the joint's rate limit",
                    both & (step > rate * _PERIOD + _RESOLUTION),
                    leg.cycle[1:],
                ),
            ):
                if wrong.any():
                    row, joint = (int(index) for index in np.argwhere(wrong)[0])
                    found.append(f"{violation} was sent to {SIDES[number]}_{LEG_JOINTS[joint]} in cycle {cycles[row]}")
        return found


def _decode(words: npt.NDArray[np.uint64], signal: Signal) -> Vector:
    """Return the physical values of a signal, shape (n,). `words` are the payloads as 64-bit words, shape (n, 8)."""
    raw = words[:, signal.start // 64] >> np.uint64(signal.start % 64) & np.uint64((1 << signal.length) - 1)
    values = raw.astype(np.int64)
    if signal.signed:
        values -= (values >> signal.length - 1 & 1) << signal.length
    return np.asarray(values * signal.factor + signal.offset, np.float64)
