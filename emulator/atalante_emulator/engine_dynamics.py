"""Rigid-body dynamics of a robot, computed by PyBullet from a URDF.

The module computes mass matrix, gravity torques, inverse dynamics and centre of mass. The results are a reference for the
model that the gaits use, which the library Pinocchio computes. The emulator does not use this module.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pybullet

from atalante_emulator.bodies.pybullet_body import load_urdf
from atalante_hal.closing import Closing
from atalante_hal.robot import JOINTS
from atalante_hal.types import GRAVITY, Vector

Pose = tuple[Sequence[float], Sequence[float]]  # pose of a frame in PyBullet: position (3) [m] and quaternion xyzw (4)


class EngineDynamics(Closing):
    """Dynamics of a robot with a fixed pelvis in PyBullet. Joint vectors are in the order of `JOINTS`.

    The object is a context manager, which disconnects from PyBullet at the end of the `with` block.
    """

    def __init__(self, urdf: str) -> None:
        """Load the URDF.

        Args:
            urdf: text of the URDF, not a path.

        Raises:
            ValueError: If the text is not a URDF, or a joint is missing.
        """
        self._client = pybullet.connect(pybullet.DIRECT)
        try:
            self._body = load_urdf(urdf, self._client)
            # Load the robot a second time, with a free pelvis: PyBullet reports mass 0 for a fixed pelvis.
            self._free = load_urdf(urdf, self._client, fixed=False)
        except ValueError:
            self.close()
            raise
        pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self._client)
        infos = [
            pybullet.getJointInfo(self._body, row, physicsClientId=self._client)
            for row in range(pybullet.getNumJoints(self._body, physicsClientId=self._client))
        ]
        moving = [info[1].decode() for info in infos if info[2] == pybullet.JOINT_REVOLUTE]
        if missing := [name for name in JOINTS if name not in moving]:
            self.close()
            raise ValueError(f"the URDF must contain the joints {', '.join(JOINTS)}, got no joint {missing[0]}")
        #: _order[i]: index of joint i in PyBullet's lists of joint positions, velocities and torques (movable joints only).
        self._order = [moving.index(name) for name in JOINTS]
        #: _rows[i]: number of joint i in PyBullet, which also counts fixed joints.
        self._rows = [[info[1].decode() for info in infos].index(name) for name in JOINTS]
        self._links = range(len(infos))
        dynamics = [
            pybullet.getDynamicsInfo(self._free, row, physicsClientId=self._client) for row in (-1, *self._links)
        ]
        self._base_from_inertial: Pose = dynamics[0][3], dynamics[0][4]
        root = pybullet.getBodyInfo(self._body, physicsClientId=self._client)[0].decode()
        #: Mass of every link by its name [kg].
        self.masses = {
            name: float(info[0])
            for name, info in zip((root, *(info[12].decode() for info in infos)), dynamics, strict=True)
        }

    def close(self) -> None:
        """Disconnect from PyBullet."""
        if pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)

    def inverse_dynamics(self, q: Vector, qd: Vector, qdd: Vector) -> Vector:
        """Return the joint torques of a motion with a fixed pelvis.

        Args:
            q: joint positions, shape (12,) [rad].
            qd: joint velocities, shape (12,) [rad/s].
            qdd: joint accelerations, shape (12,) [rad/s2].

        Returns:
            Joint torques, shape (12,) [Nm].
        """
        state = np.zeros((3, len(JOINTS)))
        state[:, self._order] = q, qd, qdd
        torque = pybullet.calculateInverseDynamics(self._body, *state.tolist(), physicsClientId=self._client)
        return np.array(torque)[self._order]

    def gravity(self, q: Vector) -> Vector:
        """Return the joint torques that hold the robot motionless against gravity.

        Args:
            q: joint positions, shape (12,) [rad].

        Returns:
            Joint torques, shape (12,) [Nm].
        """
        still = np.zeros_like(q)
        return self.inverse_dynamics(q, still, still)

    def mass_matrix(self, q: Vector) -> Vector:
        """Return the joint-space mass matrix of a pose.

        Args:
            q: joint positions, shape (12,) [rad].

        Returns:
            Mass matrix, shape (12, 12) [kg m2].
        """
        pose = np.zeros_like(q)
        pose[self._order] = q
        matrix = np.array(pybullet.calculateMassMatrix(self._body, pose.tolist(), physicsClientId=self._client))
        return np.asarray(matrix[np.ix_(self._order, self._order)])

    def centre_of_mass(self, q: Vector) -> Vector:
        """Return the centre of mass of the robot for given joint angles, in the pelvis frame.

        Args:
            q: joint positions, shape (12,) [rad].

        Returns:
            Centre of mass, shape (3,) [m].
        """
        for row, angle in zip(self._rows, q.tolist(), strict=True):
            pybullet.resetJointState(self._free, row, angle, physicsClientId=self._client)
        root = pybullet.getBasePositionAndOrientation(self._free, physicsClientId=self._client)
        states = pybullet.getLinkStates(self._free, self._links, 0, 1, physicsClientId=self._client)
        masses = np.array(list(self.masses.values()))
        centre = masses @ np.array([root[0], *(state[0] for state in states)]) / masses.sum()
        # `root` is the pose of the inertial frame of the pelvis, whose origin is the centre of mass of the pelvis.
        # Convert the centre of mass of the robot to this inertial frame, and then to the URDF link frame of the pelvis.
        unturned = [0.0, 0.0, 0.0, 1.0]
        in_root = pybullet.multiplyTransforms(*pybullet.invertTransform(*root), centre.tolist(), unturned)[0]
        return np.array(pybullet.multiplyTransforms(*self._base_from_inertial, in_root, unturned)[0])
