"""Independent verification of a gait: `gait, patient -> Pinocchio -> checks of joints, ground forces and impact`.

The verification shares no code with the optimiser. Polynomials are evaluated by de Casteljau's algorithm, and the model is the
URDF. The pelvis is a floating base. The stance foot is at rest, so the joint motion determines the motion of the
pelvis. Torques and ground wrench come from the recursive Newton-Euler algorithm. The impact is computed with the KKT
system of the floating robot. The step is sampled every few milliseconds, which is finer than the nodes of the
optimiser.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pinocchio

from atalante_control.gait.gait import POSITION_JUMP, SIGN, SWAP, VELOCITY_JUMP, Gait
from atalante_control.model import BASE_LINK, LEG_LINKS, ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_hal.robot import SIDES, Robot
from atalante_hal.types import GRAVITY, Vector

_LEFT, _RIGHT = (f"{side}_{LEG_LINKS['HA']}" for side in SIDES)
_SAMPLES = 201  # number of samples of a step
_LOCAL = pinocchio.ReferenceFrame.LOCAL
_CLEARANCE = 0.05  # m, intended height of the swing sole at mid-swing
_FRICTION = 0.5  # largest friction coefficient between sole and ground that a verified gait may need
#: Ns, largest accepted difference: horizontal impact impulse minus the largest impulse that friction can transmit.
#: An impulse of 1 Ns changes the speed of the robot by some mm/s.
_SLIDING = 1.0
_SLIDE = 0.04  # m/s, accepted horizontal speed of a corner of the sole at the landing
_DROP = 0.035  # m/s, accepted downward speed of a corner of the sole at the landing
_LIFT = 0.005  # m/s, accepted upward speed of a corner of the sole at the landing
_SHORTFALL = 2e-3  # m, accepted distance of the swing sole below its intended height
_SINKING = 1e-3  # m, accepted depth of the swing sole below the ground at any sample of the step


class Tolerances(NamedTuple):
    """Accepted errors of the conditions that the optimiser enforces as equality constraints."""

    landing_height: float  # m, height error of the landing foot
    landing_rotation: float  # rad, rotation error of the landing foot about each axis
    angle_jump: float  # rad, jump of a joint angle at the stance change
    impact_speed: float  # rad/s, error of a joint speed after the impact


#: Tolerances of a solved step, equal to the tolerances of the equality constraints of the optimiser.
EXACT = Tolerances(1e-6, 1e-6, 1e-6, 1e-6)
#: Tolerances of a step of the gait network. The network interpolates solved steps, so the conditions hold only approximately.
INTERPOLATED = Tolerances(1e-3, math.radians(0.3), POSITION_JUMP, VELOCITY_JUMP)


class GaitCheck(NamedTuple):
    """Result of one check of a gait: the largest value and its limit."""

    name: str
    value: float
    limit: float
    unit: str

    @property
    def holds(self) -> bool:
        """Return whether the checked value is within its limit."""
        return self.value <= self.limit


class _Motion(NamedTuple):
    """Joint angles, speeds and accelerations at the samples of a step."""

    q: Vector  # (n, 12) rad, joint angles
    qd: Vector  # (n, 12) rad/s, joint speeds
    qdd: Vector  # (n, 12) rad/s2, joint accelerations


class Verifier:
    """Verifier of gaits for the exoskeleton with one patient. The model has a floating base."""

    def __init__(self, robot: Robot, patient: Patient) -> None:
        """Build the Pinocchio model from the URDF.

        Args:
            robot: limits of the joints.
            patient: patient in the exoskeleton.
        """
        self._robot, self._exo = robot, ExoskeletonParameters()
        self._articulated = pinocchio_model(urdf(self._exo, robot, patient), fixed_base=False)
        model = self._articulated.model
        self._data: Any = model.createData()
        self._left, self._right, self._pelvis = (model.getFrameId(name) for name in (_LEFT, _RIGHT, BASE_LINK))
        self.weight = pinocchio.computeTotalMass(model) * GRAVITY  # N, weight of exoskeleton and patient

    def verify(self, gait: Gait, kind: str = "periodic", tolerances: Tolerances = EXACT) -> tuple[GaitCheck, ...]:
        """Run all checks of a right-stance step.

        Args:
            gait: gait to verify.
            kind: kind of step, `periodic`, `start` or `stop`. A start step begins at rest, a stop step ends at rest. Neither has
                an impact.
            tolerances: accepted errors of the equality constraints.
        """
        motion = _sampled(gait, np.linspace(0.0, 1.0, _SAMPLES))
        checks = [*self._joints(motion), *self._loads(motion), *self._swing(motion, 2 if kind == "periodic" else 4)]
        if kind == "periodic":
            return (*checks, *self._cycle(motion, tolerances), *self._touchdown(motion))
        return (*checks, *self._rest(motion, kind, tolerances))

    def loads(self, q: Vector, qd: Vector, qdd: Vector) -> tuple[Vector, Vector]:
        """Return joint torques (12,) [Nm] and ground wrench (6,) [N, Nm] of one state.

        The wrench acts at the origin of the stance foot. Its components are in the axes of this foot.

        Args:
            q: joint angles, shape (12,) [rad].
            qd: joint speeds, shape (12,) [rad/s].
            qdd: joint accelerations, shape (12,) [rad/s2].
        """
        model, data, joints = self._articulated.model, self._data, self._articulated.v
        configuration, speed, acceleration = self._on_right_foot(q), np.zeros(model.nv), np.zeros(model.nv)
        speed[joints], acceleration[joints] = qd, qdd
        jacobian = pinocchio.computeFrameJacobian(model, data, configuration, self._right, _LOCAL)
        base = jacobian[:, :6]
        speed[:6] = -np.linalg.solve(base, jacobian @ speed)
        pinocchio.forwardKinematics(model, data, configuration, speed, acceleration)
        drift = pinocchio.getFrameAcceleration(model, data, self._right, _LOCAL).vector
        acceleration[:6] = -np.linalg.solve(base, drift)
        demanded = pinocchio.rnea(model, data, configuration, speed, acceleration)
        wrench = np.linalg.solve(base.T, demanded[:6])
        return (demanded - jacobian.T @ wrench)[joints], wrench

    def impact(self, q: Vector, qd: Vector) -> tuple[Vector, Vector, Vector]:
        """Compute the impact of the left foot, which lands flat and does not rebound.

        The equation is [M -J^T; J 0] (v+, impulse) = (M v-, 0), where J is the Jacobian of the foot that lands.

        Args:
            q: joint angles, shape (12,) [rad].
            qd: joint speeds before the impact, shape (12,) [rad/s].

        Returns:
            Joint speeds after the impact (12,) [rad/s], impulse on the left foot (6,), and twist of the right foot (6,).
        """
        model, data, joints = self._articulated.model, self._data, self._articulated.v
        configuration, before, leaving = self._standing(q, qd)
        landing = pinocchio.computeFrameJacobian(model, data, configuration, self._left, _LOCAL).copy()
        upper = np.triu(pinocchio.crba(model, data, configuration))
        mass = upper + np.triu(upper, 1).T
        system = np.block([[mass, -landing.T], [landing, np.zeros((6, 6))]])
        outcome = np.linalg.solve(system, np.concatenate([mass @ before, np.zeros(6)]))
        after = outcome[: model.nv]
        return after[joints], outcome[model.nv :], leaving @ after

    def corner_speeds(self, q: Vector, qd: Vector) -> Vector:
        """Return the velocities of the corners of the left sole, in the axes of the left foot, shape (4, 3) [m/s].

        The right foot is at rest.

        Args:
            q: joint angles, shape (12,) [rad].
            qd: joint speeds, shape (12,) [rad/s].
        """
        configuration, speed, _ = self._standing(q, qd)
        model, data = self._articulated.model, self._data
        twist = pinocchio.computeFrameJacobian(model, data, configuration, self._left, _LOCAL) @ speed
        return np.asarray(twist[:3] + np.cross(twist[3:], self._corners()))

    def _joints(self, motion: _Motion) -> list[GaitCheck]:
        robot = self._robot
        beyond = np.maximum(robot.position_min - motion.q, motion.q - robot.position_max)
        speed = np.abs(motion.qd) / robot.velocity_max
        return [
            GaitCheck("joint angle beyond its limit", float(beyond.max()), 0.0, "rad"),
            GaitCheck("joint speed relative to its limit", float(speed.max()), 1.0, ""),
        ]

    def _loads(self, motion: _Motion) -> list[GaitCheck]:
        loads = [self.loads(*state) for state in zip(*motion, strict=True)]
        torque = np.array([row[0] for row in loads])
        wrench = np.array([row[1] for row in loads])
        exo, force = self._exo, wrench[:, :3]
        x, z = exo.sole_centre
        moment = wrench[:, 3:] - np.cross([x, 0.0, z], force)
        vertical = force[:, 2]
        slip = np.hypot(force[:, 0], force[:, 1]) / vertical
        return [
            GaitCheck(
                "joint torque relative to its limit",
                float((np.abs(torque) / self._robot.torque_max).max()),
                1.0,
                "",
            ),
            GaitCheck("unloaded fraction of the weight", float(1.0 - vertical.min() / self.weight), 0.5, ""),
            GaitCheck("required friction coefficient", float(slip.max()), _FRICTION, ""),
            GaitCheck(
                "centre of pressure along the sole",
                float(np.abs(moment[:, 1] / vertical).max()),
                exo.sole_size[0] / 2,
                "m",
            ),
            GaitCheck(
                "centre of pressure across the sole", float(np.abs(moment[:, 0] / vertical).max()), exo.cell_y, "m"
            ),
            GaitCheck("yaw moment per vertical force", float(np.abs(moment[:, 2] / vertical).max()), 0.05, "m"),
        ]

    def _swing(self, motion: _Motion, exponent: int) -> list[GaitCheck]:
        heights, widths, tilt = [], [], []
        forward = self._forward()
        for q in motion.q:
            stance, swing, pelvis = self._poses(q)
            swing, pelvis = stance.actInv(swing), stance.actInv(pelvis)
            heights.append((swing.rotation @ self._corners().T)[2] + swing.translation[2] - self._exo.sole_centre[1])
            widths.append((forward.T @ swing.translation)[1])
            tilt.append(np.abs(pinocchio.log3(forward.T @ pelvis.rotation)).max())
        lowest = np.min(heights, axis=1)
        needed = _CLEARANCE * np.sin(np.pi * np.linspace(0.0, 1.0, _SAMPLES)) ** exponent
        return [
            GaitCheck("swing sole below its intended height", float((needed - lowest).max()), _SHORTFALL, "m"),
            GaitCheck("depth of the swing sole in the ground", float(-lowest.min()), _SINKING, "m"),
            GaitCheck("lateral overlap of the feet", self._foot_width() - min(widths), 0.0, "m"),
            GaitCheck("rotation of the pelvis", max(tilt), math.radians(8.0), "rad"),
        ]

    def _touchdown(self, motion: _Motion) -> list[GaitCheck]:
        """Return the checks of a soft landing at the corners of the sole."""
        speeds = self.corner_speeds(motion.q[-1], motion.qd[-1])
        slide = np.hypot(speeds[:, 0], speeds[:, 1])
        return [
            GaitCheck("slide of a sole corner at the landing", float(slide.max()), _SLIDE, "m/s"),
            GaitCheck("downward speed of a sole corner at the landing", float(-speeds[:, 2].min()), _DROP, "m/s"),
            GaitCheck("upward speed of a sole corner at the landing", float(speeds[:, 2].max()), _LIFT, "m/s"),
        ]

    def _cycle(self, motion: _Motion, tolerances: Tolerances) -> list[GaitCheck]:
        """Return the checks of a periodic step: landing pose, periodicity, impact map."""
        after, impulse, leaving = self.impact(motion.q[-1], motion.qd[-1])
        mirrored_q, mirrored_qd = SIGN * motion.q[0][SWAP], SIGN * motion.qd[0][SWAP]
        # Ns, horizontal impulse minus the largest impulse that friction can transmit; at most `_SLIDING` is accepted.
        sliding = math.hypot(impulse[0], impulse[1]) - _FRICTION * impulse[2]
        sinking = -min(leaving[2] + np.cross(leaving[3:], corner)[2] for corner in self._corners())
        return [
            *self._landing(motion.q[-1], tolerances),
            GaitCheck(
                "angle jump at the stance change",
                float(np.abs(motion.q[-1] - mirrored_q).max()),
                tolerances.angle_jump,
                "rad",
            ),
            GaitCheck(
                "speed error of the impact map",
                float(np.abs(after - mirrored_qd).max()),
                tolerances.impact_speed,
                "rad/s",
            ),
            GaitCheck("downward impact impulse", float(-impulse[2]), 0.0, "Ns"),
            GaitCheck("impact impulse beyond friction", sliding, _SLIDING, "Ns"),
            GaitCheck("sinking speed of the rear foot", float(sinking), 0.01 + EXACT.impact_speed, "m/s"),
        ]

    def _rest(self, motion: _Motion, kind: str, tolerances: Tolerances) -> list[GaitCheck]:
        end = 0 if kind == "start" else -1
        return [
            *self._landing(motion.q[end], tolerances),
            GaitCheck("speed at rest", float(np.abs(motion.qd[end]).max()), tolerances.impact_speed, "rad/s"),
            GaitCheck("acceleration at rest", float(np.abs(motion.qdd[end]).max()), 1e-3, "rad/s2"),
        ]

    def _landing(self, q: Vector, tolerances: Tolerances) -> list[GaitCheck]:
        """Return the checks of the landing pose: left foot flat on the ground, toe-out mirrored from the right foot."""
        stance, swing, _ = self._poses(q)
        relative = stance.actInv(swing)
        turned = self._forward() @ self._forward()
        return [
            GaitCheck(
                "height error of the landing foot",
                abs(float(relative.translation[2])),
                tolerances.landing_height,
                "m",
            ),
            GaitCheck(
                "rotation error of the landing foot",
                float(np.abs(pinocchio.log3(turned.T @ relative.rotation)).max()),
                tolerances.landing_rotation,
                "rad",
            ),
        ]

    def _poses(self, q: Vector) -> tuple[Any, Any, Any]:
        """Return the poses of right foot, left foot and pelvis, with the pelvis at the world origin."""
        configuration = pinocchio.neutral(self._articulated.model)
        configuration[self._articulated.q] = q
        pinocchio.framesForwardKinematics(self._articulated.model, self._data, configuration)
        frames = self._data.oMf
        return frames[self._right].copy(), frames[self._left].copy(), frames[self._pelvis].copy()

    def _on_right_foot(self, q: Vector) -> Vector:
        """Return the configuration of the floating robot with its right foot at the world origin."""
        stance, _, pelvis = self._poses(q)
        configuration = pinocchio.neutral(self._articulated.model)
        configuration[self._articulated.q] = q
        configuration[:7] = pinocchio.SE3ToXYZQUAT(stance.actInv(pelvis))
        return np.asarray(configuration)

    def _standing(self, q: Vector, qd: Vector) -> tuple[Vector, Vector, Vector]:
        """Return configuration and speed of the floating robot with its right foot at rest, and the Jacobian of this foot."""
        model, joints = self._articulated.model, self._articulated.v
        configuration, speed = self._on_right_foot(q), np.zeros(model.nv)
        speed[joints] = qd
        jacobian = pinocchio.computeFrameJacobian(model, self._data, configuration, self._right, _LOCAL).copy()
        speed[:6] = -np.linalg.solve(jacobian[:, :6], jacobian @ speed)
        return configuration, speed, jacobian

    def _forward(self) -> Vector:
        """Return the rotation from the walking frame to the frame of the stance foot. The rotation angle is the toe-out."""
        return np.asarray(pinocchio.utils.rotate("z", self._exo.toe_out))

    def _corners(self) -> Vector:
        """Return the corners of the sole in the frame of the foot, shape (4, 3) [m]."""
        x, z = self._exo.sole_centre
        length, width = self._exo.sole_size
        return np.array([(x + i * length / 2, j * width / 2, z) for i in (1, -1) for j in (1, -1)])

    def _foot_width(self) -> float:
        """Return the largest lateral ankle distance at which the feet touch [m]. The toe-out moves the heels inwards."""
        inner = self._forward().T @ (self._corners() * [1.0, -1.0, 1.0]).T
        return float(2.0 * inner[1].max())


def _sampled(gait: Gait, phases: Vector) -> _Motion:
    first = np.diff(gait.coefficients, axis=1) * (gait.coefficients.shape[1] - 1) / gait.duration
    second = np.diff(first, axis=1) * (first.shape[1] - 1) / gait.duration
    return _Motion(
        *(np.array([_casteljau(points, s) for s in phases]) for points in (gait.coefficients, first, second))
    )


def _casteljau(points: Vector, s: float) -> Vector:
    while points.shape[1] > 1:
        points = (1.0 - s) * points[:, :-1] + s * points[:, 1:]
    return points[:, 0]
