"""Foot checks, which detect faulty force cells and an impossible loss of ground contact.

*Cell.* A sole is a rigid plate on four equal cells. Its load has three degrees of freedom: the force and two moments. So the
two diagonals of the cells carry equal vertical forces: FL + RR = FR + RL, also where a cell is pulled. A fault of one cell
changes the difference by the error of the cell. A difference above `cell_twist` for `CELL_CYCLES` is a fault. The faulty cell
is known if it is the only cell with load, or the only cell without load. A cell whose reading is exactly
constant is detected earlier, by the module `stillness`.

*Pull.* The floor cannot pull a foot. If the cells of a foot do not contradict each other, a sum of their forces below
-2 `cell_free` for `CELL_CYCLES` is therefore a fault. The check detects two faults: a wrong sign of all cells, as soon as the
foot is on the ground, and a negative offset of all cells, as soon as the foot carries no load.

*Contact.* Walking has no flight phase. So a robot that stood on the ground cannot swing both feet. The check is armed after
both feet have carried load together for `STANDING_CYCLES`. A robot on a crane that touches the floor for a shorter time does
not arm the check. The check is disarmed if the robot has been lifted for `LIFTED_CYCLES`. A lifted robot is in HOLD and requires
a new START. While a foot sends no values, it may be on the ground although its last values show no load. So this time does not
count as a swing of both feet. But the time counted before is kept, so a foot with frequent losses cannot prevent the detection.
"""

from __future__ import annotations

from collections.abc import Iterator

from atalante_hal.dbc_names import FOOT_NODES
from atalante_hal.robot import CELLS, FEET, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.signals import Signals

#: Time for which the cells of a foot must contradict each other, or report a pull, before the fault is reported [cycles].
CELL_CYCLES = 256
#: Time for which both feet must carry load together before the check for two swinging feet begins [cycles].
STANDING_CYCLES = 500
#: Time after which a swing of both feet is a fault [cycles]. If a foot lands late in a walk, both feet swing for 30 cycles.
SWING_CYCLES = 60
#: Time without ground contact after which the robot is regarded as lifted on purpose [cycles].
LIFTED_CYCLES = 140


class FootChecks:
    """Checks of the two feet.

    Args:
        robot: sensor thresholds of the robot.
        now: signals decoded in this cycle.
        every: interval between two calls of `evaluate` [cycles].
    """

    def __init__(self, robot: Robot, now: Signals, every: int) -> None:
        self._force, self._forces = now.force, now.forces
        self._free, self._twist = robot.sensors.cell_free, robot.sensors.cell_twist
        self._every = every
        # Largest sum of the squares of all force components at which certainly no cell carries load [N^2].
        self._free_squared = self._free**2
        #: Index of the swing leg in FEET; None if both feet or no foot is on the ground.
        self.swing: int | None = None
        # Time for which no foot has been on the ground [cycles]. It does not grow while a foot has no new values.
        self._swinging = LIFTED_CYCLES
        self._standing = 0  # time for which both feet have been on the ground [cycles]
        # True if the check for two swinging feet is active: after the robot stood on both feet, until the robot is lifted.
        self._armed = False
        # Time for which the cells of each foot have contradicted each other [cycles].
        self._contradicts = [0] * len(FEET)
        #: Foot with contradicting cells -> force FL + RR - FR - RL [N], and index of the faulty cell (None if it is unknown).
        self._twisted: dict[int, tuple[float, int | None]] = {}
        self._pulls = [0] * len(FEET)  # time for which each foot has reported that the floor pulls it [cycles]
        self._pulled: dict[int, float] = {}  # foot that reports a pull for too long -> sum of its vertical forces [N]

    def evaluate(self, updated: tuple[bool, bool]) -> bool:
        """Check the vertical forces of both feet.

        Args:
            updated: whether each foot (left, right) has new values since the last call. The cells of a foot are checked
                only if the foot has new values. A swing of both feet is counted only if both have new values.

        Returns:
            Whether a cell or the ground contact is implausible.
        """
        lifted = self._swinging >= LIFTED_CYCLES
        if lifted and self._forces.dot(self._forces) <= self._free_squared and not any(self._contradicts + self._pulls):
            return False
        on_ground = []
        free = self._free
        for foot, cells in enumerate(self._force[:, :, 2].tolist()):
            front_left, front_right, rear_left, rear_right = cells
            carrying = (abs(front_left) > free) + (abs(front_right) > free)
            carrying += (abs(rear_left) > free) + (abs(rear_right) > free)
            on_ground.append(carrying >= 2)
            if updated[foot]:
                self._check_cells(foot, cells)
        self.swing = None if on_ground[0] == on_ground[1] else on_ground.index(False)
        if any(on_ground):
            self._swinging = 0
        elif all(updated):
            self._swinging += self._every
        self._standing = self._standing + self._every if all(on_ground) else 0
        if self._standing >= STANDING_CYCLES:
            self._armed = True
        elif self._swinging >= LIFTED_CYCLES:
            self._armed = False
        return bool(self._twisted or self._pulled) or self._both_swing()

    @property
    def cells(self) -> Iterator[tuple[int, int]]:
        """Yield (foot, cell) of each faulty cell that is known."""
        return ((foot, cell) for foot, (_, cell) in self._twisted.items() if cell is not None)

    def _both_swing(self) -> bool:
        return self._armed and self._swinging >= SWING_CYCLES

    def _check_cells(self, foot: int, cells: list[float]) -> None:
        front_left, front_right, rear_left, rear_right = cells
        twist = front_left + rear_right - front_right - rear_left
        self._contradicts[foot] = self._contradicts[foot] + self._every if abs(twist) > self._twist else 0
        if self._contradicts[foot] >= CELL_CYCLES:
            if foot not in self._twisted or self._twisted[foot][1] is None:
                self._twisted[foot] = twist, _deviating_cell([abs(force) > self._free for force in cells])
        else:
            self._twisted.pop(foot, None)
        load = sum(cells)
        pulled = abs(twist) <= self._twist and load < -2.0 * self._free
        self._pulls[foot] = self._pulls[foot] + self._every if pulled else 0
        if self._pulls[foot] >= CELL_CYCLES:
            self._pulled.setdefault(foot, load)
        else:
            self._pulled.pop(foot, None)

    def findings(self) -> tuple[Finding, ...]:
        """Return the current findings of the foot checks."""
        cells = (
            *(_contradicting(foot, *twisted) for foot, twisted in self._twisted.items()),
            *(_pulling(foot, load) for foot, load in self._pulled.items()),
        )
        return (*cells, _BOTH_SWING) if self._both_swing() else cells


def _deviating_cell(carries: list[bool]) -> int | None:
    """Return the index of the only loaded cell or of the only unloaded cell. Return None if there is no such cell.

    Args:
        carries: whether each cell of a foot carries load.
    """
    for odd in (True, False):
        if carries.count(odd) == 1:
            return carries.index(odd)
    return None


def _contradicting(foot: int, twist: float, cell: int | None) -> Finding:
    which = "the force cells" if cell is None else f"force cell {CELLS[cell]}"
    contradict = "contradict each other" if cell is None else "contradicts the other three cells"
    text = f"{which} of the {FEET[foot]} foot {contradict}: the diagonals of the cells differ by {abs(twist):.0f} N"
    return Finding(Dtc.FOOT_CELL, FOOT_NODES[foot], twist, True, text)


def _pulling(foot: int, load: float) -> Finding:
    text = f"the force cells of the {FEET[foot]} foot report {load:.0f} N in total, but the floor cannot pull"
    return Finding(Dtc.FOOT_CELL, FOOT_NODES[foot], load, True, text)


_BOTH_SWING = Finding(
    Dtc.CONTACT_IMPLAUSIBLE, FOOT_NODES[0], float(SWING_CYCLES), True, "neither foot reports a load on the ground"
)
