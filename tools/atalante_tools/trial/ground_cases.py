"""Cases of the experiment `faults`: the cases of the fault matrix, and cases that need a robot on the ground."""

from __future__ import annotations

from typing import Final

from atalante_emulator.faults import Fault
from atalante_hal.dbc_names import FOOT_NODES, TRUNK_NODES
from atalante_hal.robot import CELLS
from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.scenario import MID_SWING, Case, HostFault, invalid_code
from atalante_tools.trial.fault_plan import PERMANENT


def _no_load(*feet: str) -> tuple[Fault, ...]:
    """Return faults that set the vertical force of all cells of the given feet to zero."""
    return tuple(Fault("value", f"{foot}_STATE", 0, None, **{f"{cell}_ForceZ": 0.0 for cell in CELLS}) for foot in feet)


def _invalid(foot: str) -> Fault:
    """Return a fault in which all cells of a foot send the code that marks their vertical force as invalid."""
    message, signals = f"{foot}_STATE", [f"{cell}_ForceZ" for cell in CELLS]
    return Fault("raw", message, 0, None, **{signal: invalid_code(message, signal) for signal in signals})


#: Fault ID -> cases that are possible only in a walk on the ground.
#: In fault F41, the HAL is killed. The HAL of a trial runs in the process of the trial, so the HAL pauses for 6 s instead.
#: A pause has the same effect on the drives as a killed HAL: the drives receive no frames.
#: After the pause, the HAL is in HOLD and does not move the robot.
_GROUND_CASES: Final = {
    "F12": (Case("both feet", tuple(_invalid(foot) for foot in FOOT_NODES)),),
    "F19": (
        Case("both IMUs of the trunk", tuple(Fault("silence", imu) for imu in TRUNK_NODES)),
        Case("both feet", tuple(Fault("silence", foot) for foot in FOOT_NODES)),
    ),
    "F30": (Case("both IMUs of the trunk", tuple(Fault("imu_invalid", imu) for imu in TRUNK_NODES)),),
    "F34": (
        Case("both feet report no load", _no_load(*FOOT_NODES)),
        *(Case(f"{foot} reports no load", _no_load(foot), dtc="FOOT_CELL") for foot in FOOT_NODES),
    ),
    "F41": (Case("no frames for 6 s", (HostFault("late", 0, 1, 6.0),), dtc="CYCLE_GAP"),),
    "F80": (
        Case(
            "wrong sign of IMU_TORSO along X after the loss of IMU_PELVIS",
            (Fault("imu_invalid", "IMU_PELVIS"), Fault("imu_inverted", "IMU_TORSO", 50, axis="X")),
            first_faulty=50,
        ),
    ),
}
#: IDs of all faults with a case.
FAULT_IDS: Final = tuple(sorted({*SCENARIOS, *_GROUND_CASES}))


def ground_cases(id_: str) -> dict[int, Case]:
    """Return the cases of a fault that can begin at any moment of a walk, as a mapping from index to case.

    Cases that begin at power-on or at another phase than `MID_SWING` are left out, and so are cases for a suspended robot.

    Args:
        id_: fault ID, one of `FAULT_IDS`.
    """
    scenario = SCENARIOS.get(id_)
    cases = (*(() if scenario is None else scenario.cases), *_GROUND_CASES.get(id_, ()))
    chosen = {index: case for index, case in enumerate(cases) if case.phase == MID_SWING and not case.suspended}
    if scenario is not None and scenario.permanent is not None:
        chosen[PERMANENT] = scenario.permanent
    return chosen
