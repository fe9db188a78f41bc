"""Requirements for the node under test (drive, IMU, foot, haptics node or pendant), in the order of the tests."""

from __future__ import annotations

from atalante_hal.wire.cia402 import Controlword
from atalante_tools.conform import any_node, drive, drive_states, haptics, pendant, sensor
from atalante_tools.conform.axis import Axis
from atalante_tools.conform.node_tester import NodeTester
from atalante_tools.conform.requirement import Requirement

_REQUIREMENTS = {
    "drive": drive.requirements,
    "imu": sensor.imu_requirements,
    "foot": sensor.foot_requirements,
    "haptics": haptics.requirements,
    "pendant": pendant.requirements,
}


def requirements_of(tester: NodeTester) -> list[Requirement]:
    """Return the requirements for the node under test, in the order of the tests.

    The requirements at start-up and at rest come first. The requirements for the kind of the node, such as drive or IMU,
    come next. The requirements for all received frames come last.
    """
    before, after = any_node.requirements_at_rest(tester), any_node.requirements_on_all_frames(tester)
    special = _REQUIREMENTS[tester.node.kind](tester)
    # DRIVE-01 tests the state after start-up, so it must run before the first command.
    early = 1 if tester.node.kind == "drive" else 0
    return [before[0], *special[:early], *before[1:], *special[early:], *after]


def make_safe(tester: NodeTester) -> None:
    """Bring the drive under test to QUICK STOP ACTIVE; do nothing for other nodes."""
    if tester.node.kind == "drive":
        Axis(tester).run(drive_states.STOP, Controlword.QUICK_STOP)
