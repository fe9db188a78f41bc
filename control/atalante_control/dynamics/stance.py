"""Inverse dynamics on the ground, stance sole flat and at rest: `model, q, q', q'' -> joint torques, ground wrench`.

`gait (solved, or of the network) -> torques that walk it -> feedforward u_f of the gait file`. Pinocchio alone.

The pelvis floats, and its motion follows from the joints': the stance foot does not move. With V the twist of the foot
seen from the pelvis, the pelvis moves with -V. One recursive Newton-Euler pass gives the wrench f on the floating pelvis;
nothing but the ground can supply it, so the ground wrench is f, and the joints' torques are those of the pass minus
J^T f, J being the foot's Jacobian in the pelvis (the base rows of the equation of motion, solved exactly).

What walks is the sum of two torques: u_g, the gravity of the *empty* exoskeleton hanging from its pelvis, which the
controller adds in every cycle (joint idealization), and u_f, all the rest, which the gait file holds: the patient's
weight, what standing on one leg asks for, and the inertia. So u_f excludes gravity where u_g is added, and u_g + u_f is
the torque that walks.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import bezier, control_points, motion
from atalante_control.model import LEG_LINKS, ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_hal.robot import SIDES, Robot

Vector = npt.NDArray[np.float64]

#: The foot that stands in the step a `Gait` describes, and the one that swings.
STANCE_FOOT, SWING_FOOT = (f"{side}_{LEG_LINKS['HA']}" for side in reversed(SIDES))
#: Phases a feedforward is fitted at; its control points are eight.
_SAMPLES = 33


class GroundForces(NamedTuple):
    """What one pose in motion asks for, and how the pelvis is turned."""

    torque: Vector  # (12,) Nm, order of JOINTS
    force: Vector  # (3,) N, of the ground, in the stance foot's axes
    moment: Vector  # (3,) Nm, about the stance foot's origin (the ankle)
    pelvis: tuple[float, float, float, float]  # unit quaternion wxyz, pelvis to world


class StanceDynamics:
    """A robot, worn or empty, on its right foot."""

    def __init__(self, urdf_text: str, empty: str) -> None:
        """Build the Pinocchio models, pelvis floating and pelvis fixed, and that of u_g.

        Args:
            urdf_text: what walks.
            empty: the same exoskeleton with nobody in it.

        Raises:
            ValueError: a joint of `JOINTS` is not in a text.
        """
        self._gravity = Gravity(pinocchio_model(empty))
        self._floating, self._fixed = pinocchio_model(urdf_text, fixed_base=False), pinocchio_model(urdf_text)
        self._data: tuple[Any, Any] = (self._floating.model.createData(), self._fixed.model.createData())
        self._foot, self._swing_foot = (self._fixed.model.getFrameId(name) for name in (STANCE_FOOT, SWING_FOOT))
        pinocchio.forwardKinematics(self._fixed.model, self._data[1], pinocchio.neutral(self._fixed.model))
        pinocchio.updateFramePlacement(self._fixed.model, self._data[1], self._foot)
        #: The feet toe out and stand flat: the pelvis at the zero pose looks along the walking direction.
        self._toe_out = self._data[1].oMf[self._foot].rotation.copy()

    def forces(self, position: Vector, velocity: Vector, acceleration: Vector) -> GroundForces:
        """Joint torques and ground wrench of one state. Shapes (12,) [rad, rad/s, rad/s2]."""
        fixed, floating = self._fixed, self._floating
        on_pelvis, data = self._data[1], self._data[0]
        q, v, a = np.zeros(fixed.model.nq), np.zeros(fixed.model.nv), np.zeros(fixed.model.nv)
        q[fixed.q], v[fixed.v], a[fixed.v] = position, velocity, acceleration
        pinocchio.computeJointJacobians(fixed.model, on_pelvis, q)
        pinocchio.forwardKinematics(fixed.model, on_pelvis, q, v, a)
        foot = pinocchio.updateFramePlacement(fixed.model, on_pelvis, self._foot)
        frame = pinocchio.ReferenceFrame.WORLD  # of this model: the pelvis, at its origin
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
        """Pose of the left foot in the frame of the right one, a `pinocchio.SE3` [m]. Shape (12,) [rad]."""
        fixed, data = self._fixed, self._data[1]
        q = np.zeros(fixed.model.nq)
        q[fixed.q] = position
        pinocchio.forwardKinematics(fixed.model, data, q)
        stance, swing = (
            pinocchio.updateFramePlacement(fixed.model, data, foot) for foot in (self._foot, self._swing_foot)
        )
        return stance.actInv(swing)

    def torques(self, q: Vector, qd: Vector, qdd: Vector) -> Vector:
        """Joint torques along a motion. Shapes (n, 12) [rad, rad/s, rad/s2] to (n, 12) [Nm]."""
        return np.array([self.forces(*state).torque for state in zip(q, qd, qdd, strict=True)])

    def feedforward(self, coefficients: Vector, duration: float) -> Vector:
        """u_f of a right-stance step: the torques that walk it less u_g, as (12, 8) control points [Nm].

        Args:
            coefficients: Bezier control points of the joints, (12, 8) [rad].
            duration: T [s].
        """
        phase = np.linspace(0.0, 1.0, _SAMPLES)
        states = [self.forces(*state) for state in zip(*motion(coefficients, duration, phase), strict=True)]
        gravity = [
            self._gravity.torque(pose, state.pelvis).copy()
            for pose, state in zip(bezier(coefficients, phase), states, strict=True)
        ]
        return control_points(phase, np.array([state.torque for state in states]) - np.array(gravity))


def stance_dynamics(robot: Robot, patient: Patient | None = None) -> StanceDynamics:
    """The exoskeleton with a patient in it, or empty, on its right foot."""
    exoskeleton = ExoskeletonParameters()
    fitted = exoskeleton if patient is None else exoskeleton.fitted(patient)
    return StanceDynamics(urdf(exoskeleton, robot, patient), urdf(fitted, robot))
