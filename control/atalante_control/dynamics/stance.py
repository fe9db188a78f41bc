"""Inverse dynamics of the robot standing on its right foot: `model, q, q', q'' -> joint torques, ground wrench`.

`gait (solver or network) -> torques of the gait -> feedforward u_f of the gait file`. The stance sole is flat on the ground and
at rest.

The pelvis of the model floats. The stance foot does not move, so the joint motion determines the motion of the pelvis:
if V is the twist of the foot in the pelvis frame, the twist of the pelvis is -V. One recursive Newton-Euler pass gives
the wrench f on the floating pelvis. Only the ground can apply this wrench, so the ground wrench is f. The joint torques
are the torques of this pass minus J^T f, where J is the Jacobian of the foot in the pelvis frame. The result satisfies
the equation of motion of the pelvis exactly.

The torque of a gait is the sum u_g + u_f. u_g is the gravity torque of the *empty* exoskeleton suspended at its pelvis.
The controller adds u_g in every cycle (joint idealization). The feedforward u_f in the gait file is the remainder: the
weight of the patient, the load of standing on one leg, and the inertia.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio

from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import bezier, control_points, motion
from atalante_control.model import LEG_LINKS, ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_hal.robot import SIDES, Robot
from atalante_hal.types import Vector

#: Names of the links of stance foot and swing foot in the right-stance step of a `Gait`.
STANCE_FOOT, SWING_FOOT = (f"{side}_{LEG_LINKS['HA']}" for side in reversed(SIDES))
#: Number of samples per step. The control points of the feedforward are fitted to these samples.
_SAMPLES = 33


class GroundForces(NamedTuple):
    """Result of `StanceDynamics.forces`: joint torques, ground wrench and attitude of the pelvis."""

    torque: Vector  # (12,) Nm, joint torques in the order of JOINTS
    force: Vector  # (3,) N, ground force on the stance foot, in the axes of the foot
    moment: Vector  # (3,) Nm, ground moment about the ankle of the stance foot, in the axes of the foot
    pelvis: tuple[float, float, float, float]  # attitude of the pelvis, unit quaternion wxyz, pelvis to world


class StanceDynamics:
    """Inverse dynamics of an exoskeleton (empty or with a patient) that stands on its right foot."""

    def __init__(self, urdf_text: str, empty: str) -> None:
        """Build the Pinocchio models with floating and with fixed pelvis, and the gravity model of the empty exoskeleton.

        Args:
            urdf_text: URDF of the exoskeleton that walks, empty or with a patient.
            empty: URDF of the same exoskeleton without a patient.

        Raises:
            ValueError: If a joint of `JOINTS` is missing in a URDF.
        """
        self._gravity = Gravity(pinocchio_model(empty))
        self._floating, self._fixed = pinocchio_model(urdf_text, fixed_base=False), pinocchio_model(urdf_text)
        self._data: tuple[Any, Any] = (self._floating.model.createData(), self._fixed.model.createData())
        self._foot, self._swing_foot = (self._fixed.model.getFrameId(name) for name in (STANCE_FOOT, SWING_FOOT))
        pinocchio.forwardKinematics(self._fixed.model, self._data[1], pinocchio.neutral(self._fixed.model))
        pinocchio.updateFramePlacement(self._fixed.model, self._data[1], self._foot)
        #: Rotation matrix from the stance foot to the world: the foot points outwards by the toe-out angle during the whole step.
        #: The matrix is computed with all joints at 0 rad, and with the pelvis axes parallel to the world axes (x forward).
        self._toe_out = self._data[1].oMf[self._foot].rotation.copy()

    def forces(self, position: Vector, velocity: Vector, acceleration: Vector) -> GroundForces:
        """Compute the joint torques and the ground wrench of one state.

        Args:
            position: joint angles, shape (12,) [rad].
            velocity: joint speeds, shape (12,) [rad/s].
            acceleration: joint accelerations, shape (12,) [rad/s2].
        """
        fixed, floating = self._fixed, self._floating
        on_pelvis, data = self._data[1], self._data[0]
        q, v, a = np.zeros(fixed.model.nq), np.zeros(fixed.model.nv), np.zeros(fixed.model.nv)
        q[fixed.q], v[fixed.v], a[fixed.v] = position, velocity, acceleration
        pinocchio.computeJointJacobians(fixed.model, on_pelvis, q)
        pinocchio.forwardKinematics(fixed.model, on_pelvis, q, v, a)
        foot = pinocchio.updateFramePlacement(fixed.model, on_pelvis, self._foot)
        frame = pinocchio.ReferenceFrame.WORLD  # the pelvis is fixed in this model, so WORLD is the pelvis frame
        twist = pinocchio.getFrameVelocity(fixed.model, on_pelvis, self._foot, frame).vector
        change = pinocchio.getFrameAcceleration(fixed.model, on_pelvis, self._foot, frame).vector
        jacobian = pinocchio.getFrameJacobian(fixed.model, on_pelvis, self._foot, frame)

        pelvis = pinocchio.SE3(self._toe_out, np.zeros(3)) * foot.inverse()
        full_q = np.zeros(floating.model.nq)
        full_v, full_a = np.zeros(floating.model.nv), np.zeros(floating.model.nv)
        full_q[:7] = pinocchio.SE3ToXYZQUAT(pelvis)
        full_q[floating.q], full_v[:6], full_a[:6] = position, -twist, -change
        full_v[floating.v], full_a[floating.v] = velocity, acceleration
        demanded = pinocchio.rnea(floating.model, data, full_q, full_v, full_a)
        wrench = pinocchio.Force(demanded[:6])
        on_foot = foot.actInv(wrench)
        torque = demanded[floating.v] - (jacobian.T @ demanded[:6])[fixed.v]
        x, y, z, w = full_q[3:7].tolist()
        return GroundForces(torque, on_foot.linear.copy(), on_foot.angular.copy(), (w, x, y, z))

    def swing_foot(self, position: Vector) -> Any:
        """Return the pose of the left foot in the frame of the right foot, a `pinocchio.SE3` [m].

        Args:
            position: joint angles, shape (12,) [rad].
        """
        fixed, data = self._fixed, self._data[1]
        q = np.zeros(fixed.model.nq)
        q[fixed.q] = position
        pinocchio.forwardKinematics(fixed.model, data, q)
        stance, swing = (
            pinocchio.updateFramePlacement(fixed.model, data, foot) for foot in (self._foot, self._swing_foot)
        )
        return stance.actInv(swing)

    def torques(self, q: Vector, qd: Vector, qdd: Vector) -> Vector:
        """Compute the joint torques along a motion.

        Args:
            q: joint angles, shape (n, 12) [rad].
            qd: joint speeds, shape (n, 12) [rad/s].
            qdd: joint accelerations, shape (n, 12) [rad/s2].

        Returns:
            Joint torques, shape (n, 12) [Nm].
        """
        return np.array([self.forces(*state).torque for state in zip(q, qd, qdd, strict=True)])

    def feedforward(self, coefficients: Vector, duration: float) -> Vector:
        """Return the feedforward u_f of a right-stance step as Bezier control points, shape (12, 8) [Nm].

        u_f is the joint torque minus the gravity torque u_g.

        Args:
            coefficients: Bezier control points of the joints, shape (12, 8) [rad].
            duration: duration of the step T [s].
        """
        phase = np.linspace(0.0, 1.0, _SAMPLES)
        states = [self.forces(*state) for state in zip(*motion(coefficients, duration, phase), strict=True)]
        gravity = [
            self._gravity.torque(pose, state.pelvis).copy()
            for pose, state in zip(bezier(coefficients, phase), states, strict=True)
        ]
        return control_points(phase, np.array([state.torque for state in states]) - np.array(gravity))


def stance_dynamics(robot: Robot, patient: Patient | None = None) -> StanceDynamics:
    """Build the inverse dynamics of an exoskeleton (empty or with a patient) that stands on its right foot.

    Args:
        robot: limits of the joints.
        patient: patient in the exoskeleton, or None for an empty exoskeleton.
    """
    exoskeleton = ExoskeletonParameters()
    fitted = exoskeleton if patient is None else exoskeleton.fitted(patient)
    return StanceDynamics(urdf(exoskeleton, robot, patient), urdf(fitted, robot))
