"""Body in PyBullet: `URDF, joint torques -> motion, sole forces`."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from struct import Struct
from typing import Any, Final

import numpy as np
import pybullet

from atalante_emulator.bodies import FRICTION, LINK_STATE, PELVIS, Motion, Pose
from atalante_emulator.bodies.links import FOOT_LINKS, IMU_LINKS, PAD_LINKS, find
from atalante_emulator.bodies.soles import into_frame, read_soles, total_mass
from atalante_hal.compiled import compiled
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS
from atalante_hal.types import GRAVITY, PERIOD, Vector

#: Number of PyBullet solver iterations in each time step. Another number changes the computed motion.
SOLVER_ITERATIONS = 50
#: Indices of attitude, velocity and angular velocity in the tuple that `pybullet.getLinkStates` returns for each link.
_ATTITUDE, _LINEAR, _ANGULAR = 5, 6, 7
_BASE: Final = -1  # link index of the root link in PyBullet
#: Number of elements in a row of contact data: pad index (1), normal vector (3), normal force (1), two friction forces (4 each).
#: Each friction force is stored as its size (1), followed by its direction (3). All forces are in N.
_CONTACT: Final = 13
#: Largest number of contacts in a time step: one for each contact pad, because a pad is a sphere and the floor is a plane.
_CONTACTS: Final = len(FEET) * len(CELLS)
_PACK_JOINTS, _PACK_LINK = Struct(f"{2 * len(JOINTS)}d").pack_into, Struct(f"{LINK_STATE}d").pack_into
_PACK_CONTACT, _CONTACT_BYTES = Struct(f"{_CONTACT}d").pack_into, 8 * _CONTACT
_PACK_ATTITUDES = Struct(f"{4 * len(FEET)}d").pack_into


def _sum_contacts(contacts: Vector, count: int, attitude: Vector, force: Vector) -> None:
    """Compute the force of the floor on each sole corner, in the axes of the foot.

    The force is the sum of a normal force and two friction forces, which PyBullet returns in world axes.

    Args:
        contacts: array whose first `count` rows are the contacts of the time step, shape (_CONTACTS, _CONTACT).
        count: number of contacts in the time step.
        attitude: quaternion xyzw of each foot, shape (2, 4).
        force: output for the forces, shape (2, 4, 3) [N].
    """
    force[:] = 0.0
    for i in range(count):
        contact = contacts[i]
        foot, pad = divmod(int(contact[0]), force.shape[1])
        normal, first, second = contact[4], contact[5], contact[9]
        x = normal * contact[1] + first * contact[6] + second * contact[10]
        y = normal * contact[2] + first * contact[7] + second * contact[11]
        z = normal * contact[3] + first * contact[8] + second * contact[12]
        along_x, along_y, along_z = into_frame(attitude[foot], x, y, z)
        force[foot, pad, 0] += along_x
        force[foot, pad, 1] += along_y
        force[foot, pad, 2] += along_z


class PyBulletBody:
    """Mechanics of the robot, simulated by PyBullet. `Body` documents the methods and properties.

    Two bodies with the same URDF and the same calls give identical results, bit by bit.
    """

    def __init__(
        self, urdf: str, *, free: bool = False, ground: float | None = None, friction: float = FRICTION
    ) -> None:
        """Load the URDF.

        Args:
            urdf: text of the URDF, not a path.
            free: whether the pelvis is free to move. With False, the pelvis is fixed at the origin.
            ground: height of the floor in the world [m]. None if there is no floor.
            friction: coefficient of friction between soles and floor.

        Raises:
            ValueError: If the text is not a URDF, or a required joint or link is missing.
        """
        # Each body has its own PyBullet client, so that equal inputs give identical motions.
        # A shared client would need `pybullet.restoreState`. After such a call, equal inputs can give different motions.
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
        self._free = free
        try:
            self._body = load_urdf(urdf, self._client, fixed=not free)
            self._find_links()
            self.soles, self.mass = read_soles(urdf), total_mass(urdf)
        except ValueError:
            self.close()
            raise
        for link in range(_BASE, self._links):
            pybullet.changeDynamics(self._body, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, **client)
        # PyBullet gives every joint a motor, which brakes the joint by default. A force limit of 0 turns these motors off.
        pybullet.setJointMotorControlArray(
            self._body, self._joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * len(JOINTS), **client
        )
        # Contacts occur only between the floor and the pads of the soles, so contacts are read only if there is a floor.
        self._touches = ground is not None
        if ground is not None:
            self._add_floor(ground, friction)
        self._force, self._moment = [0.0] * 3, [0.0] * 3  # external force [N] and moment [Nm] on the pelvis
        self._pushed = False
        joints, self.imu = np.zeros((2, len(JOINTS))), np.zeros((len(IMUS), LINK_STATE))
        self.position, self.velocity = joints
        self._joint_memory = joints.reshape(-1).data
        for row, state in zip(self.imu, self._link_states(self._imus), strict=True):
            row[:4] = state[_ATTITUDE]
        self._imu_memory = [self.imu[row].data for row in self._moving]
        self.sole_force, self.touching = np.zeros((len(FEET), len(CELLS), 3)), False
        self._contacts, self._attitude = np.zeros((_CONTACTS, _CONTACT)), np.zeros((len(FEET), 4))
        self._contact_memory, self._attitude_memory = self._contacts.reshape(-1).data, self._attitude.reshape(-1).data
        self._sum_contacts = compiled(_sum_contacts)
        # Compile `_sum_contacts` now. A compilation in the first time step would delay this step by more than 1 ms.
        self._sum_contacts(self._contacts, 0, self._attitude, self.sole_force)
        self.reset([0.0] * len(JOINTS))

    def _find_links(self) -> None:
        client = self._client
        infos = [
            pybullet.getJointInfo(self._body, i, physicsClientId=client)
            for i in range(pybullet.getNumJoints(self._body, physicsClientId=client))
        ]
        self._links = len(infos)
        joints = {info[1].decode(): i for i, info in enumerate(infos)}
        self._index_of = {info[12].decode(): i for i, info in enumerate(infos)}
        self._joints = find(JOINTS, joints, "joint")
        self._imus = find(IMU_LINKS, self._index_of, "link")
        self._feet = find(FOOT_LINKS, self._index_of, "link")
        self._pad_of = {pad: index for index, pad in enumerate(find(PAD_LINKS, self._index_of, "link"))}
        #: Rows of `imu` that `step` updates. An IMU on a fixed pelvis cannot move, so its row is written only once.
        self._moving = [
            row for row, link in enumerate(self._imus) if self._free or _is_movable(link, set(self._joints), infos)
        ]
        self._moving_links = [self._imus[row] for row in self._moving]
        # PyBullet describes the pelvis by a frame at its centre of mass (inertial frame), not by the URDF link frame.
        # `_inertial_in_base` is the pose of the inertial frame in the link frame. `_base_in_inertial` is the inverse.
        dynamics = pybullet.getDynamicsInfo(self._body, _BASE, physicsClientId=client)
        self._inertial_in_base = dynamics[3], dynamics[4]
        self._base_in_inertial = pybullet.invertTransform(*self._inertial_in_base)

    def _add_floor(self, height: float, friction: float) -> None:
        client = {"physicsClientId": self._client}
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, **client)
        floor = pybullet.createMultiBody(0.0, plane, basePosition=[0.0, 0.0, height], **client)
        # The coefficient of friction of a contact is the product of the coefficients of floor and pad.
        pybullet.changeDynamics(floor, _BASE, lateralFriction=1.0, **client)
        for pad in self._pad_of:
            pybullet.changeDynamics(self._body, pad, lateralFriction=friction, **client)

    def _link_states(self, links: Sequence[int]) -> Any:
        # The third argument (computeLinkVelocity) is 1, to get the link velocities.
        # The fourth argument (computeForwardKinematics) is 1, to get the link poses at the current joint positions.
        # With 0 as the fourth argument, `getLinkStates` would return the link poses of the previous time step.
        return pybullet.getLinkStates(self._body, links, 1, 1, physicsClientId=self._client)

    def reset(self, position: Sequence[float], base: Pose | None = None) -> None:
        """Set joint positions and pelvis pose, see `Body.reset`."""
        client = {"physicsClientId": self._client}
        if self._free:
            pose = pybullet.multiplyTransforms(*(base or Pose((0.0, 0.0, 0.0))), *self._inertial_in_base)
            pybullet.resetBasePositionAndOrientation(self._body, *pose, **client)
            pybullet.resetBaseVelocity(self._body, [0.0] * 3, [0.0] * 3, **client)
        elif base is not None:
            raise ValueError(f"base must be None for a fixed pelvis, got {base}")
        for joint, angle in zip(self._joints, position, strict=True):
            pybullet.resetJointState(self._body, joint, angle, 0.0, **client)
        self.push([0.0] * 3)
        joints, links, _ = self._read()
        # PyBullet finds contacts only in a time step, and there was no time step since the reset.
        self._unpack(joints, links, ())

    def push(self, force: Sequence[float], moment: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Set the external wrench on the pelvis link, see `Body.push`.

        Args:
            force: force at the centre of mass of the pelvis link, world axes, shape (3,) [N].
            moment: moment in world axes, shape (3,) [Nm].
        """
        self._force, self._moment = list(force), list(moment)
        self._pushed = any(self._force) or any(self._moment)

    def motion(self, link: str) -> Motion:
        """Return the true pose and velocity of a link.

        Args:
            link: name of the link in the URDF.

        Raises:
            KeyError: If the URDF has no such link.
        """
        if link == PELVIS:
            inertial = pybullet.getBasePositionAndOrientation(self._body, self._client)
            position, attitude = pybullet.multiplyTransforms(*inertial, *self._base_in_inertial)
            velocity, rate = pybullet.getBaseVelocity(self._body, self._client)
            centre = inertial[0]
        else:
            state = self._link_states([self._index_of[link]])[0]
            centre, position, attitude = state[0], state[4], state[_ATTITUDE]
            velocity, rate = state[_LINEAR], state[_ANGULAR]
        # PyBullet returns the velocity v of the centre of mass. The origin of the link frame has the velocity v + w x r.
        # w is the angular velocity of the link, and r is the vector from the centre of mass to the origin of the link frame.
        rx, ry, rz = (a - b for a, b in zip(position, centre, strict=True))
        (vx, vy, vz), (wx, wy, wz) = velocity, rate
        moved = vx + (wy * rz - wz * ry), vy + (wz * rx - wx * rz), vz + (wx * ry - wy * rx)
        return Motion(np.array(position), np.array(attitude), np.array(moved), np.array(rate))

    def step(self, torque: Sequence[float]) -> None:
        """Apply joint torques for one time step of 1 ms (`PERIOD`), and update all properties.

        Args:
            torque: joint torques, shape (12,) [Nm]. A list is fastest.
        """
        self._unpack(*self.exchange(torque))

    def exchange(self, torque: Sequence[float]) -> tuple[Any, Any, Any]:
        """Compute one time step in PyBullet, but do not update the properties of the body.

        Benchmarks compare the duration of `step` with the duration of this method.

        Args:
            torque: joint torques, shape (12,) [Nm].

        Returns:
            Joint states, link states and contacts, as PyBullet returns them.
        """
        # PyBullet resets torques and external forces to zero after each step.
        pybullet.setJointMotorControlArray(
            self._body, self._joints, pybullet.TORQUE_CONTROL, forces=torque, physicsClientId=self._client
        )
        if self._pushed:
            self._apply_push()
        pybullet.stepSimulation(self._client)
        return self._read()

    def _apply_push(self) -> None:
        client = {"physicsClientId": self._client}
        centre = pybullet.getBasePositionAndOrientation(self._body, **client)[0]
        pybullet.applyExternalForce(self._body, _BASE, self._force, centre, pybullet.WORLD_FRAME, **client)
        pybullet.applyExternalTorque(self._body, _BASE, self._moment, pybullet.WORLD_FRAME, **client)

    def _read(self) -> tuple[Any, Any, Any]:
        contacts = pybullet.getContactPoints(self._body, physicsClientId=self._client) if self._touches else ()
        # Request IMU links and feet in one call: each call of `_link_states` computes the poses of all links again.
        links = (*self._moving_links, *self._feet) if contacts else self._moving_links
        return pybullet.getJointStates(self._body, self._joints, self._client), self._link_states(links), contacts

    def _unpack(self, joints: Any, links: Any, contacts: Any) -> None:
        # The twelve joints are unpacked without a loop, because a loop would take twice as long.
        a, b, c, d, e, f, g, h, i, j, k, m = joints
        position = a[0], b[0], c[0], d[0], e[0], f[0], g[0], h[0], i[0], j[0], k[0], m[0]
        velocity = a[1], b[1], c[1], d[1], e[1], f[1], g[1], h[1], i[1], j[1], k[1], m[1]
        _PACK_JOINTS(self._joint_memory, 0, *position, *velocity)
        # `links` begins with the states of the moving IMU links. The two feet follow only if a sole touches the floor.
        for memory, state in zip(self._imu_memory, links, strict=False):
            _PACK_LINK(memory, 0, *state[_ATTITUDE], *state[_LINEAR], *state[_ANGULAR])
        if contacts:
            self._add_forces(contacts, links[-len(FEET) :])
        elif self.touching:
            self.sole_force.fill(0.0)
        self.touching = bool(contacts)

    def _add_forces(self, contacts: Any, feet: Any) -> None:
        left, right = feet
        _PACK_ATTITUDES(self._attitude_memory, 0, *left[_ATTITUDE], *right[_ATTITUDE])
        memory, pad_of, offset = self._contact_memory, self._pad_of, 0
        # Each vector component has a name (nx, ny, nz), because unpacking with `*` would take almost twice as long.
        for _, _, _, pad, _, _, _, (nx, ny, nz), _, normal, first, (ax, ay, az), second, (bx, by, bz) in contacts:
            _PACK_CONTACT(memory, offset, pad_of[pad], nx, ny, nz, normal, first, ax, ay, az, second, bx, by, bz)
            offset += _CONTACT_BYTES
        self._sum_contacts(self._contacts, len(contacts), self._attitude, self.sole_force)

    def close(self) -> None:
        """Disconnect from PyBullet."""
        if pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)


def load_urdf(urdf: str, client: int, *, fixed: bool = True) -> int:
    """Load a URDF text into PyBullet.

    Args:
        urdf: text of the URDF.
        client: PyBullet client that loads the URDF.
        fixed: whether the base is fixed to the world.

    Returns:
        Number of the new body in PyBullet.

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
    """Return whether the link moves when the robot's joints move. False for a link fixed to the root link."""
    while link >= 0:
        if link in joints:
            return True
        link = infos[link][16]
    return False
