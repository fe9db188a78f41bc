"""Mechanics of the emulated robot: computes one millisecond of motion from the joint torques.

`Body` is the interface between the nodes and a physics engine. `PyBulletBody` implements it from a URDF text. The pelvis is
fixed, because the exoskeleton is suspended in the air.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from struct import Struct
from typing import Any, Final, Protocol

import numpy as np
import pybullet

from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS
from atalante_hal.types import PERIOD, Vector

Vector3 = tuple[float, float, float]

GRAVITY = 9.81  # m/s2
#: Number of PyBullet solver iterations in each time step. Another number changes the computed motion.
SOLVER_ITERATIONS = 50
#: Number of elements of a link state in world axes: quaternion xyzw (4), velocity [m/s] (3), angular velocity [rad/s] (3).
LINK_STATE: Final = 10
#: Indices of attitude, velocity and angular velocity in the link state tuple of PyBullet.
_ATTITUDE, _LINEAR, _ANGULAR = 5, 6, 7
_PACK_JOINTS, _PACK_LINK = Struct(f"{2 * len(JOINTS)}d").pack_into, Struct(f"{LINK_STATE}d").pack_into


class Body(Protocol):
    """Interface of the robot's mechanics, as the emulated nodes use it.

    The properties always return the same array objects. Only `reset` and `step` change their contents.
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
    def contact(self) -> Sequence[tuple[int, int, Vector3]]:
        """Contacts of the last time step, each with index of the foot, index of the force cell, and force in world axes [N]."""

    @property
    def foot_rotation(self) -> Sequence[tuple[float, ...]]:
        """Attitude of each foot in the order of FEET, quaternion xyzw. It is updated only in time steps with a contact."""

    def reset(self, position: Sequence[float]) -> None:
        """Set the joint positions and zero the velocities.

        Args:
            position: joint positions, shape (12,) [rad].
        """

    def step(self, torque: Sequence[float]) -> None:
        """Apply joint torques for one `PERIOD` and update the motion, the link states and the contacts.

        Args:
            torque: joint torques, shape (12,) [Nm].
        """

    def close(self) -> None:
        """Release the physics engine."""


class PyBulletBody:
    """Exoskeleton in PyBullet with a fixed pelvis.

    Two bodies with the same URDF and the same torques give identical results, bit by bit.

    Joints and links are found by name: joints are `JOINTS`, IMU links `imu_<IMU>`, feet `<foot>_foot` and contact pads
    `<foot>_foot_<cell>`. The sensor frame of such a link is the frame of its joint.
    """

    def __init__(self, urdf: str, *, ground: float | None = None) -> None:
        """Load the URDF.

        Args:
            urdf: text of the URDF, not a path.
            ground: height of the floor in the pelvis frame [m], negative. None means no floor.

        Raises:
            ValueError: If the text is not a URDF, or a required joint or link is missing.
        """
        # Each body has a new physics client, because a restored PyBullet state does not repeat a simulation exactly.
        self._client = pybullet.connect(pybullet.DIRECT)
        client = {"physicsClientId": self._client}
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=PERIOD,
            numSubSteps=0,
            numSolverIterations=SOLVER_ITERATIONS,
            deterministicOverlappingPairs=1,
            **client,
        )
        pybullet.setGravity(0.0, 0.0, -GRAVITY, **client)
        try:
            self._body = load_urdf(urdf, self._client)
            self._find_links()
        except ValueError:
            self.close()
            raise
        for link in range(-1, self._links):
            pybullet.changeDynamics(self._body, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, **client)
        # By default, PyBullet brakes every joint with a velocity motor. Zero force switches the motor off.
        pybullet.setJointMotorControlArray(
            self._body, self._joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * len(JOINTS), **client
        )
        self._touches = ground is not None  # the only possible contacts are those with the floor
        if self._touches:
            plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, **client)
            pybullet.createMultiBody(0.0, plane, basePosition=[0.0, 0.0, ground], **client)
        joints, self.imu = np.zeros((2, len(JOINTS))), np.zeros((len(IMUS), LINK_STATE))
        self.position, self.velocity = joints
        self._joint_memory = joints.reshape(-1).data
        for row, state in zip(self.imu, self._link_states(self._imus), strict=True):
            row[:4] = state[_ATTITUDE]
        self._imu_memory = [self.imu[row].data for row in self._moving]
        self.foot_rotation: list[tuple[float, ...]] = [state[_ATTITUDE] for state in self._link_states(self._feet)]
        self.contact: Sequence[tuple[int, int, Vector3]] = ()
        self.reset([0.0] * len(JOINTS))

    def _find_links(self) -> None:
        client = self._client
        infos = [
            pybullet.getJointInfo(self._body, i, physicsClientId=client)
            for i in range(pybullet.getNumJoints(self._body, physicsClientId=client))
        ]
        self._links = len(infos)
        joints = {info[1].decode(): i for i, info in enumerate(infos)}
        links = {info[12].decode(): i for i, info in enumerate(infos)}

        def find(names: Sequence[str], available: dict[str, int], noun: str) -> list[int]:
            if missing := [name for name in names if name not in available]:
                raise ValueError(f"the URDF must have the {noun}s {', '.join(names)}, but {missing[0]} is missing")
            return [available[name] for name in names]

        self._joints = find(JOINTS, joints, "joint")
        self._imus = find([f"imu_{imu}" for imu in IMUS], links, "link")
        self._feet = find([f"{foot}_foot" for foot in FEET], links, "link")
        pads = find([f"{foot}_foot_{cell}" for foot in FEET for cell in CELLS], links, "link")
        self._cell_of = {pad: divmod(index, len(CELLS)) for index, pad in enumerate(pads)}
        #: Indices of the IMUs on moving links. The other IMUs are fixed to the pelvis.
        self._moving = [row for row, link in enumerate(self._imus) if _is_movable(link, set(self._joints), infos)]
        self._moving_links = [self._imus[row] for row in self._moving]

    def _link_states(self, links: Sequence[int]) -> Any:
        # Without the forward kinematics flag, PyBullet returns the poses of the previous time step.
        return pybullet.getLinkStates(self._body, links, 1, 1, physicsClientId=self._client)

    def reset(self, position: Sequence[float]) -> None:
        """Set the joint positions and zero the velocities.

        Args:
            position: joint positions, shape (12,) [rad].
        """
        for joint, angle in zip(self._joints, position, strict=True):
            pybullet.resetJointState(self._body, joint, angle, 0.0, physicsClientId=self._client)
        self._unpack(*self._read())
        self.contact = ()  # PyBullet finds contacts only in a time step, and none was computed since the reset

    def step(self, torque: Sequence[float]) -> None:
        """Apply joint torques for one `PERIOD` and update the motion, the link states and the contacts.

        Args:
            torque: joint torques, shape (12,) [Nm]. A list is fastest.
        """
        self._unpack(*self.exchange(torque))

    def exchange(self, torque: Sequence[float]) -> tuple[Any, Any, Any]:
        """Run the PyBullet calls of `step` without unpacking the results. Benchmarks use this as a baseline.

        Args:
            torque: joint torques, shape (12,) [Nm].

        Returns:
            Joint states, link states and contacts, as PyBullet returns them.
        """
        # PyBullet resets the torques to zero after each step.
        pybullet.setJointMotorControlArray(
            self._body, self._joints, pybullet.TORQUE_CONTROL, forces=torque, physicsClientId=self._client
        )
        pybullet.stepSimulation(self._client)
        return self._read()

    def _read(self) -> tuple[Any, Any, Any]:
        return (
            pybullet.getJointStates(self._body, self._joints, self._client),
            self._link_states(self._moving_links),
            pybullet.getContactPoints(self._body, physicsClientId=self._client) if self._touches else (),
        )

    def _unpack(self, joints: Any, links: Any, contacts: Any) -> None:
        # A loop over the joints would take twice as long.
        a, b, c, d, e, f, g, h, i, j, k, m = joints
        position = a[0], b[0], c[0], d[0], e[0], f[0], g[0], h[0], i[0], j[0], k[0], m[0]
        velocity = a[1], b[1], c[1], d[1], e[1], f[1], g[1], h[1], i[1], j[1], k[1], m[1]
        _PACK_JOINTS(self._joint_memory, 0, *position, *velocity)
        for memory, state in zip(self._imu_memory, links, strict=True):
            _PACK_LINK(memory, 0, *state[_ATTITUDE], *state[_LINEAR], *state[_ANGULAR])
        self.contact = self._forces(contacts) if contacts else ()

    def _forces(self, contacts: Any) -> list[tuple[int, int, Vector3]]:
        self.foot_rotation = [state[_ATTITUDE] for state in self._link_states(self._feet)]
        forces = []
        for contact in contacts:
            foot, cell = self._cell_of[contact[3]]
            (nx, ny, nz), normal = contact[7], contact[9]
            first, (ax, ay, az), second, (bx, by, bz) = contact[10:14]
            force = (
                normal * nx + first * ax + second * bx,
                normal * ny + first * ay + second * by,
                normal * nz + first * az + second * bz,
            )
            forces.append((foot, cell, force))
        return forces

    def close(self) -> None:
        """Disconnect from PyBullet."""
        if pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)


def load_urdf(urdf: str, client: int, *, fixed: bool = True) -> int:
    """Load a URDF text into PyBullet.

    Args:
        urdf: text of the URDF.
        client: PyBullet client to load it into.
        fixed: whether the base is fixed to the world.

    Returns:
        PyBullet's number of the new body.

    Raises:
        ValueError: If the text is not a URDF.
    """
    with tempfile.TemporaryDirectory(prefix="atalante-") as folder:
        path = Path(folder, "exoskeleton.urdf")
        path.write_text(urdf)
        try:
            # Fixed links are not merged, because IMU links and contact pads must keep their names.
            return int(
                pybullet.loadURDF(
                    str(path), useFixedBase=fixed, flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
                )
            )
        except pybullet.error as error:
            raise ValueError(f"PyBullet cannot load the URDF: {error}") from error


def _is_movable(link: int, joints: set[int], infos: Sequence[Any]) -> bool:
    """Return whether a joint between the link and the base can move the link."""
    while link >= 0:
        if link in joints:
            return True
        link = infos[link][16]
    return False
