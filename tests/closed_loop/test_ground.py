"""Robot with a patient on the ground: a crane sets it down, and HAL, bus and drives keep it standing, in both engines."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_control.gait.subject import Subject
from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_emulator.bodies import ENGINES
from atalante_emulator.faults import Fault
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_hal.types import GRAVITY, State, SupervisorState
from atalante_hal.wire.frame import Frames
from atalante_tools.console.options import Target
from atalante_tools.session.body import describe
from atalante_tools.session.pose_hold import PoseHold
from atalante_tools.session.rig import open_hal
from atalante_tools.session.walk_options import gaits_of_subject

STANDING = [0.0, 0.0, -0.2, 0.45, -0.25, 0.0] * 2
PATIENT = Patient(75.0, 1.75)


class Log:
    """Tap that keeps identifier and data of every frame of the nodes, in order."""

    def __init__(self) -> None:
        self.data = bytearray()

    def sent(self, frames: Frames) -> None:
        pass

    def received(self, frames: Frames, count: int) -> None:
        for frame in frames[:count]:
            self.data += int(frame["can_id"]).to_bytes(4, "little") + frame["data"][: frame["len"]].tobytes()


@pytest.mark.sample(2)
@pytest.mark.parametrize("engine", ENGINES)
def test_robot_set_down_stands_with_its_full_weight(network, robot, engine: str) -> None:
    logs = []
    for cycles in (4900, 1500):
        log, hold, weight, before = Log(), PoseHold(robot), [], []
        mechanics = Mechanics(describe(robot, None, PATIENT), engine, Ground(clearance=0.01))
        with open_hal(
            Target("embedded", "", lockstep=True, engine=engine), network=network, robot=robot, seed=5, pose=STANDING,
            controller_fields=hold.telemetry_fields, mechanics=mechanics, tap=log,
        ) as rig:  # fmt: skip
            body, crane = rig.emulator.body, rig.emulator.crane

            def over(state: State, cycles=cycles, weight=weight, before=before) -> bool:
                if state.supervisor is SupervisorState.READY:
                    before.append(state.foot_force[:, :, 2].sum())
                if state.cycle > 4450:
                    weight.append(state.foot_force[:, :, 2].sum())
                return state.cycle >= cycles

            rig.run(hold, until=over)
            codes = {event.code for event in rig.hal.events} - {
                "READY",
                "DIRECTIONS_PROVEN",
                "ACTIVE",
                "TORQUE_SATURATED",
            }
            assert codes == {"OPERATOR_STOP", "HOLD"}  # only the end of the run
            if weight:
                assert crane.lowered
                assert np.mean(weight) == pytest.approx(body.mass * GRAVITY, rel=0.01)
                assert abs(np.mean(before)) < 20.0  # suspended clear of the floor
                assert np.abs(body.motion("pelvis").attitude[:2]).max() < 0.03
        logs.append(bytes(log.data))
    assert len(logs[1]) > 1400 * 19 * 12
    compared = len(logs[1]) * 9 // 10  # the runs end in different cycles, so the last tenth is not compared
    assert logs[0][:compared] == logs[1][:compared]


@pytest.mark.long
@pytest.mark.parametrize(("hip", "knee"), [(30.0, -18.0), (-30.0, 18.0)])
def test_f06_late_data_of_a_pushed_leg_in_a_guide_causes_no_fall(robot, hip: float, knee: float) -> None:
    """Delay and push begin in the second step. The push does not exceed the certified torques. Before, the robot fell."""
    walk = WalkController(robot, PATIENT, gaits_of_subject(Subject(PATIENT, 0.16, 0.8), robot), 4)
    mechanics, speeds = Mechanics(describe(robot, None, PATIENT), "mujoco", Ground()), []
    with open_hal(
        Target("embedded", "", lockstep=True, engine="mujoco"), robot=robot, pose=walk.standing_pose.tolist(),
        assistance_factor=0.0, controller_fields=walk.telemetry_fields, mechanics=mechanics,
    ) as rig:  # fmt: skip

        def over(state: State) -> bool:
            if walk.reached(1, 0.02) and not speeds:
                begin = state.cycle + 2
                delays = [Fault("delay", f"LEFT_{joint}_STATE", begin, None, by=4) for joint in ("SH", "SK")]
                torques = ("LEFT_SH", hip), ("LEFT_SK", knee)
                pushes = [Fault("push", joint, begin, 700, torque=torque) for joint, torque in torques]
                rig.emulator.inject([*delays, *pushes])
            if walk.reached(1, 0.02):
                speeds.append(float((np.abs(rig.emulator.body.velocity) / robot.velocity_max).max()))
            return walk.done or (state.cycle > 2000 and not rig.hal.moving)

        rig.run(walk, until=over)
        assert (walk.done, rig.hal.state.supervisor) == (True, SupervisorState.HOLD), rig.hal.reason
        assert max(speeds) < 1.0
        texts = [event.text for event in rig.hal.events if event.code == "GUIDE_OUTSIDE"]
        assert "full assistance for the rest of this step: data or torques are later than its guide covers" in texts
