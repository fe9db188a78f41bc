"""Benchmarks of the model, the gait network and the gait library."""

from __future__ import annotations

import time
from itertools import cycle
from typing import Final

import numpy as np
import pinocchio

from atalante_control.dynamics.gait_network import load_network
from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_hal.robot import load_robot
from atalante_hal.types import GRAVITY
from atalante_tools.bench.measure import Effort, Measurement, require, timed

_PATIENT: Final = Patient(75.0, 1.75)
#: Target time for one evaluation of the gait network [s].
_BUDGET: Final = 50e-6
#: Target time to solve one gait of a gait library on one core [s].
_GAIT: Final = 3.0
_BUILDS: Final = 3
_EVALUATIONS: Final = 100
_DYNAMICS: Final = 100


def model_build(effort: Effort) -> Measurement:
    """Measure the time to build the Pinocchio model from the mass and the height of a patient."""
    robot, parameters = load_robot(), ExoskeletonParameters()
    text = urdf(parameters, robot, _PATIENT)
    return effort.interleave(
        timed(lambda: pinocchio_model(urdf(parameters, robot, _PATIENT)), _BUILDS),
        timed(lambda: pinocchio.buildModelFromXML(text), _BUILDS),
        share=0.25,
    )


def inverse_dynamics(effort: Effort) -> Measurement:
    """Measure the time to compute joint torques and ground wrench from the motion of a robot that stands on one foot."""
    robot = load_robot()
    dynamics = stance_dynamics(robot, _PATIENT)
    model = pinocchio_model(urdf(ExoskeletonParameters(), robot, _PATIENT), fixed_base=False).model
    data = model.createData()
    rng = np.random.default_rng(0)
    states = [(rng.uniform(robot.position_min, robot.position_max), *rng.normal(size=(2, 12))) for _ in range(64)]
    floating = [(np.r_[np.zeros(6), 1.0, q], np.r_[np.zeros(6), v], np.r_[np.zeros(6), a]) for q, v, a in states]
    weight = pinocchio.computeTotalMass(model) * GRAVITY
    force = dynamics.forces(states[0][0], np.zeros(12), np.zeros(12)).force
    require(
        abs(force[2] - weight) < 1e-6, f"ground force must equal the weight of {weight:.1f} N, got {force[2]:.1f} N"
    )
    stance_states, floating_states = cycle(states), cycle(floating)
    return effort.interleave(
        timed(lambda: dynamics.forces(*next(stance_states)), _DYNAMICS),
        timed(lambda: pinocchio.rnea(model, data, *next(floating_states)), _DYNAMICS),
    )


def network_evaluation(effort: Effort) -> Measurement:
    """Measure the time in which the gait network computes twelve joint trajectories from subject parameters."""
    network = load_network()
    inputs = np.random.default_rng(0).uniform(network.low, network.high, (64, len(network.low)))
    spread = np.ptp([network.coefficients(row) for row in inputs], axis=0).max()
    require(spread > 0.05, f"the gaits must differ by more than 0.05 rad, got {spread:.3f} rad")
    rows = cycle(inputs)
    measured = effort.interleave(timed(lambda: network.coefficients(next(rows)), _EVALUATIONS), lambda: _BUDGET)
    return Measurement(measured.value, _BUDGET)


def library_one_process(effort: Effort) -> Measurement:
    """Measure the time per gait when one process solves all gaits of a library."""
    return _library(effort, 1)


def library_two_processes(effort: Effort) -> Measurement:
    """Measure the time per gait when two processes solve all gaits of a library in parallel."""
    return _library(effort, 2)


def _library(effort: Effort, jobs: int) -> Measurement:
    """Measure the time per gait of a library.

    The first gait of each process does not count, because its time includes the set-up.
    """
    from atalante_control.gait_optimization.library import solve_subject
    from atalante_control.gait_optimization.network_error import random_subjects
    from atalante_control.gait_optimization.parallel import fan_out

    count = (1 if effort.quick else 12) * jobs
    network = load_network()
    subjects = random_subjects(network.low, network.high, count + jobs, seed=0)
    began = 0.0
    for done, solved in enumerate(fan_out(solve_subject, subjects, jobs=jobs), 1 - jobs):
        require(solved.solved, solved.status)
        if done == 0:
            began = time.perf_counter()
        elif done > 0:
            effort.progress(done, count)
    seconds = time.perf_counter() - began
    return Measurement(seconds / count, _GAIT / jobs, (f"{count / seconds * 60:.0f} gaits per minute",))
