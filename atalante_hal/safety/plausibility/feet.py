"""Force cells against each other, and the two feet against the ground.

*Cell.* A foot is a rigid plate on four cells. One that carries while the other three are free, or that is free while the other
three carry a load, for longer than any rocking of the foot, is stuck or dead. (One without its noise is found sooner, see
`stillness`.) *Contact.* Who has stood on the ground does not have both feet off it: walking has no flight. Who hangs from the
start may swing both, and who is lifted off may do so after `LIFTED_CYCLES`, when the operator starts again.
"""

from __future__ import annotations

from atalante_hal.robot import CELLS, FEET, Robot
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.finding import FOOT_NODES, Finding, Signals

#: Cycles in which a cell has to contradict the others, both feet have to swing, and after which they swing on purpose.
CELL_CYCLES = 256
SWING_CYCLES = 20
LIFTED_CYCLES = 100


class Feet:
    """The two feet.

    Args:
        now: what was decoded in this cycle.
        every: cycles between two calls of `judge`.
    """

    def __init__(self, robot: Robot, now: Signals, every: int) -> None:
        self._force, self._forces = now.force, now.forces
        self._free, self._loaded = robot.sensors.cell_free, robot.sensors.cell_loaded
        self._every = every
        # Less than the square of all that a free cell may say: no cell carries.
        self._surely_free = self._free**2
        #: Leg that swings while the other one stands, by its place in FEET; None: none does.
        self.swing: int | None = None
        self._swinging = LIFTED_CYCLES  # cycles since a foot stood last
        self._contradicts = [[0] * len(CELLS) for _ in FEET]  # cycles in which a cell has contradicted the others
        #: Cells that contradict the others: (foot, cell) -> N.
        self.cells: dict[tuple[int, int], float] = {}

    def judge(self, heard: tuple[bool, bool]) -> bool:
        """Look at the vertical forces.

        Args:
            heard: since the last call, left and right foot; one that was not is as it was.

        Returns:
            Whether something is implausible.
        """
        lifted = self._swinging >= LIFTED_CYCLES
        if lifted and self._forces.dot(self._forces) <= self._surely_free and not any(map(any, self._contradicts)):
            return False
        stands = []
        for foot, cells in enumerate(self._force[:, :, 2].tolist()):
            carries = [abs(force) > self._free for force in cells]
            stands.append(sum(carries) >= 2)
            if heard[foot]:
                self._judge_cells(foot, cells, carries)
        self.swing = None if stands[0] == stands[1] else stands.index(False)
        self._swinging = 0 if any(stands) else self._swinging + self._every
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
        """What stands."""
        cells = tuple(_contradicting(foot, cell, force) for (foot, cell), force in self.cells.items())
        return (*cells, _BOTH_SWING) if self._both_swing() else cells


def _contradicting(foot: int, cell: int, force: float) -> Finding:
    text = f"force cell {CELLS[cell]} of the {FEET[foot]} foot says {force:.0f} N, which contradicts the other three"
    return Finding(Dtc.FOOT_CELL, FOOT_NODES[foot], force, True, text)


_BOTH_SWING = Finding(
    Dtc.CONTACT_IMPLAUSIBLE, FOOT_NODES[0], float(SWING_CYCLES), True, "both feet say that they swing on the ground"
)
