"""A witness on the wire: every command frame that left the HAL, decoded from the DBC's bit positions and judged by the limits.

Shares nothing with the limiter, the codec and the process image: it would notice if one of them were wrong.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message, Network, Signal
from atalante_hal.robot import LEG_JOINTS, SIDES, Robot
from atalante_hal.wire.cia402 import Controlword
from atalante_hal.wire.frame import FRAME, Frames

Vector = npt.NDArray[np.float64]
#: Torque step of the wire [Nm]: a limit that falls between two codes is met by the nearer one.
_RESOLUTION: Final = 0.0125
_PERIOD: Final = 1e-3  # s


class Witness:
    """A `FrameTap` that keeps what the HAL sends, and when."""

    def __init__(self) -> None:
        self.cycle = 0  # of what is sent next; set by the owner
        self._cycles: list[int] = []
        self._sizes: list[int] = []
        self._memory = bytearray()

    def sent(self, frames: Frames) -> None:
        """Frames just handed to the bus."""
        self._memory += frames.tobytes()
        self._sizes.append(len(frames))
        self._cycles.append(self.cycle)

    def received(self, frames: Frames, count: int) -> None:
        """What the nodes say is not judged here."""

    def frames(self) -> tuple[npt.NDArray[np.int64], Frames]:
        """Cycle of each frame that left, and the frames. Shapes (n,)."""
        return np.repeat(self._cycles, self._sizes).astype(np.int64), np.frombuffer(bytes(self._memory), FRAME)


class _Leg:
    """The command frames of one leg: cycle (n,), and per signal (n, 6)."""

    def __init__(self, message: Message, cycles: npt.NDArray[np.int64], frames: Frames) -> None:
        mine = (frames["can_id"] == message.frame_id) & (frames["len"] == message.length)
        self.cycle = cycles[mine]
        words = np.ascontiguousarray(frames["data"][mine]).view("<u8")
        self.word, self.torque, self.limit = (
            np.column_stack([_decode(words, message.signal(f"{joint}_{name}")) for joint in LEG_JOINTS])
            for name in ("Controlword", "TargetTorque", "MaxTorque")
        )


class Commands:
    """Every command of a run by cycle and joint, and what was wrong with it."""

    def __init__(self, network: Network, cycles: npt.NDArray[np.int64], frames: Frames) -> None:
        """From frames the HAL sent, and the cycle of each. Shapes (n,)."""
        legs = [network.message(f"COMMAND_{side.upper()}_LEG") for side in SIDES]
        self._legs = [_Leg(message, cycles, frames) for message in legs]
        own = [message.frame_id for message in network.sent_by("HAL")]
        self._strange = np.setdiff1d(frames["can_id"], own)

    def words(self, cycle: int) -> list[int]:
        """Controlwords sent in a cycle, in the order of JOINTS; fewer if a leg got no frame."""
        return [int(word) for leg in self._legs for row in leg.word[leg.cycle == cycle] for word in row]

    def torque_of(self, joint: int) -> tuple[npt.NDArray[np.int64], Vector]:
        """Cycles and torque [Nm] of every command of a joint of JOINTS. Shapes (n,)."""
        leg = self._legs[joint // len(LEG_JOINTS)]
        return leg.cycle, leg.torque[:, joint % len(LEG_JOINTS)]

    def limit_of(self, joint: int) -> tuple[npt.NDArray[np.int64], Vector]:
        """As `torque_of`, the torque limit that was sent along."""
        leg = self._legs[joint // len(LEG_JOINTS)]
        return leg.cycle, leg.limit[:, joint % len(LEG_JOINTS)]

    def outside(self, robot: Robot) -> list[str]:
        """One sentence for each way in which a command left that must not: identifier, torque, its rate, torque while stopped."""
        found = [f"the HAL sent identifier {can_id:#x}, which is not its own" for can_id in self._strange.tolist()]
        for number, leg in enumerate(self._legs):
            joints = slice(number * len(LEG_JOINTS), (number + 1) * len(LEG_JOINTS))
            largest, rate = robot.torque_max[joints], robot.torque_rate_max[joints]
            stopped = leg.word == Controlword.QUICK_STOP
            enabled = leg.word == Controlword.ENABLE_OPERATION
            both = enabled[1:] & enabled[:-1] & (np.diff(leg.cycle) == 1)[:, None]
            step = np.abs(np.diff(leg.torque, axis=0))
            for what, wrong, cycles in (
                ("a torque beyond the joint's limit", np.abs(leg.torque) > largest + _RESOLUTION, leg.cycle),
                ("a torque limit beyond the joint's", leg.limit > largest + _RESOLUTION, leg.cycle),
                ("a torque with QUICK STOP", stopped & (leg.torque != 0.0), leg.cycle),
                ("a torque step beyond the joint's rate", both & (step > rate * _PERIOD + _RESOLUTION), leg.cycle[1:]),
            ):
                if wrong.any():
                    row, joint = (int(index) for index in np.argwhere(wrong)[0])
                    found.append(f"{what} left for {SIDES[number]}_{LEG_JOINTS[joint]} in cycle {cycles[row]}")
        return found


def _decode(words: npt.NDArray[np.uint64], signal: Signal) -> Vector:
    """Physical values of a signal that lies within one 64-bit word. Words (n, 8), result (n,)."""
    raw = words[:, signal.start // 64] >> np.uint64(signal.start % 64) & np.uint64((1 << signal.length) - 1)
    values = raw.astype(np.int64)
    if signal.signed:
        values -= (values >> signal.length - 1 & 1) << signal.length
    return np.asarray(values * signal.factor + signal.offset, np.float64)
