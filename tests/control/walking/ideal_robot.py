"""Walking controller on a robot without noise and bus."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from atalante_control.gait.walk import DEFAULT_WALK, load_walk
from atalante_control.model import ExoskeletonParameters, Patient, urdf
from atalante_control.walking.controller import WalkController
from atalante_control.walking.phases import Phase
from atalante_emulator.bodies import Body, hang, make_body
from atalante_emulator.imu import ImuParameters, Imus, ImuSignals
from atalante_hal.robot import load_robot
from atalante_hal.types import Command, State, SupervisorState

ROBOT = load_robot()
PATIENT = Patient(75.0, 1.75)
WALK = load_walk(DEFAULT_WALK, ROBOT)


class Ideal:
    """Robot without noise and bus. The torques act in the next cycle."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self.signals = ImuSignals(np.zeros((4, 4)), np.zeros((4, 3)), np.zeros((4, 3)))
        self._imus = Imus(ImuParameters(), self.signals)
        zero, valid = np.zeros(12), np.ones(22, bool)
        self.state = State(
            cycle=0,
            time=0.0,
            supervisor=SupervisorState.ACTIVE,
            assistance_factor=1.0,
            position=zero.copy(),
            velocity=zero.copy(),
            torque=zero.copy(),
            temperature=zero.copy(),
            drive_state=zero.copy(),
            imu_quaternion=self.signals.quaternion,
            imu_gyro=self.signals.gyro,
            imu_accel=self.signals.accel,
            foot_force=np.zeros((2, 4, 3)),
            vibration=np.zeros(8),
            valid=valid,
            age=np.zeros(22, np.int64),
            joints_valid=True,
            joint_rows=tuple(range(6, 18)),
            foot_rows=(0, 1),
            imu_rows=(2, 3, 4, 5),
        )
        self._torque = zero.copy()
        self.push = zero.copy()  # torques on the joints, besides those of the motors [Nm]
        self.wrong_imus: list[int] = []  # IMUs whose gyroscope and accelerometer have the wrong sign

    def cycle(self, controller: WalkController) -> Command:
        body, state = self.body, self.state
        old = state.age[list(state.imu_rows)] > 0
        last = [values[old] for values in self.signals]
        self._imus.sample(body.imu)
        for values in (self.signals.gyro, self.signals.accel):
            values[self.wrong_imus] *= -1.0
        for values, kept in zip(self.signals, last, strict=True):
            values[old] = kept
        state.position[:], state.velocity[:] = body.position, body.velocity
        received = state.age[list(state.foot_rows)] == 0
        state.foot_force[received] = body.sole_force[received]
        if state.cycle == 0:
            controller.reset(state)
        command = controller.update(state)
        torque = command.torque.copy()
        body.step((self._torque + self.push).tolist())
        self._torque = np.clip(torque, -ROBOT.torque_max, ROBOT.torque_max)
        state.cycle += 1
        return command

    def upright(self) -> bool:
        x, y, _, _ = self.body.motion("pelvis").attitude
        return bool(1.0 - 2.0 * (x * x + y * y) > 0.9)


def walk_with(
    controller: WalkController,
    engine: str,
    *,
    finish_after: int | None = None,
    xi: float = 1.0,
    lost_feet: Sequence[int] = (),
    lost_imus: Sequence[int] = (),
    implausible_imus: Sequence[int] = (),
) -> list[Phase]:
    """Walk until the robot stands again; return the phases.

    After `finish_after` steps, FINISH_STEP begins and the data of `lost_feet` and `lost_imus` is no longer received. From then
    on, the readings of `implausible_imus` have the wrong sign, and the HAL reports this in the first cycle.
    """
    body = make_body(engine, urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    try:
        hang(body, controller.standing_pose.tolist(), 0.0005)
        robot, phases = Ideal(body), [Phase.POSTURE]
        robot.state.assistance_factor = xi
        while phases[-1] is not Phase.REST:
            robot.cycle(controller)
            if controller.phase is not phases[-1]:
                phases.append(controller.phase)
            if finish_after is not None and controller.statistics.steps == finish_after:
                first = robot.state.supervisor is not SupervisorState.FINISH_STEP
                robot.state.implausible_imus = frozenset(implausible_imus if first else ())
                robot.wrong_imus = list(implausible_imus)
                robot.state.supervisor = SupervisorState.FINISH_STEP
                for row in (
                    *(robot.state.foot_rows[i] for i in lost_feet),
                    *(robot.state.imu_rows[i] for i in lost_imus),
                ):
                    robot.state.age[row] = 100
            assert robot.upright(), f"fell in {controller.phase.name} after {controller.statistics.steps} steps"
            assert robot.state.cycle < 30_000
    finally:
        body.close()
    return phases
