"""Walking step as a nonlinear program: unknowns, constraints in named groups, and cost.

`Chain, Requirements -> constraints of nodes, ends of the step and impact -> NonlinearProgram`, built once per kind of step.
Subject, step length and duration are parameters. Bezier control points determine the motion. The unknowns of a node are the
joint angles, their first and second derivatives with respect to the phase, the torques and the ground wrench. Linear equations
connect the unknowns of a node to the control points. The equations of motion connect the unknowns of the same node. The
redundant unknowns keep the equations short and the matrix sparse.

Stance foot and swing foot are flat rigid bodies on flat ground. The stance foot does not move. Every step is fully
actuated, so no zero dynamics remain in the partial hybrid zero dynamics. The impact map connects the end of a step with
the start of the next step.
"""

from __future__ import annotations

import math
from typing import Any

import casadi
import numpy as np

from atalante_control.gait.gait import DEGREE, SIGN, SWAP, Gait, Kind, bezier, derivative
from atalante_control.gait_optimization.nlp import Indices, NonlinearProgram, Rows
from atalante_control.gait_optimization.requirements import Requirements
from atalante_control.gait_optimization.result import Residual
from atalante_control.gait_optimization.symbolic_dynamics import Chain
from atalante_control.model import ExoskeletonParameters, Patient, links
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import GRAVITY, Vector

Symbol = Any  # casadi.SX
TRANSITION = 1.2  # s, duration of start and stop steps

_N = len(JOINTS)
_POINTS = _N * (DEGREE + 1)  # number of control points; the control points are the first unknowns, sorted by joint
_NODE = 4 * _N + 6  # number of unknowns of a node: q, dq/ds, d2q/ds2, torque, ground force, ground moment
_TORQUE, _FORCE, _MOMENT = 100.0, 1500.0, 1500.0  # scales of joint torque [Nm], ground force [N], ground moment [Nm]
_BOUND_UNITS = {
    "joint limits": ("rad", 0.1),
    "speed limits": ("rad/s", 1.0),
    "torque limits": ("Nm", _TORQUE),
    "vertical ground force": ("N", _FORCE),
}
_KNEES = [i for i, joint in enumerate(JOINTS) if joint.endswith("SK")]
#: Factors that reflect a polar vector in the sagittal plane. For an axial vector the factors have the opposite sign.
_MIRROR = casadi.DM([1.0, -1.0, 1.0])


class StepProblem:
    """Nonlinear program of one kind of step, for any subject, step length and duration.

    Attributes:
        program: nonlinear program with constraints and bounds.
        phases: phases of the nodes, shape (nodes,).
        symbols: symbols of the parameters.
    """

    def __init__(self, kind: Kind, robot: Robot, requirements: Requirements) -> None:
        """Build the nonlinear program. The construction takes some seconds.

        Args:
            kind: kind of step, `periodic`, `start` or `stop`.
            robot: limits of the joints.
            requirements: constraints and cost weights.
        """
        self.kind, self.robot, self.requirements = kind, robot, requirements
        self.exoskeleton = ExoskeletonParameters()
        self.chain = Chain(links(self.exoskeleton, Patient(75.0, 1.75)))
        self.phases = np.linspace(0.0, 1.0, requirements.nodes)
        identity = np.eye(DEGREE + 1)
        self._bases = [bezier(points, self.phases) for points in (identity, derivative(identity))]
        self._bases.append(bezier(derivative(derivative(identity)), self.phases))
        self._duration, self._length = casadi.SX.sym("T"), casadi.SX.sym("L")
        self.symbols = casadi.vertcat(self.chain.symbols, self._duration, self._length)
        self._yaw = casadi.DM(_about_z(self.chain.stance_yaw))  # rotation from stance foot to walking frame
        self.program = NonlinearProgram(_POINTS + requirements.nodes * _NODE, self.symbols)
        self._build()
        #: Name of each group of constraints -> (unit, scale).
        self.units = {group.name: (group.unit, group.size) for group in self.program.groups} | _BOUND_UNITS

    def parameters(self, patient: Patient, duration: float, step_length: float) -> Vector:
        """Return the parameters of the program for a patient and a step: one number for each element of `symbols`.

        The numbers are the masses, inertias and lengths of the robot, the step duration and the step length.

        Args:
            patient: patient in the exoskeleton.
            duration: duration of the step [s].
            step_length: step length [m].
        """
        numbers = self.chain.values(links(self.exoskeleton, patient))
        return np.concatenate([numbers, [duration, step_length if self.kind == "periodic" else 0.0]])

    def joint_range(self) -> tuple[Vector, Vector]:
        """Return the smallest and the largest joint angles that a gait may use, each of shape (12,) [rad]."""
        low = self.robot.position_min + self.requirements.joint_margin
        low[_KNEES] = np.maximum(low[_KNEES], self.requirements.knee_min)
        return low, self.robot.position_max - self.requirements.joint_margin

    def bounds(self, duration: float) -> tuple[Vector, Vector]:
        """Return the lower and upper bounds of the unknowns: limits of angles, speeds, torques and vertical ground force.

        Args:
            duration: duration of the step [s].
        """
        requirements, robot = self.requirements, self.robot
        low, high = self.joint_range()
        speed = requirements.speed_share * robot.velocity_max * duration
        torque = requirements.torque_share * robot.torque_max / _TORQUE
        free = np.full(_N, np.inf)
        upper = np.concatenate([high, speed, free, torque, np.full(6, np.inf)])
        lower = np.concatenate([low, -speed, -free, -torque, np.full(6, -np.inf)])
        lower[4 * _N + 2] = requirements.force_min / _FORCE
        points, nodes = np.full(_POINTS, np.inf), requirements.nodes
        return np.concatenate([-points, np.tile(lower, nodes)]), np.concatenate([points, np.tile(upper, nodes)])

    def unknowns(self, coefficients: Vector, parameters: Vector) -> Vector:
        """Build the vector of the optimiser's unknowns for a given motion, shape (unknowns,).

        The unknowns include joint torques and ground wrench. Both are computed from the motion by inverse dynamics.

        Args:
            coefficients: Bezier control points of the motion, shape (12, 8) [rad].
            parameters: result of `self.parameters()` for patient and step.
        """
        motion = np.stack([basis @ coefficients.T for basis in self._bases], axis=1)  # (nodes, 3, 12)
        loads = self._loads.map(len(self.phases))(motion.reshape(len(motion), -1).T, parameters)
        nodes = np.concatenate([motion.reshape(len(motion), -1), np.array(loads).T], axis=1)
        return np.concatenate([coefficients.ravel(), nodes.ravel()])

    def coefficients(self, unknowns: Vector) -> Vector:
        """Return the control points of a solution, shape (12, 8) [rad].

        Args:
            unknowns: solution, shape (unknowns,).
        """
        return np.asarray(unknowns[:_POINTS].reshape(_N, DEGREE + 1))

    def torques(self, unknowns: Vector) -> Vector:
        """Return the joint torques at the nodes of a solution, shape (nodes, 12) [Nm].

        Args:
            unknowns: solution, shape (unknowns,).
        """
        return np.asarray(unknowns[_POINTS:].reshape(-1, _NODE)[:, 3 * _N : 4 * _N] * _TORQUE)

    @property
    def basis(self) -> Vector:
        """Return the matrix that maps control points to angles at the nodes, shape (nodes, 8)."""
        return self._bases[0]

    def residuals(
        self, unknowns: Vector, rows: Vector, bounds: tuple[Vector, Vector], duration: float
    ) -> dict[str, Residual]:
        """Return the largest violation of each group of constraints, in the SI unit of the group.

        Args:
            unknowns: result of `self.unknowns()`. The torques and ground forces therefore follow from the motion.
            rows: values of g at these unknowns.
            bounds: lower and upper bounds of g.
            duration: duration of the step [s].
        """
        outside, found = _outside(rows, bounds), dict[str, float]()
        for group in self.program.groups:
            value = float(outside[group.rows].max()) * group.size
            found[group.name] = max(value, found.get(group.name, 0.0))
        beyond = _outside(unknowns, self.bounds(duration))[_POINTS:].reshape(-1, _NODE).max(axis=0)
        found["joint limits"] = float(beyond[:_N].max())
        found["speed limits"] = float(beyond[_N : 2 * _N].max()) / duration
        found["torque limits"] = float(beyond[3 * _N : 4 * _N].max()) * _TORQUE
        found["vertical ground force"] = float(beyond[4 * _N :].max()) * _FORCE
        return {name: Residual(value, self.units[name][0]) for name, value in found.items()}

    def node(self, index: int) -> Indices:
        """Return the indices of the unknowns of a node.

        Args:
            index: index of the node.
        """
        return _POINTS + index * _NODE + np.arange(_NODE)

    def _build(self) -> None:
        requirements, program = self.requirements, self.program
        last = requirements.nodes - 1
        q, v, a, torque, wrench = (casadi.SX.sym(name, n) for name, n in zip("qvatw", (_N, _N, _N, _N, 6), strict=True))
        z = casadi.vertcat(q, v, a, torque, wrench)
        rate, acceleration = v / self._duration, a / self._duration**2
        up = casadi.DM([0.0, 0.0, GRAVITY])
        torques, ground = self.chain.inverse_dynamics(q, rate, acceleration, up, casadi.SX(3, 1))
        loads = casadi.vertcat(torques / _TORQUE, ground.force / _FORCE, ground.moment / _MOMENT)
        self._loads = casadi.Function("loads", [casadi.vertcat(q, v, a), self.symbols], [loads])
        self.reach = self._reach_function(q)

        program.add_linear("trajectory", "rad", self._trajectory_rows(), np.zeros(3 * _N * requirements.nodes))
        self._add_boundary()
        everywhere = [*self._dynamics(loads, torque, wrench), *self._ground(wrench), *self.attitude(q)]
        swing = self._swing(q, rate)
        program.add(everywhere, z, [self.node(0), self.node(last)])
        program.add([*everywhere, *swing], z, [self.node(n) for n in range(1, last)])
        pose = self.landing(q)
        if self.kind == "periodic":
            program.add([*pose, *self._touchdown(q, rate)], z, [self.node(last)])
            self._add_impact()
        else:
            program.add(pose, z, [self.node(0 if self.kind == "start" else last)])
        weights = np.full(requirements.nodes, 1.0 / last)
        weights[[0, last]] *= 0.5
        pressure = self._pressure_moment(wrench)
        sole = self.chain.frames(q, rate)[self.chain.swing_foot].rotation[2, :2]
        cost = (
            casadi.sumsqr(torque)
            + requirements.tilt_weight * casadi.sumsqr(sole)
            + requirements.acceleration_weight * casadi.sumsqr(acceleration)
            + requirements.pressure_weight * casadi.sumsqr(pressure[:2] / _MOMENT)
        )
        program.minimise(cost, z, [self.node(n) for n in range(requirements.nodes)], weights)

    def _reach_function(self, q: Symbol) -> Any:
        """Return a CasADi function for inverse kinematics: `pose, target, parameters -> error, Jacobian of the error`.

        The target contains the positions of pelvis and swing ankle in the walking frame [m]. The error contains the position
        errors and the tilts of pelvis and swing foot.
        """
        target = casadi.SX.sym("target", 6)
        frames = self.chain.frames(q, casadi.SX(_N, 1))
        pelvis, foot = frames[self.chain.pelvis], frames[self.chain.swing_foot]
        error = casadi.vertcat(
            self._yaw @ pelvis.position - target[:3],
            _tilt(self._yaw @ pelvis.rotation),
            self._yaw @ foot.position - target[3:],
            _tilt(self._yaw @ self._yaw @ foot.rotation),
        )
        return casadi.Function("reach", [q, target, self.symbols], [error, casadi.jacobian(error, q)])

    def _trajectory_rows(self) -> Vector:
        """Return the matrix A of the constraints A x = 0, which connect control points with q, dq/ds and d2q/ds2 at the nodes."""
        rows = np.zeros((self.requirements.nodes, 3, _N, self.program.unknowns))
        for node in range(self.requirements.nodes):
            for order, basis in enumerate(self._bases):
                for joint in range(_N):
                    row = rows[node, order, joint]
                    row[joint * (DEGREE + 1) : (joint + 1) * (DEGREE + 1)] = -basis[node]
                    row[self.node(node)[order * _N + joint]] = 1.0
        return rows.reshape(-1, self.program.unknowns)

    def _control_point(self, index: int) -> Vector:
        """Return the matrix that selects the control point `index` of every joint from the unknowns, shape (12, unknowns)."""
        rows = np.zeros((_N, self.program.unknowns))
        rows[np.arange(_N), np.arange(_N) * (DEGREE + 1) + index % (DEGREE + 1)] = 1.0
        return rows

    def _add_boundary(self) -> None:
        program, point = self.program, self._control_point
        if self.kind == "periodic":
            rows = point(0) - SIGN[:, None] * point(-1)[SWAP]
            program.add_linear("periodicity", "rad", rows, np.zeros(_N))
            return
        # A start step begins at rest and ends in the periodic gait. A stop step begins in the periodic gait and ends at rest.
        given, rest = ((-1, -2), (0, 1, 2)) if self.kind == "start" else ((0, 1), (-1, -2, -3))
        for name, index in zip(("gait pose", "gait speed"), given, strict=True):
            program.add_linear(name, "rad", point(index), np.zeros(_N))
        for name, index in zip(("rest", "rest acceleration"), rest[1:], strict=True):
            program.add_linear(name, "rad", point(rest[0]) - point(index), np.zeros(_N))

    def constraint_bounds(self, around: Gait | None = None) -> tuple[Vector, Vector]:
        """Return the lower and upper bounds of the constraint function g.

        A start step ends in the periodic gait, and a stop step begins in the periodic gait. Where the steps meet, both must have
        the same joint angles and the same joint speeds. At each end of a step, the outermost control point is the joint angle.
        The joint speed is proportional to (difference to the next control point) / (step duration). A start or stop step lasts
        `TRANSITION` seconds. So the difference in the periodic step is multiplied by TRANSITION / around.duration.

        Args:
            around: periodic gait after a start step or before a stop step; None for a periodic step.
        """
        lower, upper = self.program.lower.copy(), self.program.upper.copy()
        if around is not None:
            end, next_one = (-1, -2) if self.kind == "start" else (0, 1)
            pose, other = around.coefficients[:, end], around.coefficients[:, next_one]
            # Joint speed = constant * (difference of two control points) / (step duration).
            # So for the same joint speed, a step that lasts twice as long needs twice the difference of the control points.
            points = {"gait pose": pose, "gait speed": pose + (other - pose) * TRANSITION / around.duration}
            for group in self.program.groups:
                if group.name in points:
                    lower[group.rows] = upper[group.rows] = points[group.name]
        return lower, upper

    def _dynamics(self, loads: Symbol, torque: Symbol, wrench: Symbol) -> list[Rows]:
        zero = np.zeros(_N)
        return [
            Rows("equation of motion", "Nm", _TORQUE, (loads[:_N] - torque) * _TORQUE, zero, zero),
            Rows("ground force balance", "N", _FORCE, (loads[_N : _N + 3] - wrench[:3]) * _FORCE, zero[:3], zero[:3]),
            Rows("ground moment balance", "Nm", _MOMENT, (loads[_N + 3 :] - wrench[3:]) * _MOMENT, zero[:3], zero[:3]),
        ]

    def _pressure_moment(self, wrench: Symbol) -> Symbol:
        """Return the ground moment about the centre of the sole [Nm]."""
        x, z = self.exoskeleton.sole_centre
        return wrench[3:] * _MOMENT - casadi.cross(casadi.DM([x, 0.0, z]), wrench[:3] * _FORCE)

    def _ground(self, wrench: Symbol) -> list[Rows]:
        """Return the constraints on friction, centre of pressure and yaw moment of the stance foot.

        Each constraint is a margin in newtons that must be at least 0. The margin of a moment is the vertical force minus
        |moment| / lever. The lever is the largest allowed ratio of moment to vertical force [m].
        """
        requirements, exo = self.requirements, self.exoskeleton
        force, moment = wrench[:3] * _FORCE, self._pressure_moment(wrench)
        length, width = exo.sole_size
        lever_x = min(
            requirements.sole_share * length / 2, requirements.cell_share * (exo.cell_x[0] - exo.cell_x[1]) / 2
        )
        lever_y = min(requirements.sole_share * width / 2, requirements.cell_share * exo.cell_y)

        def within(value: Symbol, lever: float) -> Symbol:
            return casadi.vertcat(force[2] - value / lever, force[2] + value / lever)

        # The friction cone is written with squares, because the norm of the horizontal force is not differentiable at 0.
        # The division by `_FORCE` gives the unit N.
        cone = (force[2] ** 2 - (force[0] ** 2 + force[1] ** 2) / requirements.friction**2) / _FORCE
        return [
            _positive("ground friction", "N", _FORCE, cone),
            _positive("centre of pressure along the sole", "N", _FORCE, within(moment[1], lever_x)),
            _positive("centre of pressure across the sole", "N", _FORCE, within(moment[0], lever_y)),
            _positive("yaw moment of the stance foot", "N", _FORCE, within(moment[2], requirements.yaw_lever)),
        ]

    def attitude(self, q: Symbol) -> list[Rows]:
        """Return the constraints that keep the pelvis upright and facing forward.

        Args:
            q: joint angles, SX of shape (12,) [rad].
        """
        requirements = self.requirements
        tilt = _tilt(self._yaw @ self.chain.frames(q, casadi.SX(_N, 1))[self.chain.pelvis].rotation)
        limit = np.sin([requirements.roll, requirements.pitch, requirements.yaw])
        return [Rows("pelvis attitude", "rad", 0.1, tilt, -limit, limit)]

    def _swing(self, q: Symbol, rate: Symbol) -> list[Rows]:
        """Return the constraints on the height of the swing sole and on the lateral position of the swing ankle."""
        requirements = self.requirements
        foot = self.chain.frames(q, rate)[self.chain.swing_foot]
        ground = self.exoskeleton.sole_centre[1]
        heights = [
            foot.position[2] + casadi.dot(foot.rotation[2, :].T, casadi.DM(corner)) - ground
            for corner in self._corners()
        ]
        needed = requirements.clearance * np.sin(np.pi * self.phases[1:-1, None]) ** (
            2 if self.kind == "periodic" else 4
        )
        side = (self._yaw @ foot.position)[1]
        return [
            Rows("swing clearance", "m", 0.05, casadi.vertcat(*heights), np.tile(needed, 4), np.full(4, np.inf)),
            Rows(
                "swing corridor",
                "m",
                0.1,
                side,
                np.array([requirements.corridor[0]]),
                np.array([requirements.corridor[1]]),
            ),
        ]

    def landing(self, q: Symbol) -> list[Rows]:
        """Return the constraints of the landing pose: swing foot flat on the ground, one step length ahead, mirrored toe-out.

        Args:
            q: joint angles, SX of shape (12,) [rad].
        """
        foot = self.chain.frames(q, casadi.SX(_N, 1))[self.chain.swing_foot]
        position = self._yaw @ foot.position
        # The first `_yaw` removes the toe-out of the stance foot, the second one the toe-out of the swing foot.
        tilt = _tilt(self._yaw @ self._yaw @ foot.rotation)
        zero, requirements = np.zeros(3), self.requirements
        error = casadi.vertcat(position[0] - self._length, position[2])
        return [
            Rows("landing position", "m", 1.0, error, zero[:2], zero[:2]),
            Rows("landing attitude", "rad", 1.0, tilt, zero, zero),
            Rows(
                "landing width",
                "m",
                0.1,
                position[1],
                np.array([requirements.corridor[0]]),
                np.array([requirements.corridor[1]]),
            ),
        ]

    def _touchdown(self, q: Symbol, rate: Symbol) -> list[Rows]:
        """Return the constraints of a soft landing: speed limits of the ankle and of the corners of the sole."""
        requirements = self.requirements
        foot = self.chain.frames(q, rate)[self.chain.swing_foot]
        ankle = self._yaw @ foot.rotation @ foot.linear
        corners = [
            self._yaw @ foot.rotation @ (foot.linear + casadi.cross(foot.angular, casadi.DM(corner)))
            for corner in self._corners()
        ]
        count = len(corners)
        low, high = (np.array([value]) for value in requirements.landing_speed)
        corner_low, corner_high = (np.full(count, value) for value in requirements.corner_speed)
        slide = np.full(2 * count, requirements.corner_slide)
        return [
            Rows("landing speed", "m/s", 0.02, ankle[2], low, high),
            Rows("landing speed of the corners", "m/s", 0.02, _stacked(corners, slice(2, 3)), corner_low, corner_high),
            Rows("landing slide of the corners", "m/s", 0.02, _stacked(corners, slice(2)), -slide, slide),
        ]

    def _add_impact(self) -> None:
        """Add the impact map, which connects the speeds at the end of a step with the speeds at the start of the next step.

        In the mirrored robot the landing foot is the stance foot. After the impact the twist of this foot is zero, and
        the joint speeds are the speeds at the start of the next step. The joint impulses are zero. The ground impulse
        is upwards. The downward speed of the rear foot is limited.
        """
        requirements, program, duration = self.requirements, self.program, self._duration
        q0, v0, q1, v1 = (casadi.SX.sym(name, _N) for name in ("q0", "v0", "q1", "v1"))
        landing = self.chain.frames(q1, v1 / duration)[self.chain.swing_foot]
        change = (v0 - casadi.DM(SIGN) * v1[SWAP.tolist()]) / duration
        impulses, ground = self.chain.inverse_dynamics(
            q0, casadi.SX(_N, 1), change, -_MIRROR * landing.linear, _MIRROR * landing.angular
        )
        leaving = self.chain.frames(q0, v0 / duration)[self.chain.swing_foot]
        speeds = [
            (leaving.rotation @ (leaving.linear + casadi.cross(leaving.angular, casadi.DM(corner))))[2]
            for corner in self._corners()
        ]
        jump = np.full(_N, requirements.impact_jump)
        rows = [
            Rows("impact map", "Nms", 5.0, impulses, np.zeros(_N), np.zeros(_N)),
            Rows("speed change at impact", "rad/s", 0.05, change, -jump, jump),
            _positive("impact impulse", "Ns", 3.0, ground.force[2]),
            Rows(
                "foot leaving",
                "m/s",
                0.02,
                casadi.vertcat(*speeds),
                np.full(4, -requirements.sinking),
                np.full(4, np.inf),
            ),
        ]
        ends = np.concatenate([self.node(0)[: 2 * _N], self.node(requirements.nodes - 1)[: 2 * _N]])
        program.add(rows, casadi.vertcat(q0, v0, q1, v1), [ends])

    def _corners(self) -> list[tuple[float, float, float]]:
        exo = self.exoskeleton
        x, z = exo.sole_centre
        length, width = exo.sole_size
        return [(x + i * length / 2, j * width / 2, z) for i in (1, -1) for j in (1, -1)]


def _outside(values: Vector, bounds: tuple[Vector, Vector]) -> Vector:
    return np.maximum(np.maximum(bounds[0] - values, values - bounds[1]), 0.0)


def _stacked(vectors: list[Symbol], components: slice) -> Symbol:
    """Take the elements with the indices `components` from each vector, and return them stacked in one column.

    The elements of the first vector come first, then the elements of the second vector, and so on.
    """
    return casadi.vertcat(*(vector[components] for vector in vectors))


def _tilt(rotation: Symbol) -> Symbol:
    """Return the first-order rotation vector of a small rotation, shape (3,) [rad]."""
    return casadi.vertcat(rotation[2, 1], -rotation[2, 0], rotation[1, 0])


def _positive(name: str, unit: str, size: float, values: Symbol) -> Rows:
    count = values.shape[0]
    return Rows(name, unit, size, values, np.zeros(count), np.full(count, np.inf))


def _about_z(angle: float) -> Vector:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
