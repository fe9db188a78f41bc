"""Body in MuJoCo: `URDF, joint torques -> motion, sole forces`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from atalante_emulator.bodies import FRICTION, LINK_STATE, PELVIS, DivergedError, Motion, Pose
from atalante_emulator.bodies.links import FOOT_LINKS, IMU_LINKS, PAD_LINKS, find
from atalante_emulator.bodies.soles import into_frame, read_soles, total_mass
from atalante_hal.compiled import specialised
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS
from atalante_hal.types import GRAVITY, PERIOD, Vector

#: Number of elements at the start of MuJoCo's vector `qpos` for the pose of a free pelvis: position (3), quaternion wxyz (4).
_FREE: Final = 7
#: Time at which a simulation starts [s]. If a simulation diverges, MuJoCo resets the simulation and sets its time to 0.
#: So a simulation time below `_START` shows that the simulation has diverged.
_START: Final = 1.0


class Contact(NamedTuple):
    """Contact parameters with the names that MuJoCo uses in the chapter "Solver parameters" of its documentation.

    MuJoCo lets two touching shapes sink into each other slightly, and pushes them apart like a spring and a damper.
    With the default values of this class, the stiffness at each corner is 1.4 MN/m. With MuJoCo's own default, solimp
    (0.9, 0.95), the soles sink so far into the floor that a walking robot falls.
    """

    #: Time constant [s] and damping ratio of the spring that pushes the shapes apart.
    solref: tuple[float, float] = (0.02, 1.0)
    #: Hardness of the contact at first touch, and hardness after the shapes have sunk deep into each other.
    #: Each value is between 0 (soft) and 1 (rigid). MuJoCo's name for this hardness is "impedance".
    solimp: tuple[float, float] = (0.99, 0.99)
    impratio: float = 1.0  # ratio of two contact hardnesses: against sliding / against sinking in


class _Sensed(NamedTuple):
    """State and sensor data of MuJoCo. All arrays are views of arrays of MuJoCo."""

    position: Vector  # joint positions, shape (12,) [rad]
    motion: Vector  # joint velocities, shape (12,) [rad/s]
    attitude: Vector  # quaternions wxyz from link axes to world axes; rows: four IMU links, left foot, right foot; shape (6, 4)
    velocity: Vector  # velocity of each IMU link in world axes, shape (4, 3) [m/s]
    rate: Vector  # angular velocity of each IMU link in world axes, shape (4, 3) [rad/s]
    force: Vector  # force of the floor on each sole corner in world axes; rows: four left, four right; shape (8, 3) [N]


class _Read(NamedTuple):
    """Arrays behind the properties of a `MuJoCoBody`. Each time step writes its results into these arrays."""

    position: Vector  # joint positions, shape (12,) [rad]
    velocity: Vector  # joint velocities, shape (12,) [rad/s]
    imu: Vector  # link states of the IMUs, shape (4, LINK_STATE)
    force: Vector  # force on each corner of each sole, in the axes of its foot, shape (2, 4, 3) [N]


def _unpack(sensed: _Sensed, read: _Read) -> bool:
    """Convert MuJoCo's data to the properties of the body. Return whether a sole corner touches the floor.

    Args:
        sensed: state and sensor data of MuJoCo.
        read: output for the results.
    """
    attitude, velocity, rate, pads = sensed.attitude, sensed.velocity, sensed.rate, sensed.force
    imu, force = read.imu, read.force
    for joint in range(len(read.position)):
        read.position[joint], read.velocity[joint] = sensed.position[joint], sensed.motion[joint]
    imus = len(imu)
    for i in range(imus):
        imu[i, 0], imu[i, 1], imu[i, 2], imu[i, 3] = attitude[i, 1], attitude[i, 2], attitude[i, 3], attitude[i, 0]
        for k in range(3):
            imu[i, 4 + k], imu[i, 7 + k] = velocity[i, k], rate[i, k]
    touching = False
    for foot in range(force.shape[0]):
        row = attitude[imus + foot]
        xyzw = row[1], row[2], row[3], row[0]
        for pad in range(force.shape[1]):
            x, y, z = pads[foot * force.shape[1] + pad]
            touching |= z != 0.0
            force[foot, pad, 0], force[foot, pad, 1], force[foot, pad, 2] = into_frame(xyzw, x, y, z)
    return touching


class MuJoCoBody:
    """Mechanics of the robot, simulated by MuJoCo. `Body` documents the methods and properties.

    Two bodies with the same URDF and the same calls give identical results, bit by bit.
    """

    def __init__(
        self,
        urdf: str,
        *,
        free: bool = False,
        ground: float | None = None,
        friction: float = FRICTION,
        contact: Contact | None = None,
    ) -> None:
        """Load the URDF.

        Args:
            urdf: text of the URDF, not a path.
            free: whether the pelvis is free to move. With False, the pelvis is fixed at the origin.
            ground: height of the floor in the world [m]. None if there is no floor.
            friction: coefficient of friction between soles and floor.
            contact: contact model. With None, the default values of `Contact` are used.

        Raises:
            ValueError: If the text is not a URDF, or a required joint or link is missing.
        """
        try:
            spec = mujoco.MjSpec.from_string(urdf)
        except ValueError as error:
            raise ValueError(f"MuJoCo cannot load the URDF: {error}") from error
        self._free = free
        find(JOINTS, {joint.name: joint.id for joint in spec.joints}, "joint")
        find((*IMU_LINKS, *FOOT_LINKS, *PAD_LINKS), {body.name: body.id for body in spec.bodies}, "link")
        self.soles, self.mass = read_soles(urdf), total_mass(urdf)
        _prepare(spec, free, ground, friction, contact or Contact())
        self._model = model = spec.compile()
        self._data = data = mujoco.MjData(model)
        assert abs(float(model.body_mass.sum()) - self.mass) < 1e-9
        first = model.jnt_dofadr[model.joint(JOINTS[0]).id]
        assert [model.jnt_dofadr[model.joint(name).id] - first for name in JOINTS] == list(range(len(JOINTS)))
        q = model.jnt_qposadr[model.joint(JOINTS[0]).id]
        self._q = data.qpos[q : q + len(JOINTS)]
        self._torque = data.qfrc_applied[first : first + len(JOINTS)]
        self._body_of: dict[str, int] = {}  # cache of `motion`: link name -> body index in MuJoCo
        pelvis = model.body(PELVIS).id
        self._wrench = data.xfrc_applied[pelvis]
        self._sensed = _Sensed(self._q, data.qvel[first : first + len(JOINTS)], *_views(data.sensordata))
        self.position, self.velocity = np.zeros((2, len(JOINTS)))
        self.imu = np.zeros((len(IMUS), LINK_STATE))
        self.sole_force, self.touching = np.zeros((len(FEET), len(CELLS), 3)), False
        self._results = _Read(self.position, self.velocity, self.imu, self.sole_force)
        # Compile `_unpack` now. A compilation in the first time step would delay this step by more than 1 ms.
        self._unpack = specialised(_unpack, self._sensed, self._results)
        self.reset([0.0] * len(JOINTS))

    def reset(self, position: Sequence[float], base: Pose | None = None) -> None:
        """Set joint positions and pelvis pose, see `Body.reset`."""
        if not self._free and base is not None:
            raise ValueError(f"base must be None for a fixed pelvis, got {base}")
        mujoco.mj_resetData(self._model, self._data)
        self._data.time = _START
        if self._free:
            pelvis, (x, y, z, w) = self._data.qpos[:_FREE], (base or Pose((0.0, 0.0, 0.0))).attitude
            pelvis[:3] = (0.0, 0.0, 0.0) if base is None else base.position
            pelvis[3:] = w, x, y, z
        self._q[:] = position
        mujoco.mj_step1(self._model, self._data)
        # MuJoCo computes contact forces only in a time step, and there was no time step since the reset.
        self._sensed.force.fill(0.0)
        self._read()

    def push(self, force: Sequence[float], moment: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Set the external wrench on the pelvis link, see `Body.push`.

        Args:
            force: force at the centre of mass of the pelvis link, world axes, shape (3,) [N].
            moment: moment in world axes, shape (3,) [Nm].
        """
        self._wrench[:3] = force
        self._wrench[3:] = moment

    def motion(self, link: str) -> Motion:
        """Return the true pose and velocity of a link.

        Args:
            link: name of the link in the URDF.

        Raises:
            KeyError: If the URDF has no such link.
        """
        body = self._body_of.get(link)
        if body is None:
            body = self._body_of[link] = self._model.body(link).id
        w, x, y, z = self._data.xquat[body]
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
        return Motion(self._data.xpos[body].copy(), np.array([x, y, z, w]), twist[3:], twist[:3])

    def step(self, torque: Sequence[float]) -> None:
        """Apply joint torques for one time step of 1 ms (`PERIOD`), and update all properties.

        Args:
            torque: joint torques, shape (12,) [Nm].

        Raises:
            DivergedError: If the simulation diverged.
        """
        self.exchange(torque)
        self._read()

    def exchange(self, torque: Sequence[float]) -> None:
        """Compute one time step in MuJoCo, but do not update the properties of the body.

        Benchmarks compare the duration of `step` with the duration of this method.

        Args:
            torque: joint torques, shape (12,) [Nm].

        Raises:
            DivergedError: If the simulation diverged.
        """
        self._torque[:] = torque
        # `mj_step2` moves the robot by one time step. `mj_step1` computes the sensor data of the new position.
        # Without `mj_step1`, the sensor data would still belong to the position before the time step.
        mujoco.mj_step2(self._model, self._data)
        mujoco.mj_step1(self._model, self._data)
        if self._data.time < _START:
            raise DivergedError("the simulation in MuJoCo diverged: a position, velocity or acceleration is too large")

    def _read(self) -> None:
        self.touching = self._unpack(self._sensed, self._results)

    def close(self) -> None:
        """Do nothing. The memory of MuJoCo is released with this object."""


def _prepare(spec: Any, free: bool, ground: float | None, friction: float, contact: Contact) -> None:
    """Add solver settings, floor and sensors to a model that MuJoCo loaded from a URDF.

    Args:
        spec: model as loaded from the URDF.
        free: whether the pelvis is free to move.
        ground: height of the floor in the world [m]. None if there is no floor.
        friction: coefficient of friction between soles and floor.
        contact: contact model.
    """
    # By default, MuJoCo merges a link on a fixed joint into its parent link. The IMU links would then not exist as bodies.
    # By default, MuJoCo would also merge a fixed pelvis into the world body, and the mass of the pelvis would be lost.
    spec.compiler.fusestatic = False
    option = spec.option
    option.timestep, option.gravity = PERIOD, [0.0, 0.0, -GRAVITY]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, contact.impratio
    for joint in spec.joints:
        joint.solref_limit, joint.solimp_limit = [0.002, 1.0], [0.99, 0.999, 0.001, 0.5, 2.0]
    if free:
        spec.body(PELVIS).add_freejoint()
    shapes = [(pad, spec.body(pad).geoms[0]) for pad in PAD_LINKS]
    for pad, shape in shapes:
        shape.name, shape.contype, shape.conaffinity = pad, 1, 0
    if ground is not None:
        floor = spec.worldbody.add_geom(
            name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], pos=[0.0, 0.0, ground]
        )
        floor.contype, floor.conaffinity = 0, 1
        shapes.append(("floor", floor))
    for _, shape in shapes:
        shape.friction[0], shape.condim = friction, 3  # MuJoCo uses the larger coefficient of the two shapes in contact
        shape.solref, shape.solimp[:2] = contact.solref, contact.solimp
    _add_sensors(spec, ground is not None)


def _add_sensors(spec: Any, floor: bool) -> None:
    link = mujoco.mjtObj.mjOBJ_XBODY
    for kind, names in (
        (mujoco.mjtSensor.mjSENS_FRAMEQUAT, (*IMU_LINKS, *FOOT_LINKS)),
        (mujoco.mjtSensor.mjSENS_FRAMELINVEL, IMU_LINKS),
        (mujoco.mjtSensor.mjSENS_FRAMEANGVEL, IMU_LINKS),
    ):
        for name in names:
            spec.add_sensor(type=kind, objtype=link, objname=name)
    if floor:
        force, net = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3  # 3: net force in world axes
        geom = mujoco.mjtObj.mjOBJ_GEOM
        for pad in PAD_LINKS:
            spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=geom, objname="floor", reftype=geom, refname=pad,
                intprm=[force, net, 1],
            )  # fmt: skip


def _views(data: Any) -> tuple[Vector, Vector, Vector, Vector]:
    """Return the fields attitude, velocity, rate and force of `_Sensed` as views of MuJoCo's array of sensor data."""
    attitudes, imus, pads = len(IMUS) + len(FEET), len(IMUS), len(PAD_LINKS)
    ends = np.cumsum([4 * attitudes, 3 * imus, 3 * imus])
    attitude, velocity, rate, force = np.split(data, ends)
    force = force.reshape(-1, 3) if force.size else np.zeros((pads, 3))
    return attitude.reshape(-1, 4), velocity.reshape(-1, 3), rate.reshape(-1, 3), force
