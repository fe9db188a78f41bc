"""Initial guess of the optimiser: a simple step with bent knees, computed by inverse kinematics.

The optimisation of each gait of the library starts from this guess. All gaits therefore converge to similar local minima.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.step_problem import StepProblem
from atalante_hal.robot import JOINTS
from atalante_hal.types import Vector

_BEND = 0.96  # height of the pelvis above the ankle, as a fraction of the length of the straight leg
_WIDTH = 0.20  # m, lateral distance between the ankles
_SWAY = 0.03  # m, largest lateral displacement of the pelvis towards the stance foot
_LIFT = 0.06  # m, largest height of the swing foot
_CROUCH = {"SH": -0.25, "SK": 0.5, "SA": -0.2}  # rad, start pose of the inverse kinematics; FH, TH and HA are at 0
_ITERATIONS = 50  # largest number of iterations per pose; if the error is still too large, the last iterate is used
_TOLERANCE = 1e-6  # m or rad, largest accepted error of the inverse kinematics
_LARGEST = 0.2  # rad, largest change of a joint angle in one iteration


def guess(problem: StepProblem, parameters: Vector, subject: Subject) -> Vector:
    """Return the Bezier control points of the initial guess of a step, shape (12, 8) [rad].

    Args:
        problem: nonlinear program of the step.
        parameters: parameters of the nonlinear program.
        subject: patient and step parameters.
    """
    patient, step_length = subject.patient, subject.step_length
    height = _BEND * (patient.length("thigh") + patient.length("shank"))
    start, end = {"periodic": (-1.0, 1.0), "start": (0.0, 1.0), "stop": (-1.0, 0.0)}[problem.kind]
    pose = np.array([_CROUCH.get(joint.split("_")[1], 0.0) for joint in JOINTS])
    poses = []
    for phase in problem.phases:
        forward = step_length * (start + (end - start) * (1.0 - math.cos(math.pi * phase)) / 2.0)
        swing = math.sin(math.pi * phase)
        pelvis = (step_length * (start + (end - start) * phase) / 2.0, _WIDTH / 2.0 - _SWAY * swing, height)
        target = np.array([*pelvis, forward, _WIDTH, _LIFT * swing**2])
        pose = _reach(problem.reach, pose, target, parameters)
        poses.append(pose)
    return np.asarray(np.linalg.lstsq(problem.basis, np.array(poses), rcond=None)[0].T)


def _reach(errors: Any, pose: Vector, target: Vector, parameters: Vector) -> Vector:
    """Return the joint angles at which pelvis and swing foot are level and at the target positions (damped Gauss-Newton)."""
    for _ in range(_ITERATIONS):
        error, jacobian = (np.array(value) for value in errors(pose, target, parameters))
        if np.abs(error).max() < _TOLERANCE:
            break
        normal = jacobian.T @ jacobian + 1e-6 * np.eye(len(pose))
        pose = pose - np.clip(np.linalg.solve(normal, jacobian.T @ error).ravel(), -_LARGEST, _LARGEST)
    return pose
