"""Which requirements a node has, in the order in which they are tested."""

from __future__ import annotations

from atalante_hal.wire.cia402 import Controlword
from atalante_tools.conform import any_node, drive, drive_states, haptics, pendant, sensor
from atalante_tools.conform.axis import Axis
from atalante_tools.conform.bench import Bench
from atalante_tools.conform.requirement import Requirement

_OF_KIND = {
    "drive": drive.requirements,
    "imu": sensor.imu_requirements,
    "foot": sensor.foot_requirements,
    "haptics": haptics.requirements,
    "pendant": pendant.requirements,
}


def requirements_of(bench: Bench) -> list[Requirement]:
    """Everything asked of the node on the bench: start-up and rest, its own trade, then what holds for every frame."""
    before, after = any_node.requirements(bench)
    special = _OF_KIND[bench.node.kind](bench)
    # A drive's first requirement is about its start, before anything is tried on it.
    early = 1 if bench.node.kind == "drive" else 0
    return [before[0], *special[:early], *before[1:], *special[early:], *after]


def make_safe(bench: Bench) -> None:
    """Leave a drive in its hold, however the examination ended; other nodes need nothing."""
    if bench.node.kind == "drive":
        Axis(bench).run(drive_states.STOP, Controlword.QUICK_STOP)
