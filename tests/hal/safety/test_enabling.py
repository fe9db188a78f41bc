"""Enabling of the drives at a start: no joint sags, in the air and on the crane, also with a slow drive or a drive that fails."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from atalante_control.model import ExoskeletonParameters, Patient, urdf
from atalante_emulator.faults import Fault
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_emulator.pendant import Operator
from atalante_hal.hal import Hal
from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.safety.direction import pose_gains
from atalante_hal.safety.start import STALLED_CYCLES, words_towards_operation
from atalante_hal.types import Command, SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.session.rig import Rig, open_hal

ROBOT = load_robot()
S, D, C = SupervisorState, DriveState, Controlword
#: Pose with large torques of the weight: thighs lifted, knees bent [rad].
POSE = [0.0, 0.0, -0.8, 0.9, -0.1, 0.0] * 2
#: Largest permitted motion of a joint while the drives are being enabled [rad].
SAG = np.radians(1.0)


def states(**joints: DriveState) -> np.ndarray:
    all_states = np.full(12, float(joints.pop("others")))
    for joint, state in joints.items():
        all_states[JOINTS.index(joint)] = state
    return all_states


@pytest.mark.parametrize(
    ("drive_state", "others", "knee"),
    [
        (states(others=D.SWITCH_ON_DISABLED), C.SHUTDOWN, C.SHUTDOWN),
        (states(others=D.QUICK_STOP_ACTIVE), C.ENABLE_OPERATION, C.ENABLE_OPERATION),
        (states(others=D.OPERATION_ENABLED, left_SK=D.QUICK_STOP_ACTIVE), C.ENABLE_OPERATION, C.ENABLE_OPERATION),
        (states(others=D.QUICK_STOP_ACTIVE, left_SK=D.SWITCH_ON_DISABLED), C.QUICK_STOP, C.SHUTDOWN),
        (states(others=D.OPERATION_ENABLED, left_SK=D.SWITCHED_ON), C.QUICK_STOP, C.ENABLE_OPERATION),
        (states(others=D.SWITCHED_ON, left_SK=D.READY_TO_SWITCH_ON), C.SWITCH_ON, C.SWITCH_ON),
        (states(others=D.SWITCHED_ON, left_SK=D.FAULT), C.SWITCH_ON, C.FAULT_RESET),
        (states(others=D.SWITCHED_ON, left_SK=D.QUICK_STOP_ACTIVE), C.ENABLE_OPERATION, C.QUICK_STOP),
        (states(others=D.SWITCHED_ON), C.ENABLE_OPERATION, C.ENABLE_OPERATION),
    ],
)
def test_drives_hold_until_all_produce_torque(drive_state: np.ndarray, others: Controlword, knee: Controlword):
    words = words_towards_operation(drive_state)
    assert words.pop(JOINTS.index("left_SK")) is knee
    assert set(words) == {others}


# -- sag of the emulated robot -----------------------------------------------------------------------------------------


class Started:
    """Robot that is cycled by hand: a pose hold while ACTIVE, HOLD otherwise."""

    def __init__(self, rig: Rig, operator: Operator) -> None:
        assert rig.emulator is not None
        self.hal: Hal = rig.hal
        self.operator = operator
        self.drives, self.body = rig.emulator.drives, rig.emulator.body
        self._anchor = np.zeros(12)

    def cycle(self) -> None:
        state = self.hal.read()
        if state.supervisor is S.ACTIVE:
            stiffness, damping = pose_gains(ROBOT)
            torque = stiffness * (self._anchor - state.position) - damping * state.velocity
            self.hal.write(Command(torque, np.zeros(8)))
        else:
            self._anchor = state.position.copy()
            self.hal.hold()

    def until(self, wanted: SupervisorState) -> None:
        for _ in range(600):
            self.cycle()
            if self.hal.state.supervisor is wanted:
                return
        raise AssertionError(f"not {wanted.name}: {self.hal.reason}")

    def start(self, cycles: int = 150) -> np.ndarray:
        """Press START and run; return the largest motion of each joint until the robot is ACTIVE, shape (12,) [rad]."""
        self.operator.start()
        before, moved = self.body.position.copy(), np.zeros(12)
        for _ in range(cycles):
            self.cycle()
            np.maximum(moved, np.abs(self.body.position - before), out=moved)
            if self.hal.state.supervisor is S.ACTIVE:
                break
        return moved


@contextmanager
def robot(mechanics: Mechanics | None, *faults: Fault, pose: list[float] = POSE) -> Iterator[Started]:
    operator = Operator(starts=False)
    with open_hal(
        Target(EMBEDDED, "", lockstep=True), pose=pose, operator=operator, faults=faults, mechanics=mechanics
    ) as rig:
        yield Started(rig, operator)


def crane(mass: float = 80.0) -> Mechanics:
    return Mechanics(urdf(ExoskeletonParameters(), ROBOT, Patient(mass, 1.75)), ground=Ground())


places = pytest.mark.parametrize("place", [lambda: None, crane], ids=["air", "crane"])


@places
@pytest.mark.parametrize("delay", [1, STALLED_CYCLES - 3])
def test_no_joint_sags_while_one_drive_is_slow(place, delay: int):
    with robot(place(), Fault("enable_delay", "LEFT_SH", 0, by=delay)) as started:
        started.until(S.READY)
        assert started.start().max() < SAG
        assert started.hal.state.supervisor is S.ACTIVE


@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize("delay", [1, 3])
def test_robot_stays_active_after_a_slow_drive_and_late_states(late: int, delay: int):
    """The states of the right leg arrive late, so they still show OPERATION ENABLED after a QUICK STOP was sent."""
    right = [joint.upper() for joint in JOINTS[6:]]
    states_late = [Fault("delay", f"{joint}_STATE", 0, by=late) for joint in right] if late else []
    with robot(None, Fault("enable_delay", "LEFT_SH", 0, by=delay), *states_late) as started:
        started.until(S.READY)
        started.start()
        assert started.hal.state.supervisor is S.ACTIVE
        for _ in range(50):
            started.cycle()
        assert started.hal.state.supervisor is S.ACTIVE, started.hal.reason


@places
def test_no_joint_sags_while_a_restarted_drive_is_slow(place):
    with robot(
        place(),
        Fault("enable_delay", "LEFT_SH", 0, by=STALLED_CYCLES - 3),
        Fault("reset", "LEFT_SH", 700, 3),
    ) as started:
        started.until(S.READY)
        started.start()
        started.until(S.ACTIVE)
        while started.hal.state.cycle < 800:
            started.cycle()
        assert started.hal.state.supervisor is S.HOLD
        assert started.start().max() < SAG
        assert started.hal.state.supervisor is S.ACTIVE


@places
@pytest.mark.parametrize("holds", [False, True], ids=["from READY", "from HOLD"])
def test_start_with_a_drive_that_never_enables_fails_without_sag(place, holds: bool):
    first = 700 if holds else 0
    faults = [Fault("enable_delay", "LEFT_SH", first, by=100_000)]
    if holds:
        faults.append(Fault("reset", "LEFT_SH", first, 3))
    with robot(place(), *faults) as started:
        started.until(S.READY)
        if holds:
            started.start()
            started.until(S.ACTIVE)
            while started.hal.state.cycle < 800:
                started.cycle()
        state, pressed = started.hal.state.supervisor, started.hal.state.cycle
        assert state is (S.HOLD if holds else S.READY)
        moved = started.start(40)
        (failed,) = [event for event in started.hal.events if event.code == "START_FAILED"]
        assert failed.cycle - pressed <= STALLED_CYCLES + 12
        assert failed.text == (
            f"the drives were not enabled and no drive changed its state for {STALLED_CYCLES} cycles: "
            "left_SH is in SWITCHED_ON"
        )
        assert started.hal.state.supervisor is state
        assert moved.max() < SAG
        # The drives return to their states before START: they hold in HOLD, and they are off in READY.
        others = D.QUICK_STOP_ACTIVE if holds else D.SWITCH_ON_DISABLED
        assert {D(s) for s in np.delete(started.drives.signals.state, JOINTS.index("left_SH"))} == {others}


def test_feet_that_touch_the_floor_lightly_do_not_prevent_the_start():
    """With the drives off, the straight legs sink until the feet touch the floor. The pulses press the soles onto the floor."""
    with robot(crane(50.0), pose=[0.0] * len(JOINTS)) as started:
        started.until(S.READY)
        for _ in range(3000):
            started.cycle()
        started.start(300)
        assert started.hal.state.supervisor is S.ACTIVE, started.hal.reason
        (proven,) = [event.text for event in started.hal.events if event.code == "DIRECTIONS_PROVEN"]
        assert "not tested under load: left_SA" in proven


@pytest.mark.parametrize("cycle", [100, 140])
@pytest.mark.parametrize("joint", ["SH", "SK", "SA"])
def test_encoders_that_are_exchanged_during_a_start_switch_both_drives_off(cycle: int, joint: str):
    fault = Fault("encoder_swapped", f"LEFT_{joint}", cycle, other=f"RIGHT_{joint}")
    with robot(None, fault, pose=[*POSE[:6], 0.1, 0.1, -0.4, 0.4, 0.1, 0.1]) as started:
        started.until(S.READY)
        assert started.hal.state.cycle < cycle
        moved = started.start(400)
        pair = [JOINTS.index(f"{side}_{joint}") for side in ("left", "right")]
        assert not {D.OPERATION_ENABLED, D.QUICK_STOP_ACTIVE} & set(started.drives.signals.state[pair].tolist())
        (refused,) = [event.text for event in started.hal.events if event.code == "START_REFUSED"]
        assert f"the encoder of left_{joint} reads the position of right_{joint}" in refused
        assert np.abs(started.body.velocity).max() < ROBOT.velocity_max.min()
        assert moved[pair].max() < np.radians(20.0)
