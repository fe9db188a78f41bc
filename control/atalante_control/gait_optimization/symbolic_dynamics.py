"""Kinematics and inverse dynamics of the robot standing on its right foot, as CasADi expressions.

`links of the model -> bodies -> Chain (topology, masses and lengths as parameters) -> expressions for the program`. The
root of the model is the pelvis, but the right foot is at rest. The recursion therefore starts at the right foot. It
goes up the stance leg from child to parent, then down the swing leg from parent to child. The algorithm is
Featherstone's recursive Newton-Euler algorithm in link frames. An acceleration of a link is the acceleration of its
frame origin, including gravity. The root frame is the stance foot frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np

from atalante_control.model import BASE_LINK, LEG_LINKS, Inertia, Link, Vector3
from atalante_hal.robot import JOINTS, SIDES
from atalante_hal.types import Vector

Symbol = Any  # casadi.SX

_LEFT, _RIGHT = SIDES
STANCE_FOOT, SWING_FOOT = f"{_RIGHT}_{LEG_LINKS['HA']}", f"{_LEFT}_{LEG_LINKS['HA']}"
_NUMBERS = 13  # parameters per body: mass (1), first moment (3), inertia about the origin (6), joint origin (3)


@dataclass(frozen=True)
class Body:
    """Moving link, fused with all links that are fixed to it."""

    name: str  # name of the moving link
    parent: str  # name of the parent link
    joint: int  # index of the joint in JOINTS; -1 for the pelvis, which has no joint
    origin: Vector3  # m, position of the joint in the frame of the parent link
    yaw: float  # rad, angle of the link frame relative to the parent frame about the z axis, at joint angle 0
    axis: Vector3  # joint axis in the frame of the link
    mass: float  # kg, mass of the body
    moment: Vector3  # kg m, mass times position of the centre of mass
    inertia: Vector  # (6,) kg m2, inertia about the origin of the link: xx, xy, xz, yy, yz, zz


@dataclass(frozen=True)
class Wrench:
    """Wrench of the ground on the stance foot, at the origin and in the axes of the foot link."""

    force: Symbol  # (3,) N, ground force
    moment: Symbol  # (3,) Nm, ground moment about the origin of the foot link


@dataclass(frozen=True)
class Frame:
    """Pose and velocity of a link in the frame of the stance foot."""

    rotation: Symbol  # (3, 3), rotation matrix from the axes of the link to the axes of the stance foot
    position: Symbol  # (3,) m, position of the origin of the link
    angular: Symbol  # (3,) rad/s, angular velocity in the axes of the link
    linear: Symbol  # (3,) m/s, velocity of the origin of the link, in the axes of the link


def bodies(links: Sequence[Link]) -> tuple[Body, ...]:
    """Return the pelvis and the twelve moving bodies in the order of `JOINTS`. Fixed links are fused into these bodies.

    Args:
        links: links of the model, parents first.

    Raises:
        ValueError: If a fixed link is rotated, or if it is fixed to another fixed link. Neither is supported.
    """
    carriers = {link.name: link for link in links if link.joint or link.name == BASE_LINK}
    mass = dict.fromkeys(carriers, 0.0)
    moment = {name: np.zeros(3) for name in carriers}
    inertia = {name: np.zeros((3, 3)) for name in carriers}
    for link in links:
        carrier, offset = (link.name, np.zeros(3)) if link.name in carriers else (link.parent, np.array(link.origin))
        if carrier not in carriers:
            raise ValueError(f"parent of the fixed link {link.name} must be a moving link, got {link.parent}")
        if carrier != link.name and link.yaw:
            raise ValueError(f"yaw of the fixed link {link.name} must be 0 rad, got {link.yaw!r} rad")
        centre = offset + np.array(link.inertia.centre)
        mass[carrier] += link.inertia.mass
        moment[carrier] += link.inertia.mass * centre
        inertia[carrier] += _tensor(link.inertia) + link.inertia.mass * (
            centre @ centre * np.eye(3) - np.outer(centre, centre)
        )
    upper = np.triu_indices(3)
    ordered = sorted(carriers.values(), key=lambda link: JOINTS.index(link.joint) if link.joint else -1)
    return tuple(
        Body(
            link.name,
            link.parent,
            JOINTS.index(link.joint) if link.joint else -1,
            link.origin,
            link.yaw,
            link.axis,
            mass[link.name],
            (float(moment[link.name][0]), float(moment[link.name][1]), float(moment[link.name][2])),
            inertia[link.name][upper],
        )
        for link in ordered
    )


class Chain:
    """Chain of bodies from stance foot to swing foot. Masses and lengths are symbols, so the chain is valid for every subject.

    Axes and toe-out are constants. Numbers that are zero in the reference robot remain zero, which keeps the expressions small.
    """

    def __init__(self, reference: Sequence[Link]) -> None:
        """Build the chain from a reference robot.

        Args:
            reference: links of the reference robot. They define the topology, the axes, and which masses and lengths
                are zero.
        """
        self.bodies = bodies(reference)
        numbers = _numbers(self.bodies)
        self._used = np.flatnonzero(numbers)
        self.symbols = casadi.SX.sym("chain", len(self._used))
        flat = [casadi.SX(0)] * numbers.size
        for i, index in enumerate(self._used):
            flat[index] = self.symbols[i]
        width = numbers.shape[1]
        self._rows = [casadi.vertcat(*flat[i * width : (i + 1) * width]) for i in range(len(self.bodies))]
        by_name = {named.name: i for i, named in enumerate(self.bodies)}
        self._route: list[tuple[int, int, bool]] = []  # (body, next body, True if the next body is the parent)
        body = by_name[STANCE_FOOT]
        while self.bodies[body].parent:
            parent = by_name[self.bodies[body].parent]
            self._route.append((body, parent, True))
            body = parent
        self._route += [
            (by_name[child.parent], by_name[child.name], False) for child in self.bodies if child.name.startswith(_LEFT)
        ]
        self.root, self.pelvis, self.swing_foot = by_name[STANCE_FOOT], by_name[BASE_LINK], by_name[SWING_FOOT]
        #: Yaw of the stance foot relative to the pelvis with all joints at zero [rad].
        self.stance_yaw = math.fsum(link.yaw for link in self.bodies if link.name.startswith(_RIGHT))

    def values(self, links: Sequence[Link]) -> Vector:
        """Return the masses, inertias and lengths of a robot, one number for each element of `symbols`.

        Args:
            links: links of the robot.

        Raises:
            ValueError: If name, parent, joint, yaw or axis of a body differs from the reference robot, or if a number that is
                zero in the reference robot is not zero in the given robot.
        """
        robot = bodies(links)
        for body, reference in zip(robot, self.bodies, strict=True):
            if (found := _structure(body)) != (expected := _structure(reference)):
                raise ValueError(
                    f"name, parent, joint, yaw and axis of body {reference.name} must be {expected} as in the reference robot, "
                    f"got {found}"
                )
        numbers = _numbers(robot).ravel()
        unused = np.delete(numbers, self._used)
        if unused.any():
            raise ValueError(
                "masses, inertias and lengths that are 0 in the reference robot must also be 0 in the given robot, "
                f"got {unused[unused != 0.0].tolist()}"
            )
        return np.asarray(numbers[self._used])

    def frames(self, q: Symbol, qd: Symbol) -> dict[int, Frame]:
        """Return pose and velocity of every body, by index in `bodies`. The stance foot is at rest.

        Args:
            q: joint angles, SX of shape (12,) [rad].
            qd: joint speeds, SX of shape (12,) [rad/s].
        """
        zero = casadi.SX(3, 1)
        frames = {self.root: Frame(casadi.SX.eye(3), zero, zero, zero)}
        for known, new, upwards in self._route:
            at, body = frames[known], self.bodies[known if upwards else new]
            turn, origin, axis = self._joint(known if upwards else new, q)
            rate = qd[body.joint] * axis
            if upwards:
                rotation = at.rotation @ turn.T
                angular = turn @ (at.angular - rate)
                position = at.position - rotation @ origin
                linear = turn @ at.linear - casadi.cross(angular, origin)
            else:
                rotation = at.rotation @ turn
                angular = turn.T @ at.angular + rate
                position = at.position + at.rotation @ origin
                linear = turn.T @ (at.linear + casadi.cross(at.angular, origin))
            frames[new] = Frame(rotation, position, angular, linear)
        return frames

    def inverse_dynamics(
        self, q: Symbol, qd: Symbol, qdd: Symbol, linear: Symbol, angular: Symbol
    ) -> tuple[Symbol, Wrench]:
        """Return the joint torques (12,) [Nm] and the ground wrench of a motion of the chain.

        The angular velocity of the stance foot is zero. For an impact, pass velocity changes as accelerations, and zero as `qd`.
        The results are then the joint impulses and the ground impulse.

        Args:
            q: joint angles, SX of shape (12,) [rad].
            qd: joint speeds, SX of shape (12,) [rad/s].
            qdd: joint accelerations, SX of shape (12,) [rad/s2].
            linear: acceleration of the stance foot origin in the axes of the foot; gravity is an upward acceleration [m/s2].
            angular: angular acceleration of the stance foot in the axes of the foot [rad/s2].
        """
        omega, alpha, acceleration = {self.root: casadi.SX(3, 1)}, {self.root: angular}, {self.root: linear}
        turns, origins, axes = {}, {}, {}
        cross = casadi.cross
        for known, new, upwards in self._route:
            child = known if upwards else new
            body = self.bodies[child]
            turn, origin, axis = turns[child], origins[child], axes[child] = self._joint(child, q)
            rate, rate2 = qd[body.joint] * axis, qdd[body.joint] * axis
            if upwards:
                w, b = omega[known], alpha[known]
                omega[new] = turn @ (w - rate)
                alpha[new] = turn @ (b - rate2 - cross(w, rate))
                acceleration[new] = turn @ acceleration[known] - _carried(omega[new], alpha[new], origin)
            else:
                w = turn.T @ omega[known]
                omega[new] = w + rate
                alpha[new] = turn.T @ alpha[known] + rate2 + cross(w, rate)
                acceleration[new] = turn.T @ (acceleration[known] + _carried(omega[known], alpha[known], origin))
        force, moment = {}, {}
        for i, row in enumerate(self._rows):
            mass, first, inertia = row[0], row[1:4], _symmetric(row[4:10])
            w, b, a = omega[i], alpha[i], acceleration[i]
            force[i] = mass * a + _carried(w, b, first)
            moment[i] = inertia @ b + cross(w, inertia @ w) + cross(first, a)
        torque = [casadi.SX(0)] * len(JOINTS)
        for known, new, upwards in reversed(self._route):
            child = known if upwards else new
            turn, origin, axis = turns[child], origins[child], axes[child]
            f, n = force[new], moment[new]
            if upwards:
                f, n = turn.T @ f, turn.T @ (n - cross(origin, f))
                torque[self.bodies[child].joint] = -casadi.dot(axis, n)
            else:
                torque[self.bodies[child].joint] = casadi.dot(axis, n)
                f = turn @ f
                n = turn @ n + cross(origin, f)
            force[known], moment[known] = force[known] + f, moment[known] + n
        return casadi.vertcat(*torque), Wrench(force[self.root], moment[self.root])

    def _joint(self, child: int, q: Symbol) -> tuple[Symbol, Symbol, Symbol]:
        """Return rotation from child to parent, joint position in the parent frame, and axis in the child frame."""
        body = self.bodies[child]
        norm = math.hypot(*body.axis)
        axis = np.array(body.axis) / norm
        along = np.outer(axis, axis)
        skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
        angle = q[body.joint]
        turn = casadi.DM(along) + casadi.cos(angle) * casadi.DM(np.eye(3) - along) + casadi.sin(angle) * casadi.DM(skew)
        if body.yaw:
            c, s = math.cos(body.yaw), math.sin(body.yaw)
            turn = casadi.DM([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ turn
        return turn, self._rows[child][10:13], casadi.SX(casadi.DM(axis))


def _carried(omega: Symbol, alpha: Symbol, lever: Symbol) -> Symbol:
    """Return the acceleration of a point of a rotating body minus the acceleration of the origin of the body.

    Args:
        omega: angular velocity [rad/s].
        alpha: angular acceleration [rad/s2].
        lever: position of the point relative to the origin [m].
    """
    return casadi.cross(alpha, lever) + casadi.cross(omega, casadi.cross(omega, lever))


def _tensor(inertia: Inertia) -> Vector:
    xx, xy, xz, yy, yz, zz = inertia.tensor
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _symmetric(six: Symbol) -> Symbol:
    xx, xy, xz, yy, yz, zz = (six[i] for i in range(6))
    return casadi.vertcat(casadi.horzcat(xx, xy, xz), casadi.horzcat(xy, yy, yz), casadi.horzcat(xz, yz, zz))


def _structure(body: Body) -> tuple[str, str, int, float, Vector3]:
    return body.name, body.parent, body.joint, body.yaw, body.axis


def _numbers(chain: Sequence[Body]) -> Vector:
    return np.array([(body.mass, *body.moment, *body.inertia, *body.origin) for body in chain])
