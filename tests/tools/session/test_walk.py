"""Walk on the ground through HAL and bus: FINISH_STEP, and the gaits of a subject."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from atalante_control.gait.subject import Subject
from atalante_control.gait.walk import DEFAULT_WALK, load_walk, write_walk
from atalante_control.model import Patient
from atalante_control.structured import dtype_of
from atalante_control.walking.config import WalkConfig
from atalante_control.walking.controller import WalkController
from atalante_control.walking.phases import Phase
from atalante_control.walking.telemetry import Telemetry
from atalante_emulator.faults import BATTERY, Fault
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_emulator.pendant import Operator
from atalante_hal.robot import load_robot
from atalante_hal.types import PERIOD, State, SupervisorState, Vector
from atalante_tools.console.options import MUJOCO, GaitFiles, Target
from atalante_tools.session.body import describe
from atalante_tools.session.law import Law
from atalante_tools.session.rig import open_hal
from atalante_tools.session.walk_observation import Observation
from atalante_tools.session.walk_options import Push, WalkOptions, gaits_of, gaits_of_subject

ROBOT = load_robot()
PATIENT = Patient(75.0, 1.75)


@pytest.mark.long
def test_low_supply_in_a_step_ends_in_hold_on_both_feet() -> None:
    controller = WalkController(ROBOT, PATIENT, load_walk(DEFAULT_WALK, ROBOT), 100)
    low_supply = Fault("under_voltage", BATTERY, start=7600, volts=40.0)
    seen: list[tuple[SupervisorState, Phase]] = []

    def held(state: State) -> bool:
        if not seen or seen[-1] != (state.supervisor, controller.phase):
            seen.append((state.supervisor, controller.phase))
        return len(seen) > 3 and state.supervisor is SupervisorState.HOLD

    with open_hal(
        Target("embedded", "", True, MUJOCO),
        robot=ROBOT,
        pose=controller.standing_pose.tolist(),
        controller_fields=controller.telemetry_fields,
        mechanics=Mechanics(describe(ROBOT, None, PATIENT), MUJOCO, Ground()),
        faults=[low_supply],
    ) as rig:
        rig.run(controller, until=held)
        assert rig.emulator is not None
        x, y, _, _ = rig.emulator.body.motion("pelvis").attitude
    finishing = [phase for supervisor, phase in seen if supervisor is SupervisorState.FINISH_STEP]
    assert finishing[0] is Phase.STEP
    assert finishing[-3:-1] == [Phase.STOP, Phase.BACK] or finishing[-2:] == [Phase.STOP, Phase.BACK]
    assert seen[-1] == (SupervisorState.HOLD, Phase.REST)
    assert 1.0 - 2.0 * (x * x + y * y) > 0.99


@pytest.mark.parametrize(
    ("begins", "finishing"),
    [
        (lambda controller: controller.phase is Phase.SHIFT, [Phase.SHIFT, Phase.BACK]),
        (lambda controller: controller.reached(1, 0.3), [Phase.STEP, Phase.STOP, Phase.BACK]),
    ],
    ids=["weight shift", "step"],
)
@pytest.mark.sample(2)
def test_stop_of_the_pendant_in_a_walk_ends_it_on_both_feet(
    begins: Callable[[WalkController], bool], finishing: list[Phase]
) -> None:
    controller = WalkController(ROBOT, PATIENT, load_walk(DEFAULT_WALK, ROBOT), 3)
    operator = Operator()
    seen: list[tuple[SupervisorState, Phase]] = []

    def stopped(state: State) -> bool:
        if begins(controller) and state.supervisor is SupervisorState.ACTIVE:
            operator.stop()
        if not seen or seen[-1] != (state.supervisor, controller.phase):
            seen.append((state.supervisor, controller.phase))
        return state.supervisor is SupervisorState.HOLD

    with open_hal(
        Target("embedded", "", True, MUJOCO),
        robot=ROBOT,
        pose=controller.standing_pose.tolist(),
        operator=operator,
        controller_fields=controller.telemetry_fields,
        mechanics=Mechanics(describe(ROBOT, None, PATIENT), MUJOCO, Ground()),
    ) as rig:
        rig.run(controller, until=stopped)
        assert rig.emulator is not None
        x, y, _, _ = rig.emulator.body.motion("pelvis").attitude
    finished = [phase for supervisor, phase in seen if supervisor is SupervisorState.FINISH_STEP]
    assert [phase for phase in finished if phase is not Phase.REST] == finishing
    assert seen[-1] == (SupervisorState.HOLD, Phase.REST)
    assert 1.0 - 2.0 * (x * x + y * y) > 0.99


@pytest.mark.sample(2)
@pytest.mark.parametrize("turn", [0.0, math.radians(3.0)])
def test_push_begins_at_its_phase_in_a_right_stance_step_and_acts_relative_to_the_line(turn: float) -> None:
    controller = WalkController(ROBOT, PATIENT, load_walk(DEFAULT_WALK, ROBOT), 4, WalkConfig(turn=turn))
    push, rows = Push(20.0, 90.0, step=1, phase=0.5), list[dict[str, float]]()
    with open_hal(
        Target("embedded", "", True, MUJOCO),
        robot=ROBOT,
        pose=controller.standing_pose.tolist(),
        operator=Operator(),
        controller_fields=controller.telemetry_fields,
        mechanics=Mechanics(describe(ROBOT, None, PATIENT), MUJOCO, Ground()),
    ) as rig:
        assert rig.emulator is not None
        Observation(rig, controller, push)
        wrench = rig.emulator.pelvis_forces[-1]

        def observed(hal_state: int) -> Vector:
            force = wrench(hal_state)
            if force.any():
                # The line turns before each of the first two steps.
                x, y = -20.0 * math.sin(2.0 * turn), 20.0 * math.cos(2.0 * turn)
                assert force.tolist() == pytest.approx([x, y, 0.0, 0.0, 0.0, 0.0])
                record = controller.telemetry.view(dtype_of(Telemetry))
                rows.append({name: float(record[name][0]) for name in ("step", "stance", "elapsed")})
            return force

        rig.emulator.pelvis_forces[-1] = observed
        rig.run(controller, until=lambda _: controller.statistics.steps == 3)
    assert len(rows) == round(push.duration / PERIOD)
    assert {(row["step"], row["stance"]) for row in rows} == {(1.0, 1.0)}
    assert rows[0]["elapsed"] == pytest.approx(0.4, abs=2 * PERIOD)


def test_gaits_fit_the_leg_lengths_of_the_patient(tmp_path: Path) -> None:
    longer = Patient(75.0, 1.75, thigh_length=0.44)
    gaits = gaits_of_subject(Subject(longer, 0.16, 0.8), ROBOT)
    assert gaits.step.parameters["thigh_length"] == 0.44
    assert gaits.hash32 != load_walk(DEFAULT_WALK, ROBOT).hash32
    write_walk(gaits, tmp_path / "walk.json")
    options = WalkOptions(
        steps=1, xi=1.0, shape="pinched", passive=False, subject=None, files=GaitFiles(tmp_path / "walk.json"), seed=0,
        friction=0.6, push=None, law=Law(),
    )  # fmt: skip
    patient, read = gaits_of(options, ROBOT)
    assert patient.length("thigh") == 0.44
    assert read.hash32 == gaits.hash32


def test_default_patient_walks_with_the_walk_file_of_the_package() -> None:
    winter = Patient(75.0, 1.75, PATIENT.length("thigh"), PATIENT.length("shank"))
    for patient in (PATIENT, winter):
        assert gaits_of_subject(Subject(patient, 0.16, 0.8), ROBOT).hash32 == load_walk(DEFAULT_WALK, ROBOT).hash32
