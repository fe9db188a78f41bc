"""Torques that the motors of a leg produce, computed from its motion: `positions, pelvis IMU, foot forces -> produced torques`.

*Averages.* The second difference of positions at distances of `HALF` cycles is the mean acceleration over the last 2 * `HALF`
cycles with triangular weights. Sent torques, specific force and the forces on the foot are averaged with the same weights. So
all values belong to the same time, also in fast motions.

*Inverse dynamics.* The recursive Newton-Euler algorithm (Featherstone, Rigid Body Dynamics Algorithms, 5.3) starts at the
pelvis IMU. Its accelerometer measures the acceleration minus gravity, so the attitude of the pelvis is not needed. The force
cells measure all forces on the foot. Dry and viscous friction of the joint are added, so the result is the torque of the motor.

*Validity.* A lost frame repeats the last position, which would be a large acceleration. So the three positions of each joint must
have the same age. IMU and foot may repeat their values for `REPEATED` cycles.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.leg_model import LegModel
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, LEG_JOINTS
from atalante_hal.types import PERIOD, Vector
from atalante_hal.vectors import Vector3, cross, rotated

#: Half of the time over which the acceleration is averaged [cycles].
HALF: Final = 8
#: Number of cycles whose values are stored, because the averages need them.
SPAN: Final = 2 * HALF + 1
#: A torque in `Sample.sent` of cycle n moves the joints in cycle n + DELAY, if no frame and no motor is late.
DELAY: Final = 1
#: Largest extra delay from torque to motion, in addition to `DELAY` [cycles]. States, commands or motors may be late.
MORE: Final = 3
#: Largest age of a position from which torques are computed [cycles].
#: A node that always answers one cycle late has positions of age 1. `LATE` permits this age.
LATE: Final = 1
#: Largest number of consecutive cycles in which the values of a working sensor (pelvis IMU, foot) may stay the same.
#: If the values stay the same for longer, the sensor is stuck, and no torques are computed from its values.
REPEATED: Final = 2
_LEG: Final = len(LEG_JOINTS)
_PELVIS: Final = IMUS.index("pelvis")

Cycles = npt.NDArray[np.int64]


class Sample(NamedTuple):
    """Values of one cycle. The arrays are the same objects in every cycle; their contents change."""

    sent: Vector  # (12,) Nm, torques sent in the last cycle
    position: Vector  # (12,) rad
    accel: Vector  # (4, 3) m/s2, specific force at each IMU
    gyro: Vector  # (4, 3) rad/s
    force: Vector  # (2, 4, 3) N, force on each cell of each foot
    age: Cycles  # (rows,) age of each row of the process image [cycles]
    rows: Cycles  # (12,) row of each joint in the process image


class History(NamedTuple):
    """Values of the last `SPAN` cycles, with one row for each cycle.

    `sent` has `SPAN + MORE` rows, because a late torque is older. A new cycle overwrites the oldest row of each array.
    """

    cycles: Cycles  # (1,) number of stored cycles since the restart
    sent: Vector  # (SPAN + MORE, 12) Nm, see `Sample.sent`
    position: Vector  # (SPAN, 12) rad
    age: Cycles  # (SPAN, 12) age of each position [cycles]
    accel: Vector  # (SPAN, 3) m/s2, specific force at the pelvis IMU
    gyro: Vector  # (SPAN, 3) rad/s, angular velocity of the pelvis IMU
    force: Vector  # (SPAN, 2, 4, 3) N, force on each cell of each foot
    #: (3,) number of consecutive cycles in which the values of a sensor did not change.
    #: Elements: specific force at the pelvis IMU, forces on the left foot, forces on the right foot.
    repeats: Cycles
    #: (3,) number of consecutive cycles in which a sensor was not stuck: pelvis IMU, left foot, right foot.
    #: A sensor is stuck if its values have not changed for more than `REPEATED` cycles.
    good: Cycles


class Torques(NamedTuple):
    """Torques of one leg, and workspace of the inverse dynamics."""

    sent: Vector  # (6,) Nm, mean of the sent torques
    produced: Vector  # (6,) Nm, torques that the motors produced, computed from the motion
    speed: Vector  # (6,) rad/s, mean velocities
    acceleration: Vector  # (6,) rad/s2, mean accelerations
    load: Vector  # (4, 3) N, mean force on each cell of the foot
    rotation: Vector  # (6, 3, 3) rotation matrix from each link to its parent
    force: Vector  # (6, 3) N, force on each link from its parent
    moment: Vector  # (6, 3) Nm, moment on each link from its parent, about the origin of the link


def make_history() -> History:
    """Return an empty history."""
    joints, foot = (SPAN, len(JOINTS)), (SPAN, len(FEET), len(CELLS), 3)
    watched = 1 + len(FEET)
    return History(
        np.zeros(1, np.int64), np.zeros((SPAN + MORE, len(JOINTS))), np.zeros(joints), np.zeros(joints, np.int64),
        np.zeros((SPAN, 3)), np.zeros((SPAN, 3)), np.zeros(foot), np.zeros(watched, np.int64), np.zeros(watched, np.int64),
    )  # fmt: skip


def make_torques() -> Torques:
    """Return the torques and the workspace of a leg, filled with 0."""
    return Torques(
        np.zeros(_LEG), np.zeros(_LEG), np.zeros(_LEG), np.zeros(_LEG),
        np.zeros((len(CELLS), 3)), np.zeros((_LEG, 3, 3)), np.zeros((_LEG, 3)), np.zeros((_LEG, 3)),
    )  # fmt: skip


def store(sample: Sample, history: History) -> None:
    """Store the values of one cycle.

    Args:
        sample: values of the cycle.
        history: values of the last cycles. Updated here.
    """
    row, last = history.cycles[0] % SPAN, (history.cycles[0] - 1) % SPAN
    sent = history.cycles[0] % len(history.sent)
    history.cycles[0] += 1
    for joint in range(len(sample.sent)):
        history.sent[sent, joint], history.position[row, joint] = sample.sent[joint], sample.position[joint]
        history.age[row, joint] = sample.age[sample.rows[joint]]
    changed = False
    for axis in range(3):
        history.accel[row, axis], history.gyro[row, axis] = sample.accel[_PELVIS, axis], sample.gyro[_PELVIS, axis]
        changed |= history.accel[row, axis] != history.accel[last, axis]
    _count(history, 0, changed)
    for foot in range(len(sample.force)):
        changed = False
        for cell in range(sample.force.shape[1]):
            for axis in range(3):
                history.force[row, foot, cell, axis] = sample.force[foot, cell, axis]
                changed |= history.force[row, foot, cell, axis] != history.force[last, foot, cell, axis]
        _count(history, 1 + foot, changed)


def _count(history: History, sensor: int, changed: bool) -> None:
    """Update the counters `History.repeats` and `History.good` of one sensor by one cycle.

    Args:
        history: values of the last cycles. Updated here.
        sensor: 0 for the pelvis IMU, 1 and 2 for the feet.
        changed: whether the values changed in this cycle.
    """
    history.repeats[sensor] = 0 if changed else history.repeats[sensor] + 1
    history.good[sensor] = 0 if history.repeats[sensor] > REPEATED else history.good[sensor] + 1


def compute(leg: int, model: LegModel, late: int, history: History, torques: Torques) -> bool:
    """Average the sent torques of a leg over time, and compute its motor torques from the measured motion.

    The motor torques are the result of the inverse dynamics plus the friction. A sent torque moves the leg after
    `DELAY + late` cycles. Therefore the average is over sent torques that are older than the motion by this delay.

    Args:
        leg: index in `SIDES`.
        model: links and friction of the legs.
        late: further delay of the torques, 0 to `MORE` [cycles].
        history: values of the last cycles.
        torques: output for the torques.

    Returns:
        Whether the torques were computed. False if the history has too few cycles, if a position is too old, if the positions
        of a joint differ in age, or if the values of pelvis IMU or foot did not change for too long.
    """
    newest = history.cycles[0] - 1
    if history.cycles[0] < SPAN + late or min(history.good[0], history.good[1 + leg]) < SPAN:
        return False
    now, middle, first = newest % SPAN, (newest - HALF) % SPAN, (newest - 2 * HALF) % SPAN
    time = HALF * PERIOD
    for i in range(_LEG):
        joint = leg * _LEG + i
        age = history.age[now, joint]
        if age > LATE or age != history.age[middle, joint] or age != history.age[first, joint]:
            return False
        after, angle, before = (
            history.position[now, joint],
            history.position[middle, joint],
            history.position[first, joint],
        )
        torques.speed[i] = (after - before) / (2.0 * time)
        torques.acceleration[i] = (after - 2.0 * angle + before) / (time * time)
        sine, versine, turn = math.sin(angle), 1.0 - math.cos(angle), model.turn[leg, i]
        for j in range(3):
            for k in range(3):
                torques.rotation[i, j, k] = turn[0, j, k] + sine * turn[1, j, k] + versine * turn[2, j, k]
    base = _average(leg, newest, late, history, torques)
    _inverse_dynamics(leg, model, base, torques)
    for i in range(_LEG):
        speed = torques.speed[i]
        dry = model.dry[leg, i] * math.tanh(speed / model.friction_speed)
        torques.produced[i] += dry + model.viscous[leg, i] * speed
    return True


def _average(leg: int, newest: int, late: int, history: History, torques: Torques) -> tuple[Vector3, Vector3, Vector3]:
    """Average the sent torques, the foot forces and the motion of the pelvis over time.

    Args:
        leg: index in `SIDES`.
        newest: number of the newest stored cycle.
        late: further delay of the torques [cycles].
        history: values of the last cycles.
        torques: output for the mean sent torques and the mean foot forces (`load`).

    Returns:
        Specific force [m/s2], angular velocity [rad/s] and angular acceleration [rad/s2] at the pelvis IMU.
    """
    torques.sent[:], torques.load[:] = 0.0, 0.0
    ax, ay, az = 0.0, 0.0, 0.0
    wx, wy, wz = 0.0, 0.0, 0.0
    dx, dy, dz = 0.0, 0.0, 0.0
    for past in range(2 * HALF):
        row = (newest - past) % SPAN
        weight = (HALF - abs(past + 1 - HALF)) / (HALF * HALF)
        before = (newest - past - DELAY - late) % len(history.sent)
        for i in range(_LEG):
            torques.sent[i] += weight * history.sent[before, leg * _LEG + i]
        for cell in range(torques.load.shape[0]):
            for axis in range(3):
                torques.load[cell, axis] += weight * history.force[row, leg, cell, axis]
        x, y, z = history.accel[row]
        ax, ay, az = ax + weight * x, ay + weight * y, az + weight * z
        x, y, z = history.gyro[row]
        share = 0.5 / HALF
        wx, wy, wz = wx + share * x, wy + share * y, wz + share * z
        # Angular acceleration: mean of the newer `HALF` cycles minus mean of the older `HALF` cycles, divided by HALF * PERIOD.
        share = (1.0 if past < HALF else -1.0) / (HALF * HALF * PERIOD)
        dx, dy, dz = dx + share * x, dy + share * y, dz + share * z
    return (ax, ay, az), (wx, wy, wz), (dx, dy, dz)


def _inverse_dynamics(leg: int, model: LegModel, base: tuple[Vector3, Vector3, Vector3], torques: Torques) -> None:
    """Compute the torques about the joint axes without friction.

    Args:
        leg: index in `SIDES`.
        model: links of the legs.
        base: specific force [m/s2], angular velocity [rad/s] and angular acceleration [rad/s2] at the pelvis IMU.
        torques: motion of the joints, rotation matrices and loads; output for the torques.
    """
    accel, rate, turn = base
    force, moment = torques.force, torques.moment
    for i in range(_LEG):
        down, offset, axis = torques.rotation[i].T, model.offset[leg, i], model.axis[leg, i]
        x, y, z = _swept(accel, rate, turn, offset)
        accel, rate, turn = rotated(down, (x, y, z)), rotated(down, rate), rotated(down, turn)
        speed, gain = torques.speed[i], torques.acceleration[i]
        x, y, z = cross(rate, axis)
        turn = (
            turn[0] + gain * axis[0] + speed * x,
            turn[1] + gain * axis[1] + speed * y,
            turn[2] + gain * axis[2] + speed * z,
        )
        rate = (rate[0] + speed * axis[0], rate[1] + speed * axis[1], rate[2] + speed * axis[2])
        mass, centre, inertia = model.mass[leg, i], model.centre[leg, i], model.inertia[leg, i]
        x, y, z = _swept(accel, rate, turn, centre)
        force[i, 0], force[i, 1], force[i, 2] = mass * x, mass * y, mass * z
        swing, lever, gyroscopic = rotated(inertia, turn), cross(centre, accel), cross(rate, rotated(inertia, rate))
        for k in range(3):
            moment[i, k] = swing[k] + gyroscopic[k] + mass * lever[k]
    for cell in range(torques.load.shape[0]):
        arm = cross(model.cell[leg, cell], torques.load[cell])
        for k in range(3):
            force[_LEG - 1, k] -= torques.load[cell, k]
            moment[_LEG - 1, k] -= arm[k]
    for i in range(_LEG - 1, -1, -1):
        axis = model.axis[leg, i]
        torques.produced[i] = axis[0] * moment[i, 0] + axis[1] * moment[i, 1] + axis[2] * moment[i, 2]
        if i > 0:
            pull, twist = rotated(torques.rotation[i], force[i]), rotated(torques.rotation[i], moment[i])
            arm = cross(model.offset[leg, i], pull)
            for k in range(3):
                force[i - 1, k] += pull[k]
                moment[i - 1, k] += twist[k] + arm[k]


def _swept(accel: Vector3, rate: Vector3, turn: Vector3, offset: Vector) -> Vector3:
    """Return the acceleration of a point of a rigid body.

    Args:
        accel: acceleration of the origin [m/s2].
        rate: angular velocity [rad/s].
        turn: angular acceleration [rad/s2].
        offset: position of the point [m].
    """
    tangential, centripetal = cross(turn, offset), cross(rate, cross(rate, offset))
    return (
        accel[0] + tangential[0] + centripetal[0],
        accel[1] + tangential[1] + centripetal[1],
        accel[2] + tangential[2] + centripetal[2],
    )
