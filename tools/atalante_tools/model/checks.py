"""Consistency checks of the model of exoskeleton and patient."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pinocchio

from atalante_control.model import ExoskeletonParameters, Patient, links, pinocchio_model, urdf
from atalante_hal.robot import Robot
from atalante_tools.session.body import engine_hint, no_banner

#: Number of random states in which Pinocchio and PyBullet are compared.
STATES = 100
#: The model check compares torques and mass matrices from Pinocchio and PyBullet.
#: The check fails if the relative difference of two corresponding arrays is at least `AGREEMENT`.
#: The relative difference is the largest difference of two elements, divided by the largest element of the Pinocchio array.
AGREEMENT = 1e-6


@dataclass(frozen=True)
class ModelCheck:
    """Name and result of one check of the model."""

    name: str
    ok: bool | None  # None if the check could not be run
    text: str


def model_checks(parameters: ExoskeletonParameters, robot: Robot, patient: Patient | None) -> Iterator[ModelCheck]:
    """Check total mass, mirror symmetry, positive inertias, and that Pinocchio and PyBullet compute the same dynamics.

    Args:
        parameters: parameters of the exoskeleton.
        robot: robot with the joint limits.
        patient: patient in the exoskeleton; None means no patient.
    """
    bodies = links(parameters, patient)
    total, empty = (math.fsum(body.inertia.mass for body in tree) for tree in (bodies, links(parameters)))
    worn = patient.mass if patient else 0.0
    yield ModelCheck(
        "mass", abs(total - empty - worn) < 1e-10, f"{total:g} kg: exoskeleton {empty:g}, patient {worn:g}"
    )

    by_name = {body.name: body for body in bodies}
    left = [body for body in bodies if body.name.startswith("left_")]
    asymmetric = [body.name for body in left if by_name[body.mirrored().name] != body.mirrored()]
    text = (
        f"{asymmetric[0]} must mirror its right counterpart, but differs"
        if asymmetric
        else f"all {len(left)} pairs of left and right links are exact mirror images"
    )
    yield ModelCheck("mirror", not asymmetric, text)

    moments = {body.name: np.linalg.eigvalsh(body.inertia.matrix()) for body in bodies if body.inertia.mass}
    slack = {name: float((a + b - c) / c) if a > 0.0 else -math.inf for name, (a, b, c) in moments.items()}
    worst = min(slack, key=lambda name: slack[name])
    text = f"all {len(moments)} positive definite, smallest triangle inequality margin {slack[worst]:.2f} in {worst}"
    yield ModelCheck(
        "inertias", slack[worst] > -1e-12, text if slack[worst] > -1e-12 else f"the inertia of {worst} is not physical"
    )
    yield _engines(urdf(parameters, robot, patient), robot)


def _engines(text: str, robot: Robot) -> ModelCheck:
    try:
        with no_banner():
            from atalante_emulator.engine_dynamics import EngineDynamics
    except ModuleNotFoundError as error:
        if error.name != "pybullet":
            raise
        return ModelCheck("engines", None, f"not compared, PyBullet is not installed; type: {engine_hint()}")
    model, into, out_of = pinocchio_model(text)
    data = model.createData()
    rng = np.random.default_rng(0)
    largest = 0.0
    with EngineDynamics(text) as engine:
        for _ in range(STATES):
            q = rng.uniform(robot.position_min, robot.position_max)
            v, a = rng.normal(size=q.size) * 2.0, rng.normal(size=q.size) * 20.0
            state = np.zeros((3, q.size))
            state[0, into], state[1, out_of], state[2, out_of] = q, v, a
            upper = np.triu(pinocchio.crba(model, data, state[0]))
            for by_engine, by_pinocchio in (
                (engine.inverse_dynamics(q, v, a), pinocchio.rnea(model, data, *state)[out_of]),
                (engine.gravity(q), pinocchio.computeGeneralizedGravity(model, data, state[0])[out_of]),
                (engine.mass_matrix(q), (upper + np.triu(upper, 1).T)[np.ix_(out_of, out_of)]),
            ):
                largest = max(largest, float(np.abs(by_engine - by_pinocchio).max() / np.abs(by_pinocchio).max()))
    text = f"Pinocchio and PyBullet differ by at most {largest:.1e} (relative, {STATES} random states)"
    return ModelCheck("engines", largest < AGREEMENT, text)
