"""Standing on both feet: poses by inverse kinematics, static torques, and the weight shift onto one foot.

`pose on one foot -> path of the pelvis to the middle between the feet -> poses, torques, centre of mass`. The weight shift is
slow, so static torques are sufficient. The position of the centre of mass determines which share of the weight each foot carries.
All results are Bezier polynomials of the position on the path, from 0 (middle between the feet) to 1 (above one foot).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pinocchio

from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import GaitError, control_points
from atalante_control.model import ArticulatedModel, ExoskeletonParameters
from atalante_control.walking.rotation import about_z
from atalante_hal.robot import JOINTS, LEG_JOINTS, SIDES, Robot
from atalante_hal.types import GRAVITY, Vector

_LEG = len(LEG_JOINTS)
_ITERATIONS = 50  # largest number of iterations of the inverse kinematics for a pose
_TOLERANCE = 1e-10  # m or rad, largest accepted error of the inverse kinematics
_LARGEST = 0.2  # rad, largest change of a joint angle in one iteration
_POINTS = 31  # number of poses along a weight shift; the Bezier control points are fitted to these poses


class Stance(NamedTuple):
    """Poses of both soles and centre of mass, relative to the pelvis and in the axes of the pelvis."""

    rotation: tuple[Vector, Vector]  # rotation matrices from left and right foot to pelvis
    position: tuple[Vector, Vector]  # m, centres of the soles
    centre: Vector  # m, centre of mass


class Shift(NamedTuple):
    """Weight shift from the middle between the feet onto one foot.

    Each row of a field contains the control points of a Bezier polynomial along the path of the weight shift.

    The controller adds the gravity torques u_g of the suspended exoskeleton to `feedforward`. The sum is the static torque on the
    ground, which also holds the weight of the patient.
    """

    q: Vector  # (12, 8) rad, control points of the joint angles
    feedforward: Vector  # (12, 8) Nm, control points of the static torques on the ground minus the gravity torques u_g
    #: (3, 8) m, control points of the centre of mass relative to the middle between the soles, in the walking frame
    centre: Vector


class Standing:
    """Inverse kinematics and statics of the robot with the patient, standing on both feet."""

    def __init__(
        self, articulated: ArticulatedModel, gravity: Gravity, exoskeleton: ExoskeletonParameters, robot: Robot
    ) -> None:
        """Store the model of robot and patient.

        Args:
            articulated: model of the robot with the patient, with a fixed pelvis.
            gravity: gravity torques u_g of the suspended exoskeleton, which the controller adds to the feedforward.
            exoskeleton: geometry of the soles.
            robot: limits of the joints.
        """
        self._gravity = gravity
        self._model, self._q, self._v = articulated.model.copy(), articulated.q, articulated.v
        self._data: Any = self._model.createData()
        self._feet = [self._model.getFrameId(f"{side}_foot") for side in SIDES]
        x, z = exoskeleton.sole_centre
        self._sole, self._toe_out, self._robot = np.array([x, 0.0, z]), exoskeleton.toe_out, robot
        self._weight = GRAVITY * sum(inertia.mass for inertia in self._model.inertias)

    def toe_out(self, side: int) -> float:
        """Return the toe-out of a foot, positive to the left [rad].

        Args:
            side: 0 left, 1 right.
        """
        return -self._toe_out if side else self._toe_out

    def stance(self, q: Vector) -> Stance:
        """Return the poses of the soles and the centre of mass.

        Args:
            q: joint angles, shape (12,) [rad].
        """
        full = self._full(q)
        # Pinocchio's centre of mass does not contain the pelvis, which is fixed in this model. So the pelvis is added here.
        pelvis, legs = self._model.inertias[0], pinocchio.centerOfMass(self._model, self._data, full)
        share = pelvis.mass * GRAVITY / self._weight
        centre = share * pelvis.lever + (1.0 - share) * legs
        pinocchio.updateFramePlacements(self._model, self._data)
        feet = [self._data.oMf[foot] for foot in self._feet]
        left, right = (foot.translation + foot.rotation @ self._sole for foot in feet)
        return Stance((feet[0].rotation.copy(), feet[1].rotation.copy()), (left, right), centre)

    def shift(self, onto: Vector, side: int) -> Shift:
        """Return the weight shift from the middle between the feet onto one foot.

        Args:
            onto: angles of a pose with both soles flat on the ground and the centre of mass above one sole, shape (12,) [rad].
            side: foot under the centre of mass, 0 left, 1 right.

        Raises:
            GaitError: If a pose of the weight shift cannot be reached or exceeds a joint limit.
        """
        end = self.stance(onto)
        upright = about_z(self.toe_out(side)) @ end.rotation[side].T  # rotation from pelvis to walking frame
        soles = [upright @ (position - end.position[side]) for position in end.position]
        feet = [upright @ rotation for rotation in end.rotation]
        middle, centre = (soles[0] + soles[1]) / 2.0, upright @ end.centre
        last = -(upright @ end.position[side])
        first = np.array([middle[0] - centre[0], middle[1], last[2]])
        tilt = pinocchio.log3(upright)
        q, rows = onto.copy(), list[tuple[Vector, Vector, Vector]]()
        path: Vector = np.linspace(1.0, 0.0, _POINTS)
        for part in path:
            pelvis, rotation = first + (last - first) * part, pinocchio.exp3(tilt * part)
            for foot in range(2):
                q = self._reach(q, foot, rotation.T @ feet[foot], rotation.T @ (soles[foot] - pelvis))
            where = pelvis + rotation @ self.stance(q).centre
            share = float(np.clip((where - soles[0])[1] / (soles[1] - soles[0])[1], 0.0, 1.0))
            pressed = where - (share * soles[1] + (1.0 - share) * soles[0])
            pressed[2] = 0.0
            points = [rotation.T @ (sole + pressed - pelvis) for sole in soles]
            rows.append((q, self._statics(q, rotation, (1.0 - share, share), points), where - middle))
        return Shift(*(control_points(path, np.array(column)) for column in zip(*rows, strict=True)))

    def _full(self, q: Vector) -> Vector:
        full = np.zeros(self._model.nq)
        full[self._q] = q
        return full

    def _jacobian(self, q: Vector, foot: int) -> Vector:
        """Return the Jacobian of a sole with respect to the joints of the same leg, in the axes of the pelvis, shape (6, 6)."""
        frame = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = pinocchio.computeFrameJacobian(self._model, self._data, self._full(q), self._feet[foot], frame)
        pinocchio.updateFramePlacement(self._model, self._data, self._feet[foot])
        lever = self._data.oMf[self._feet[foot]].rotation @ self._sole
        leg: Vector = jacobian[:, self._v[foot * _LEG : (foot + 1) * _LEG]].copy()
        leg[:3] += np.cross(leg[3:].T, lever).T
        return leg

    def _reach(self, q: Vector, foot: int, rotation: Vector, position: Vector) -> Vector:
        """Return a copy of a pose in which one leg is moved so that its sole is at the target (Newton's method)."""
        q, leg = q.copy(), slice(foot * _LEG, (foot + 1) * _LEG)
        for _ in range(_ITERATIONS):
            now = self.stance(q)
            turn = pinocchio.log3(rotation @ now.rotation[foot].T)
            error = np.concatenate([position - now.position[foot], turn])
            if np.abs(error).max() < _TOLERANCE:
                break
            q[leg] += np.clip(np.linalg.solve(self._jacobian(q, foot), error), -_LARGEST, _LARGEST)
        else:
            raise GaitError(
                f"weight shift: the {SIDES[foot]} leg must reach its target within {_ITERATIONS} iterations, "
                f"got an error of {np.abs(error).max():.2g} m or rad"
            )
        low, high = self._robot.position_min, self._robot.position_max
        beyond = np.maximum(q - high, low - q)
        if beyond.max() > 0.0:
            joint = int(beyond.argmax())
            limits = f"{math.degrees(low[joint]):.4g} to {math.degrees(high[joint]):.4g} deg"
            raise GaitError(
                f"weight shift: angle of joints.{JOINTS[joint]} must be {limits}, got {math.degrees(q[joint]):.4g} deg"
            )
        return q

    def _statics(self, q: Vector, rotation: Vector, shares: tuple[float, float], points: list[Vector]) -> Vector:
        """Return the torques that hold a pose on the ground, minus the gravity torques u_g of the suspended exoskeleton.

        The controller adds u_g itself. The result contains the effect of the ground forces and of the patient's weight.

        Args:
            q: joint angles, shape (12,) [rad].
            rotation: rotation matrix from pelvis to world.
            shares: fractions of the weight on the left and on the right foot.
            points: centres of pressure of both feet in the frame of the pelvis [m].
        """
        model = self._model
        model.gravity.linear = rotation.T @ np.array([0.0, 0.0, -GRAVITY])
        torque: Vector = pinocchio.computeGeneralizedGravity(model, self._data, self._full(q))[self._v].copy()
        model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
        now, up = self.stance(q), rotation.T @ np.array([0.0, 0.0, self._weight])
        for foot in range(2):
            force = shares[foot] * up
            moment = np.cross(points[foot] - now.position[foot], force)
            torque[foot * _LEG : (foot + 1) * _LEG] -= self._jacobian(q, foot).T @ np.concatenate([force, moment])
        x, y, z, w = pinocchio.Quaternion(rotation).coeffs().tolist()
        return torque - self._gravity.torque(q, (w, x, y, z))
