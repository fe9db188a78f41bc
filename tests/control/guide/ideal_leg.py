"""Ideal plant for tests of the guide: coupled hip and knee of the swing leg, with the drives and the limiter of the robot.

filter -> command -> limiter -> one cycle of delay -> motor -> leg (true inertia and friction) -> encoder, velocity
filter -> filter
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.filter import GuideFilter
from atalante_control.guide.kernel import GuideTables, LegState, tick
from atalante_control.guide.shapes import SHAPES
from atalante_control.joint.idealization import friction, mass, velocity_torques
from atalante_hal.compiled import compiled
from atalante_hal.robot import load_robot

ROBOT = load_robot()
GAIT = load_gait(AIRWALK_GAIT, ROBOT)
DT = 1e-3
KEEP = math.exp(-2.0 * math.pi * 80.0 * DT)
TRACKING = 1.0 - math.exp(-2.0)
RATE, TORQUE = 20.0, 219.0  # largest change of the torque [Nm per cycle], largest torque [Nm]


@cache
def controller(shape: str) -> AirwalkController:
    return AirwalkController(ROBOT, GAIT, SHAPES[shape], AirwalkConfig())


class Truth(NamedTuple):
    """Properties of the plant that the filter does not know."""

    mass: float = 1.0  # factor of inertia, gravity and velocity torques
    friction: float = 1.0  # factor of friction
    delay: int = 1  # cycles from a measurement to the torque that follows from it


class Path(NamedTuple):
    """Desired trajectory of a step and gravity along it. Shape (n, 2) each."""

    q: np.ndarray
    qd: np.ndarray
    gravity: np.ndarray
    carried: np.ndarray  # Nm, torque that is carried over the stance change
    jump: np.ndarray  # Nm, shape (2,), torque before the stance change minus torque of the new control law


@dataclass(frozen=True)
class Start:
    """Start of a step."""

    deviation: tuple[float, float] = (0.0, 0.0)  # rad
    rate: tuple[float, float] = (0.0, 0.0)  # rad/s
    jump: tuple[float, float] = (0.0, 0.0)  # Nm, torque before the stance change minus torque of the new control law


def path_of(guide: GuideFilter, start: Start, blend: np.ndarray) -> Path:
    leg = guide.prediction.leg
    values, slopes, _ = leg.deadbeat.basis(leg.time)
    q = leg.q + np.outer(values[0], start.deviation) + np.outer(values[1], start.rate)
    qd = leg.qd + np.outer(slopes[0], start.deviation) + np.outer(slopes[1], start.rate)
    carried = np.zeros_like(q)
    limit, jump = guide.prediction.assumptions.hand_over.carried, np.array(start.jump)
    carried[: len(blend)] = np.outer(blend, np.clip(jump, np.negative(limit), limit))
    return Path(q, qd, leg.gravity, carried, jump)


def swing(guide: GuideTables, path: Path, truth: Truth, pushes: np.ndarray, mode: int) -> tuple[float, float, float]:
    """Walk one step and return the largest |e| / q_bound, the largest change of the command, and the mean gate.

    Args:
        guide: tables of the filter after `start_step`.
        path: desired trajectory.
        truth: properties of the plant that the filter does not know.
        pushes: disturbance torques of each cycle, shape (n, 2) [Nm]; with a mode above 0 its absolute values are used.
        mode: 0: pushes as given; 1: in the direction of e'; 2: away from q_des; 3: at SK away from q_des, at SH in the opposite
            direction.
    """
    law, cycles = guide.laws[0], len(pushes)
    commands = np.zeros((truth.delay + 1, 2))
    q, qd, v, motor, sent = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    tau, d = np.zeros(2), np.zeros(2)
    for i in range(2):
        q[i], qd[i], v[i] = path.q[0, i], path.qd[0, i], path.qd[0, i]
    worst = jump = gates = 0.0
    for cycle in range(cycles):
        gravity = path.gravity[cycle]
        row = guide.step[cycle]
        for i in range(2):
            e = q[i] - path.q[cycle, i]
            worst = max(worst, e * row[2 * i], -e * row[2 * i + 1])
        state = LegState(
            q[0], q[1], v[0], v[1], path.q[cycle, 0], path.q[cycle, 1], sent[0], sent[1], gravity[0], gravity[1]
        )
        if cycle == 0:
            first = tick(guide, 0, state)
            for i in range(2):
                sent[i] = motor[i] = first[i] + path.jump[i]
                commands[:, i] = sent[i]
            guide.guards[0].fresh = True
            state = LegState(
                q[0], q[1], v[0], v[1], path.q[cycle, 0], path.q[cycle, 1], sent[0], sent[1], gravity[0], gravity[1]
            )
        asked = tick(guide, cycle, state)
        gates += guide.guards[0].gate
        for i in range(2):
            command = asked[i] + path.carried[cycle, i]
            command = min(max(command, sent[i] - RATE), sent[i] + RATE)
            command = min(max(command, -TORQUE), TORQUE)
            jump = max(jump, abs(command - sent[i]))
            for older in range(truth.delay, 0, -1):
                commands[older, i] = commands[older - 1, i]
            commands[0, i] = command
            motor[i] += TRACKING * (commands[truth.delay, i] - motor[i])
            sent[i] = command
            d[i] = pushes[cycle, i]
            if mode == 1:
                d[i] = math.copysign(d[i], qd[i] - path.qd[cycle, i])
            elif mode >= 2:
                d[i] = math.copysign(d[i], q[i] - path.q[cycle, i])
        if mode == 3:
            d[0] = math.copysign(d[0], path.q[cycle, 1] - q[1])
        before = q[0], q[1]
        for _ in range(2):
            m11, m12, m22 = mass(law.fit, q[1])
            c = velocity_torques(law.fit, q[1], qd[0], qd[1])
            for i in range(2):
                rub = friction(qd[i], law.coulomb[i], law.viscous[i], law.smoothing)
                tau[i] = (motor[i] + d[i] - truth.friction * rub) / truth.mass - c[i] - gravity[i]
            determinant = m11 * m22 - m12 * m12
            a0, a1 = (m22 * tau[0] - m12 * tau[1]) / determinant, (m11 * tau[1] - m12 * tau[0]) / determinant
            half = 0.5 * DT
            q[0] += half * qd[0] + 0.5 * half * half * a0
            q[1] += half * qd[1] + 0.5 * half * half * a1
            qd[0] += half * a0
            qd[1] += half * a1
        for i in range(2):
            v[i] = KEEP * v[i] + (1.0 - KEEP) * (q[i] - before[i]) / DT
    return worst, jump, gates / cycles


def attacks(guide: GuideFilter, pair: np.ndarray, rng: np.random.Generator, count: int) -> list[tuple[np.ndarray, int]]:
    """Return pushes within +-pair: constant, by feedback, switching at random, and the worst for the backup policy."""
    n = guide.cycles + 1
    result = [(np.tile(pair * signs, (n, 1)), 0) for signs in np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])]
    result += [(np.tile(pair, (n, 1)), mode) for mode in (1, 2, 3)]
    leg, prediction = guide.prediction.leg, guide.prediction
    responses = prediction.nominal.pushed_error
    inverse = np.linalg.inv(leg.masses(leg.q[:, 1]))
    for _ in range(count):
        end, joint, sign = int(rng.integers(60, n)), int(rng.integers(2)), float(rng.choice([-1.0, 1.0]))
        lag = np.arange(end, 0, -1)
        effect = np.einsum("lc,lcs->ls", responses[lag, joint], inverse[:end])
        pushes = np.tile(pair * sign, (n, 1))
        pushes[:end] = sign * np.sign(effect) * pair
        begin = int(rng.integers(0, end)) if rng.random() < 0.5 else 0
        pushes[:begin] *= float(rng.choice([-1.0, 0.0]))
        result.append((pushes, 0))
        switching = np.repeat(rng.choice([-1.0, 1.0], (n, 2)), int(rng.integers(3, 120)), axis=0)[:n]
        result.append((switching * pair, 0))
    return result


run = compiled(swing)
