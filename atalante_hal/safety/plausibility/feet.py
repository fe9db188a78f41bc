"""Foot checks, which compare the force cells of a foot with each other, and the ground contact of both feet.

*Cell.* A foot is a rigid plate on four cells. A cell is stuck or dead if it carries load while the other three are free, or if it
is free while the other three carry load, for longer than the foot can rock. A cell without noise is detected sooner by
`stillness`.

*Contact.* Walking has no flight phase. So a robot that stood on the ground cannot swing both feet. Both feet may swing if the
robot has been suspended since the program began, or after it has been lifted for `LIFTED_CYCLES`. A robot that was lifted is in
HOLD and requires a new START.
"""

from __future__ import annotations

from atalante_hal.robot import CELLS, FEET, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.finding import FOOT_NODES, Signals

#: Time after which a cell that contradicts the other cells counts as faulty [cycles].
CELL_CYCLES = 256
#: Time after which a swing of both feet counts as implausible [cycles].
SWING_CYCLES = 20
#: Time without ground contact after which the robot counts as lifted on purpose [cycles].
LIFTED_CYCLES = 100


class FootChecks:
    """Checks of the two feet.

    Args:
        robot: sensor thresholds of the robot.
        now: signals decoded in this cycle.
        every: interval between two calls of `judge` [cycles].
    """

    def __init__(self, robot: Robot, now: Signals, every: int) -> None:
        self._force, self._forces = now.force, now.forces
        self._free, self._loaded = robot.sensors.cell_free, robot.sensors.cell_loaded
        self._every = every
        # No cell carries load if the sum of the squares of all force components is at most this value [N^2].
        self._surely_free = self._free**2
        #: Index of the swing leg in FEET; None unless exactly one foot is on the ground.
        self.swing: int | None = None
        self._swinging = LIFTED_CYCLES  # time since a foot was last on the ground [cycles]
        # Time for which each cell has contradicted the other cells of its foot [cycles].
        self._contradicts = [[0] * len(CELLS) for _ in FEET]
        #: (foot, cell) -> vertical force [N] of each cell that contradicts the other cells.
        self.cells: dict[tuple[int, int], float] = {}

    def judge(self, updated: tuple[bool, bool]) -> bool:
        """Check the vertical forces of both feet.

        Args:
            updated: whether the left and the right foot have new values since the last call. The cells of a foot are checked
                only if it has new values.

        Returns:
            Whether a cell or the ground contact is implausible.
        """
        lifted = self._swinging >= LIFTED_CYCLES
        if lifted and self._forces.dot(self._forces) <= self._surely_free and not any(map(any, self._contradicts)):
            return False
        on_ground = []
        for foot, cells in enumerate(self._force[:, :, 2].tolist()):
            carries = [abs(force) > self._free for force in cells]
            on_ground.append(sum(carries) >= 2)
            if updated[foot]:
                self._judge_cells(foot, cells, carries)
        self.swing = None if on_ground[0] == on_ground[1] else on_ground.index(False)
        self._swinging = 0 if any(on_ground) else self._swinging + self._every
        return bool(self.cells) or self._both_swing()

    def _both_swing(self) -> bool:
        return SWING_CYCLES <= self._swinging < LIFTED_CYCLES

    def _judge_cells(self, foot: int, cells: list[float], carries: list[bool]) -> None:
        for cell, force in enumerate(cells):
            others = sum(carries) - carries[cell]
            alone = carries[cell] and others == 0
            missing = not carries[cell] and others == len(CELLS) - 1 and sum(cells) - force > self._loaded
            counts = self._contradicts[foot]
            counts[cell] = counts[cell] + self._every if alone or missing else 0
            if counts[cell] >= CELL_CYCLES:
                self.cells.setdefault((foot, cell), force)
            else:
                self.cells.pop((foot, cell), None)

    def findings(self) -> tuple[Finding, ...]:
        """Return the present findings."""
        cells = tuple(_contradicting(foot, cell, force) for (foot, cell), force in self.cells.items())
        return (*cells, _BOTH_SWING) if self._both_swing() else cells


def _contradicting(foot: int, cell: int, force: float) -> Finding:
    text = f"force cell {CELLS[cell]} of the {FEET[foot]} foot reports {force:.0f} N, which contradicts the other three cells"
    return Finding(Dtc.FOOT_CELL, FOOT_NODES[foot], force, True, text)


_BOTH_SWING = Finding(
    Dtc.CONTACT_IMPLAUSIBLE, FOOT_NODES[0], float(SWING_CYCLES), True, Dtc.CONTACT_IMPLAUSIBLE.meaning
)
