"""Robot on crane and ground: faults of feet, ankles and trunk IMUs, and a fall, are found; a healthy robot starts again."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.gait.subject import Subject
from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_emulator.bodies import ENGINES
from atalante_emulator.faults import Fault
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_emulator.pendant import Operator
from atalante_hal.robot import FEET
from atalante_hal.safety.events import Event
from atalante_hal.types import Controller, State, SupervisorState
from atalante_tools.console.options import Target
from atalante_tools.session.body import describe
from atalante_tools.session.pose_hold import PoseHold
from atalante_tools.session.rig import open_hal
from atalante_tools.session.walk_options import gaits_of_subject

S = SupervisorState
STANDING = [0.0, 0.0, -0.2, 0.45, -0.25, 0.0] * 2
PATIENT = Patient(75.0, 1.75)
#: Length [m] and duration [s] of the walking step.
STEP = (0.16, 0.8)


class Run:
    """Run of a controller on the ground, with the event that ends it and the load on both feet in each cycle."""

    def __init__(
        self,
        robot,
        controller: Controller,
        pose: list[float],
        faults: tuple[Fault, ...],
        ends: str,
        *,
        engine: str = "mujoco",
        cycles: int = 4000,
        presses: dict[int, str] | None = None,
        patient: Patient | None = PATIENT,
        push: tuple[int, float] | None = None,
    ) -> None:
        """Run the controller.

        Args:
            push: first cycle and force [N] of a push to the left at the pelvis, for 0.5 s.
        """
        self.states: list[SupervisorState] = []
        #: Vertical force on each foot, and difference of the diagonals of its cells, in each cycle [N].
        self.forces: list[tuple[list[float], list[float]]] = []
        self.found: Event | None = None
        operator = Operator()
        with open_hal(
            Target("embedded", "", lockstep=True, engine=engine), robot=robot, seed=3, pose=pose, operator=operator,
            controller_fields=controller.telemetry_fields, faults=faults,
            mechanics=Mechanics(describe(robot, None, patient), engine, Ground()),
        ) as rig:  # fmt: skip
            seen = 0
            if push is not None:
                begin, force = push
                rig.access.push(
                    lambda: np.array([0.0, force * (0 <= rig.hal.state.cycle - begin < 500), 0.0, 0.0, 0.0, 0.0])
                )

            def over(state: State) -> bool:
                nonlocal seen
                if press := (presses or {}).get(state.cycle):
                    getattr(operator, press)()
                self.states.append(state.supervisor)
                force = state.foot_force[:, :, 2]
                self.forces.append((force.sum(axis=1).tolist(), (force @ [1.0, -1.0, -1.0, 1.0]).tolist()))
                new = rig.hal.events.since(seen)
                seen = rig.hal.events.count
                self.found = next((event for event in new if event.code == ends), None)
                return self.found is not None or state.cycle >= cycles

            rig.run(controller, until=over)
            self.events = list(rig.hal.events)
            self.codes = {event.code for event in self.events}


@pytest.mark.sample(3)
@pytest.mark.parametrize("cell", ["RL", "all"])
@pytest.mark.parametrize("foot", range(2))
def test_f76_wrong_sign_of_cells_is_found_when_the_robot_is_set_down(robot, cell: str, foot: int) -> None:
    fault = Fault("cell_inverted", f"FOOT_{FEET[foot].upper()}", cell=cell)
    run = Run(robot, PoseHold(robot), STANDING, (fault,), "FOOT_CELL")
    assert S.ACTIVE in run.states  # nothing was found in the air
    assert run.found is not None
    assert FEET[foot] in run.found.text
    assert ("cannot pull" if cell == "all" else "diagonals") in run.found.text
    wrong = [load[foot] < -120.0 if cell == "all" else abs(twist[foot]) > 80.0 for load, twist in run.forces]
    assert wrong[-1]
    assert len(wrong) - wrong.index(True) <= 270  # the load sways about its limit while the crane lowers the robot


@pytest.mark.long
def test_f78_exchanged_feet_are_found_before_the_first_step(robot) -> None:
    controller = WalkController(robot, PATIENT, gaits_of_subject(Subject(PATIENT, *STEP), robot), 4)
    fault = Fault("sensor_swapped", "FOOT_LEFT", other="FOOT_RIGHT")
    run = Run(robot, controller, controller.standing_pose.tolist(), (fault,), "CONTACT_IMPLAUSIBLE", cycles=5000)
    assert run.found is not None
    assert "the feet are exchanged: the robot leans" in run.found.text
    assert (controller.statistics.steps, run.states[-1]) == (0, S.HOLD)
    assert all(min(load) > 50.0 for load, _ in run.forces[-128:])  # both feet are still on the ground


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("joint", "rate"), [("LEFT_SA", 2.5), ("RIGHT_SA", -2.5), ("LEFT_HA", -2.5), ("RIGHT_HA", 2.5)]
)
def test_f79_drift_of_an_ankle_encoder_is_found_while_the_robot_stands(robot, joint: str, rate: float) -> None:
    fault = Fault("encoder_drift", joint, 3500, rate=math.radians(rate))
    run = Run(robot, PoseHold(robot), STANDING, (fault,), "ENC_DRIFT", cycles=5000)
    assert run.found is not None
    side, name = joint.split("_")
    assert run.found.text.startswith(
        f"encoder of {side.lower()}_{name}: the {side.lower()} sole must be level, because it is flat on the floor, got a tilt of"
    )
    assert run.found.cycle - 3500 < 1400
    assert S.FULL_ASSIST in run.states


@pytest.mark.sample(3)
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("patient", [PATIENT, None], ids=["patient", "empty"])
def test_f81_exchanged_imus_of_the_trunk_are_found(robot, engine: str, patient: Patient | None) -> None:
    fault = Fault("sensor_swapped", "IMU_TORSO", other="IMU_PELVIS")
    run = Run(
        robot, PoseHold(robot), STANDING, (fault,), "IMU_IMPLAUSIBLE", engine=engine, cycles=3500, patient=patient
    )
    assert run.found is not None
    assert run.found.text.startswith("the IMUs of torso and pelvis are exchanged")
    if patient is None:  # the empty robot swings on the crane from the start
        assert run.found.cycle <= 330
        assert S.ACTIVE not in run.states
    else:
        assert run.found.cycle <= 2800
        assert run.states[-1] is S.FULL_ASSIST


@pytest.mark.sample(2)
@pytest.mark.parametrize("engine", ENGINES)
def test_f86_robot_that_falls_goes_to_hold_and_cannot_start_again(robot, engine: str) -> None:
    presses = dict.fromkeys(range(7000, 8000, 300), "start")
    run = Run(
        robot, PoseHold(robot), STANDING, (), "never", engine=engine, cycles=8000, presses=presses, push=(4600, 400.0)
    )
    pending, confirmed = [event for event in run.events if event.code == "FALLEN"][:2]
    assert (pending.severity, confirmed.severity, confirmed.cycle - pending.cycle) == ("warning", "error", 16)
    assert confirmed.text.startswith("the robot has fallen: its trunk leans by ")
    hold = next(event for event in run.events if event.code == "HOLD")
    assert (hold.cycle, hold.text) == (confirmed.cycle, f"ACTIVE -> HOLD: {confirmed.text}")
    assert run.states[hold.cycle - 2] is S.ACTIVE
    assert min(run.states[hold.cycle :]) >= S.HOLD
    assert run.states[-1] >= S.HOLD


@pytest.mark.sample(2)
@pytest.mark.parametrize("engine", ENGINES)
def test_robot_that_stands_in_hold_can_start_again(robot, engine: str) -> None:
    run = Run(
        robot,
        PoseHold(robot),
        STANDING,
        (),
        "never",
        engine=engine,
        cycles=4800,
        presses={3000: "hold", 4500: "start"},
    )
    assert run.states[4400] is S.HOLD
    assert run.states[-1] is S.ACTIVE
    assert run.codes <= {"READY", "DIRECTIONS_PROVEN", "ACTIVE", "TORQUE_SATURATED", "OPERATOR_STOP", "HOLD"}
