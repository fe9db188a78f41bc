"""Mechanics of the emulated robot: compute one millisecond of motion from the joint torques.

`Body` is the interface between the nodes and a physics engine. Two engines implement it from the same URDF text: `PyBulletBody`
and `MuJoCoBody`. The pelvis is either fixed to the world (robot suspended in the air) or free (robot on the ground). World axes
follow REP-103: x forward, y left, z up. A fixed pelvis is at the origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

from atalante_emulator.bodies.links import FOOT_LINKS
from atalante_emulator.bodies.soles import Soles
from atalante_hal.types import Vector

Vector3 = tuple[float, float, float]

#: Number of elements of a link state: quaternion xyzw (4), velocity [m/s] (3), angular velocity [rad/s] (3), all in world axes.
LINK_STATE: Final = 10
#: Name of the root link.
PELVIS: Final = "pelvis"
#: Default coefficient of friction between soles and floor.
FRICTION: Final = 0.6
#: Names of the physics engines. The first engine is the default.
ENGINES: Final = ("pybullet", "mujoco")


class DivergedError(FloatingPointError):
    """Simulation that diverged: a position, velocity or acceleration became infinite or far too large."""


class Pose(NamedTuple):
    """Position and attitude of a link in the world."""

    position: Sequence[float]  # position of the link in the world [m], shape (3,)
    #: Quaternion xyzw that turns a vector from link axes into world axes, shape (4,).
    attitude: Sequence[float] = (0.0, 0.0, 0.0, 1.0)


class Motion(NamedTuple):
    """Pose and velocity of a link frame in the world, in world axes."""

    position: Vector  # position of the origin of the link frame [m], shape (3,)
    attitude: Vector  # quaternion xyzw that turns a vector from link axes into world axes, shape (4,)
    velocity: Vector  # velocity of the origin of the link frame, in world axes [m/s], shape (3,)
    rate: Vector  # angular velocity of the link, in world axes [rad/s], shape (3,)


class Body(Protocol):
    """Interface between the emulated nodes and the mechanics of the robot.

    The properties that return arrays always return the same array objects. Only `reset` and `step` change their contents.
    Joints and links are found by their names in the URDF. The joints have the names `JOINTS`, the links of the IMUs
    `imu_<IMU>`, the feet `<foot>_foot`, and the contact pads at the force cells `<foot>_foot_<cell>`. The frame of an IMU
    link is the frame of the IMU. The origin of the frame of a contact pad is the position of the force cell.
    """

    @property
    def position(self) -> Vector:
        """Joint positions in the order of JOINTS, shape (12,) [rad]."""

    @property
    def velocity(self) -> Vector:
        """Joint velocities in the order of JOINTS, shape (12,) [rad/s]."""

    @property
    def imu(self) -> Vector:
        """Link states of the four IMU links in the order of IMUS, shape (4, LINK_STATE)."""

    @property
    def sole_force(self) -> Vector:
        """Force of the floor on each corner of each sole in the last time step, shape (2, 4, 3) [N].

        The indices count the foot, the corner of its sole and the axis. The axes are x, y and z of the foot link.
        """

    @property
    def touching(self) -> bool:
        """Whether a corner of a sole touched the floor in the last time step. If False, `sole_force` is zero."""

    @property
    def soles(self) -> Soles:
        """Positions of force cells and sole corners. Each position is in the frame of its own foot link."""

    @property
    def mass(self) -> float:
        """Total mass of the robot and its wearer [kg]."""

    def reset(self, position: Sequence[float], base: Pose | None = None) -> None:
        """Set the joint positions and the pose of the pelvis. Set all velocities and the external wrench to zero.

        Args:
            position: joint positions, shape (12,) [rad].
            base: pose of the pelvis. With None, the pelvis is upright at the origin. Must be None if the pelvis is fixed.

        Raises:
            ValueError: If a pose is given and the pelvis is fixed.
        """

    def push(self, force: Sequence[float], moment: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Set the external wrench on the pelvis link. The wrench acts in every time step until the next call.

        Args:
            force: force in world axes, shape (3,) [N]. The force acts at the centre of mass of the pelvis link. This
                link includes the trunk of the wearer.
            moment: moment in world axes, shape (3,) [Nm].
        """

    def motion(self, link: str) -> Motion:
        """Return the true pose and velocity of a link. Emulated nodes must not use these values.

        The callers are the crane, the virtual operator and tests.

        Args:
            link: name of the link in the URDF.

        Raises:
            KeyError: If the URDF has no such link.
        """

    def step(self, torque: Sequence[float]) -> None:
        """Apply joint torques for one time step of 1 ms (`PERIOD`), and update all properties.

        Args:
            torque: joint torques, shape (12,) [Nm]. A list is fastest.
        """

    def close(self) -> None:
        """Release the physics engine."""


def make_body(
    engine: str, urdf: str, *, free: bool = False, ground: float | None = None, friction: float = FRICTION
) -> Body:
    """Create a body in one of the engines.

    Args:
        engine: one of `ENGINES`.
        urdf: text of the URDF, not a path.
        free: whether the pelvis is free to move. With False, the pelvis is fixed at the origin.
        ground: height of the floor in the world [m]. None if there is no floor.
        friction: coefficient of friction between soles and floor.

    Raises:
        ValueError: If the engine is unknown, the text is not a URDF, or a required joint or link is missing.
        ModuleNotFoundError: If the engine is not installed.
    """
    match engine:
        case "pybullet":
            from atalante_emulator.bodies.pybullet_body import PyBulletBody

            return PyBulletBody(urdf, free=free, ground=ground, friction=friction)
        case "mujoco":
            from atalante_emulator.bodies.mujoco_body import MuJoCoBody

            return MuJoCoBody(urdf, free=free, ground=ground, friction=friction)
    raise ValueError(f"engine must be one of {', '.join(ENGINES)}, got {engine!r}")


def hang(body: Body, position: Sequence[float], clearance: float, floor: float = 0.0) -> Pose:
    """Place the robot upright and at rest, with the pelvis above the origin. Return the pose of the pelvis.

    Args:
        body: robot with a free pelvis.
        position: joint positions, shape (12,) [rad].
        clearance: height of the lowest corner of the soles above the floor [m]. 0 puts the robot on the floor.
        floor: height of the floor in the world [m].
    """
    body.reset(position, Pose((0.0, 0.0, 0.0)))
    pose = Pose((0.0, 0.0, floor + clearance - lowest_corner(body)))
    body.reset(position, pose)
    return pose


def lowest_corner(body: Body) -> float:
    """Return the world height of the lowest point of the two soles [m].

    A sole touches the floor only at its four corners. So the function compares eight corners.

    Args:
        body: robot whose soles are measured.
    """
    return min(
        body.soles.lowest(foot, motion.position, motion.attitude)
        for foot, motion in enumerate(map(body.motion, FOOT_LINKS))
    )
