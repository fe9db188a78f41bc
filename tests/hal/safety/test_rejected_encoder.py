"""Faults of a drive whose encoder values are rejected: the reaction is that of a drive with correct encoder values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from atalante_emulator import emergency
from atalante_hal.robot import JOINTS
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import DriveState

S = SupervisorState
HIP = JOINTS.index("right_FH")
NODE = "RIGHT_FH"
#: Name of a rejection -> for each cycle from the fault on, whether the encoder jumps; and number of cycles with jumps before.
REJECTIONS: dict[str, tuple[Callable[[int], bool], int]] = {
    "one value": (lambda cycle: cycle == 0, 1),
    "last of four values": (lambda cycle: cycle <= 0, 3),
    "all values": (lambda cycle: True, 100),
    "every second value": (lambda cycle: cycle % 2 == 0, 100),
}


def fault(rig) -> None:
    rig.emulator.drives.leave(HIP, DriveState.FAULT)


def hot(rig) -> None:
    rig.emulator.drives.heat(HIP, 100.0)


def too_hot(rig) -> None:
    rig.emulator.drives.heat(HIP, 130.0)


def over_current(rig) -> None:
    rig.emulator.drives.fail(HIP, emergency.CURRENT, persists=True)


def rejected(rig, jumps: Callable[[int], bool], before: int, *, marked: bool = False) -> None:
    """Let the encoder of the hip jump in the given cycles. Cycle 0 follows after `before` cycles.

    If `marked` is True, the drive marks its position as invalid instead.
    """
    at = rig.emulator.signals.index(f"{NODE}_STATE", "Position")
    first = rig.hal.state.cycle + 1 + before

    def jump(cycle: int, values: np.ndarray) -> None:
        if jumps(cycle - first):
            values[at] = np.nan if marked else values[at] + 30.0

    rig.emulator.before_send.append(jump)
    rig.run(before)


def reaction(rig, code: str) -> tuple[int, float]:
    """Run until the code of a fault is reported. Return the number of cycles and the torque limit of the hip."""
    first = rig.hal.state.cycle
    for _ in range(10):
        rig.cycle()
        if any(event.code == code and event.node == NODE for event in rig.hal.events):
            break
    else:
        raise AssertionError(f"no {code}: {rig.codes()}")
    return rig.hal.state.cycle - first, rig.last_commands()["right"]["FH_MaxTorque"]


@pytest.mark.parametrize("marked", [False, True], ids=["jump", "invalid code"])
@pytest.mark.parametrize("rejection", REJECTIONS)
@pytest.mark.parametrize(
    ("cause", "code", "state"),
    [
        (fault, "DRIVE_FAULT", S.FAULT),
        (hot, "DERATED", None),
        (too_hot, "OVER_TEMP", S.LOWER),
        (over_current, "EMCY_2310", S.FAULT),
    ],
    ids=["fault", "hot", "too hot", "over-current"],
)
@pytest.mark.sample(5)
def test_f87_fault_of_a_drive_has_its_reaction_despite_rejected_encoder_values(
    make_rig, rejection, marked, cause, code, state
):
    found = []
    for jumps, before in (REJECTIONS[rejection], (lambda cycle: False, REJECTIONS[rejection][1])):
        rig = make_rig()
        rig.until(S.ACTIVE)
        rejected(rig, jumps, before, marked=marked)
        cause(rig)
        found.append(reaction(rig, code))
        if state is not None:
            assert rig.hal.state.supervisor is state
        assert rig.hal.state.temperature[HIP] == pytest.approx(rig.emulator.drives.motors.temperature[HIP], abs=1.0)
        assert rig.hal.state.drive_state[HIP] == rig.emulator.drives.signals.state[HIP]
    assert found[0] == found[1]
    assert found[0][0] == 1


def test_start_does_not_acknowledge_an_emergency_of_a_drive_in_fault_with_a_rejected_encoder(make_rig):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rejected(rig, lambda cycle: True, 10)
    too_hot(rig)
    rig.until(S.LOWER, 2)
    rig.run(300)
    rig.operator.start()
    assert rig.run(100).supervisor is S.LOWER
