"""Tests of the check of sent commands: it decodes as cantools does and reports every kind of violation."""

from __future__ import annotations

import cantools.database
import numpy as np
import pytest

import atalante_dbc
from atalante_dbc import Network
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.frame import Frames
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.faults.command_check import Commands, SentFrames

KNEE = JOINTS.index("left_SK")
HIP = JOINTS.index("right_SH")


class Hal:
    """Seal commands with any values and record them as sent."""

    def __init__(self, network: Network) -> None:
        self.tx = TransmitImage([network.message(f"COMMAND_{side}_LEG") for side in ("LEFT", "RIGHT")])
        codec = self.tx.codec
        self.torque, self.word, self.limit = (
            self.tx.values[codec.slice(name)] for name in ("TargetTorque", "Controlword", "MaxTorque")
        )
        self.recorded = SentFrames()
        self.network = network

    def send(self, cycle: int) -> None:
        self.recorded.cycle = cycle
        self.recorded.sent(self.tx.seal())

    def commands(self) -> Commands:
        return Commands(self.network, *self.recorded.frames())


@pytest.fixture
def hal(network: Network, robot: Robot) -> Hal:
    made = Hal(network)
    made.word[:], made.limit[:] = Controlword.ENABLE_OPERATION, robot.torque_max
    return made


def test_decoded_torques_agree_with_cantools(hal: Hal) -> None:
    random = np.random.default_rng(1)
    database = cantools.database.load_file(atalante_dbc.DBC_FILE)
    frames: list[Frames] = []
    for cycle in range(1, 20):
        hal.torque[:] = random.uniform(-80, 80, 12)
        hal.send(cycle)
        frames.append(hal.tx.frames.copy())
    for joint, name in enumerate(JOINTS):
        cycles, torque = hal.commands().torque_of(joint)
        assert cycles.tolist() == list(range(1, 20))
        leg = joint // 6
        expected = [
            database.decode_message(int(f["can_id"][leg]), f["data"][leg, : f["len"][leg]].tobytes())[
                f"{name.split('_')[1]}_TargetTorque"
            ]
            for f in frames
        ]
        assert torque == pytest.approx(expected, abs=1e-9)


def test_valid_commands_have_no_violations(hal: Hal, robot: Robot) -> None:
    for cycle in range(1, 30):
        hal.torque[:] = np.minimum(robot.torque_max, 0.9 * cycle * robot.torque_rate_max * 1e-3)
        hal.send(cycle)
    hal.word[:], hal.torque[:] = Controlword.QUICK_STOP, 0.0  # QUICK_STOP: the torque may fall to 0 at once
    hal.send(30)
    assert hal.commands().violations(robot) == []
    assert hal.commands().words(29) == [Controlword.ENABLE_OPERATION] * 12
    assert hal.commands().words(30) == [Controlword.QUICK_STOP] * 12
    assert hal.commands().words(31) == []


def test_torque_limit_rate_and_quick_stop_violations_are_reported(hal: Hal, robot: Robot) -> None:
    hal.send(1)
    hal.torque[KNEE] = robot.torque_max[KNEE] + 0.1
    hal.send(2)
    hal.limit[HIP] = robot.torque_max[HIP] + 0.1
    hal.send(3)
    hal.word[HIP], hal.torque[HIP] = Controlword.QUICK_STOP, 0.1
    hal.send(4)
    assert hal.commands().violations(robot) == [
        "a torque above the joint's limit was sent to left_SK in cycle 2",
        "a torque change above the joint's rate limit was sent to left_SK in cycle 2",
        "a torque limit above the joint's limit was sent to right_SH in cycle 3",
        "a torque with QUICK STOP was sent to right_SH in cycle 4",
    ]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_step_is_bounded_by_the_rate_limit_of_the_joint(hal: Hal, robot: Robot, sign: float) -> None:
    step = sign * robot.torque_rate_max * 1e-3
    hal.send(1)
    hal.torque[:] = step
    hal.send(2)
    assert hal.commands().violations(robot) == []
    hal.torque[:] = 3.0 * step
    hal.send(3)
    assert hal.commands().violations(robot) == [
        f"a torque change above the joint's rate limit was sent to {side}_{JOINTS[0].split('_')[1]} in cycle 3"
        for side in ("left", "right")
    ]


@pytest.mark.parametrize(("states", "found"), [("77", 0), ("47", 0), ("74", 0), ("44", 1)])
def test_torque_step_counts_only_for_a_drive_that_is_enabled(hal: Hal, robot: Robot, states: str, found: int) -> None:
    """A digit is the state of the drive in a cycle: 4 is OPERATION ENABLED, 7 is QUICK STOP ACTIVE."""
    names = {"4": DriveState.OPERATION_ENABLED, "7": DriveState.QUICK_STOP_ACTIVE}
    drive_state = np.full((2, len(JOINTS)), float(DriveState.OPERATION_ENABLED))
    drive_state[:, KNEE] = [names[state] for state in states]
    hal.send(1)
    hal.torque[KNEE] = 100.0
    hal.send(2)
    assert len(hal.commands().violations(robot, drive_state)) == found


def test_torque_step_over_missing_frames_is_no_violation(hal: Hal, robot: Robot) -> None:
    hal.send(1)
    hal.torque[KNEE] = 100.0
    hal.send(5)
    assert hal.commands().violations(robot) == []


def test_identifier_of_another_node_is_reported(hal: Hal, network: Network, robot: Robot) -> None:
    hal.recorded.sent(TransmitImage([network.message("LEFT_SK_STATE")]).seal())
    assert hal.commands().violations(robot) == ["the HAL must send only its own identifiers, got 0x184"]
