"""The mechanics under the nodes: torques in, one millisecond of motion, arrays out.

`Body` is all the nodes know of an engine; `PyBulletBody` implements it from a URDF text. The pelvis is held fixed: the
exoskeleton hangs in the air. (With a floating base the interface stays; only `PyBulletBody` learns to free it.)
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from struct import Struct
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import pybullet

from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS

Vector = npt.NDArray[np.float64]
Vector3 = tuple[float, float, float]

#: Step of the mechanics and of the bus cycle [s].
PERIOD = 1e-3
GRAVITY = 9.81  # m/s2
#: Solver iterations are part of the model, not a speed setting: the standing pose depends on them.
SOLVER_ITERATIONS = 50
#: Numbers of a link's state, in the world: quaternion xyzw, velocity [m/s], angular velocity [rad/s].
LINK_STATE: Final = 10
#: Entries of a PyBullet link state.
_ATTITUDE, _LINEAR, _ANGULAR = 5, 6, 7
_PACK_JOINTS, _PACK_LINK = Struct(f"{2 * len(JOINTS)}d").pack_into, Struct(f"{LINK_STATE}d").pack_into


class Body(Protocol):
    """What the nodes need of the mechanics. Arrays keep their identity; they change in `reset` and `step` alone."""

    @property
    def position(self) -> Vector:
        """Shape (12,) [rad], order of JOINTS."""

    @property
    def velocity(self) -> Vector:
        """Shape (12,) [rad/s]."""

    @property
    def imu(self) -> Vector:
        """Attitude and velocities of each of IMUS, whose axes they are. Shape (4, LINK_STATE)."""

    @property
    def contact(self) -> Sequence[tuple[int, int, Vector3]]:
        """Foot of FEET, cell of CELLS, world force on it [N], of the last step."""

    @property
    def foot_rotation(self) -> Sequence[tuple[float, ...]]:
        """Quaternion xyzw of each of FEET; renewed while it is in contact."""

    def reset(self, position: Sequence[float]) -> None:
        """Put the joints at rest at `position`. Shape (12,) [rad]."""

    def step(self, torque: Sequence[float]) -> None:
        """Apply joint torques for one `PERIOD` and read everything. Shape (12,) [Nm]."""

    def close(self) -> None:
        """Free the engine."""


class PyBulletBody:
    """The exoskeleton in PyBullet, pelvis fixed. Two bodies made alike and driven alike agree to the last bit.

    Joints and links are found by name: joints are `JOINTS`, IMU links `imu_<IMU>`, feet `<foot>_foot` and contact pads
    `<foot>_foot_<cell>`, with their joint frames as sensor frames.
    """

    def __init__(self, urdf: str, *, ground: float | None = None) -> None:
        """Load the URDF.

        Args:
            urdf: the text, not a path.
            ground: height of a floor in the pelvis frame [m], negative; None: no floor.

        Raises:
            ValueError: the text is no URDF, or lacks a joint or a link that is looked for.
        """
        # A fresh client a body: that is what makes two runs identical; saved and restored states do not.
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
        # The engine's own velocity motors would hold every joint.
        pybullet.setJointMotorControlArray(
            self._body, self._joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * len(JOINTS), **client
        )
        self._touches = ground is not None  # its own parts do not collide
        if self._touches:
            plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, **client)
            pybullet.createMultiBody(0.0, plane, basePosition=[0.0, 0.0, ground], **client)
        joints, self.imu = np.zeros((2, len(JOINTS))), np.zeros((len(IMUS), LINK_STATE))
        self.position, self.velocity = joints
        self._joint_memory = joints.reshape(-1).data
        for row, state in zip(self.imu, self._link_states(self._imus), strict=True):
            row[:4] = state[_ATTITUDE]
        self._imu_memory = [self.imu[place].data for place in self._moving]
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

        def find(names: Sequence[str], there: dict[str, int], what: str) -> list[int]:
            if missing := [name for name in names if name not in there]:
                raise ValueError(f"the URDF lacks {what} {missing[0]}; it needs {', '.join(names)}")
            return [there[name] for name in names]

        self._joints = find(JOINTS, joints, "joint")
        self._imus = find([f"imu_{imu}" for imu in IMUS], links, "link")
        self._feet = find([f"{foot}_foot" for foot in FEET], links, "link")
        pads = find([f"{foot}_foot_{cell}" for foot in FEET for cell in CELLS], links, "link")
        self._cell_of = {pad: divmod(place, len(CELLS)) for place, pad in enumerate(pads)}
        #: IMUs behind a joint of the fixed pelvis; the others never move.
        self._moving = [place for place, link in enumerate(self._imus) if _behind(link, set(self._joints), infos)]
        self._moving_links = [self._imus[place] for place in self._moving]

    def _link_states(self, links: Sequence[int]) -> Any:
        # Without the forward kinematics flag poses are one step old.
        return pybullet.getLinkStates(self._body, links, 1, 1, physicsClientId=self._client)

    def reset(self, position: Sequence[float]) -> None:
        """Put the joints at rest at `position`. Shape (12,) [rad]."""
        for joint, angle in zip(self._joints, position, strict=True):
            pybullet.resetJointState(self._body, joint, angle, 0.0, physicsClientId=self._client)
        self._unpack(*self._read())
        self.contact = ()  # of the last step, and there was none

    def step(self, torque: Sequence[float]) -> None:
        """Apply joint torques for one `PERIOD` and read everything. Shape (12,) [Nm], a list is fastest."""
        self._unpack(*self.exchange(torque))

    def exchange(self, torque: Sequence[float]) -> tuple[Any, Any, Any]:
        """The engine's share of `step`: torques in, step, the same reads, not unpacked; the benchmarks' baseline."""
        # Torque control lasts one step: it is said again every time.
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
        # Spelled out: any loop over the joints takes twice as long.
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
        """Disconnect from the engine."""
        if pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)


def load_urdf(urdf: str, client: int, *, fixed: bool = True) -> int:
    """Number of the body that PyBullet makes of a URDF text, its base fixed or free.

    Raises:
        ValueError: the text is no URDF.
    """
    with tempfile.TemporaryDirectory(prefix="atalante-") as folder:
        path = Path(folder, "exoskeleton.urdf")
        path.write_text(urdf)
        try:
            # Fixed links stay apart (no merging): IMUs and pads are found by their names.
            return int(
                pybullet.loadURDF(
                    str(path), useFixedBase=fixed, flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
                )
            )
        except pybullet.error as error:
            raise ValueError(f"PyBullet cannot load the URDF: {error}") from error


def _behind(link: int, joints: set[int], infos: Sequence[Any]) -> bool:
    while link >= 0:
        if link in joints:
            return True
        link = infos[link][16]
    return False
