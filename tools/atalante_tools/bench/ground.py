"""Benchmark of the physics engines: simulate one millisecond of a standing robot with a patient."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Final

import numpy as np

from atalante_control.model import Patient
from atalante_emulator.bodies import ENGINES, Body, hang, make_body
from atalante_hal.robot import load_robot
from atalante_hal.types import GRAVITY
from atalante_tools.bench.measure import Block, Effort, Measurement, require
from atalante_tools.session.body import describe, no_banner

#: Joint angles of a standing pose [rad]. The soles are level and below the centre of mass.
_STANDING: Final = np.array([0.0, 0.0, -0.2, 0.45, -0.25, 0.0] * 2)
#: Stiffness [Nm/rad] and damping [Nm s/rad] with which the joints hold the standing pose.
_KP: Final = np.array([9000, 4000, 6000, 6000, 4000, 2500] * 2)
_KD: Final = np.array([200, 90, 160, 140, 60, 25] * 2)
_SETTLED: Final = 500  # number of steps until the robot stands still
_STEPS: Final = 40


def ground_tick(effort: Effort) -> Measurement:
    """Measure one simulation step of MuJoCo with eight contact points; the baseline is the same step in PyBullet."""
    urdf = describe(load_robot(), None, Patient(75.0, 1.75))
    blocks: dict[str, Block] = {}
    with ExitStack() as stack:
        for engine in ENGINES:
            with no_banner():
                body = make_body(engine, urdf, free=True, ground=0.0)
            stack.callback(body.close)
            blocks[engine] = _standing(body)
        pybullet, mujoco = (blocks[engine] for engine in ENGINES)
        return effort.interleave(mujoco, pybullet)


def _standing(body: Body) -> Block:
    """Put a robot on the floor, and return a timed block. The block simulates `_STEPS` steps.

    The result of the block is the mean time per step [s].

    Args:
        body: robot with a free pelvis.
    """
    hang(body, _STANDING.tolist(), 0.0005)
    now = time.thread_time

    def step() -> float:
        torque = (_KP * (_STANDING - body.position) - _KD * body.velocity).tolist()
        begin = now()
        body.step(torque)
        return now() - begin

    def block() -> float:
        passed = sum(step() for _ in range(_STEPS)) / _STEPS
        weight, load = body.mass * GRAVITY, float(body.sole_force[:, :, 2].sum())
        require(abs(load - weight) < 0.1 * weight, f"the soles must carry {weight:.0f} N, got {load:.0f} N")
        return passed

    for _ in range(_SETTLED):
        step()
    return block
