"""Where the optimiser starts: a plain step by inverse kinematics, pelvis swaying over the stance foot, knees bent.

Every solution of the library begins here or at a neighbour that did, so that all lie in one valley.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.step_problem import StepProblem
from atalante_hal.robot import JOINTS

Vector = npt.NDArray[np.float64]

_BEND = 0.96  # height of the pelvis over the ankle, of the straight leg
_WIDTH, _SWAY, _LIFT = 0.20, 0.03, 0.06  # m, between the ankles; of the pelvis to the stance side; of the swing foot
_CROUCH = {"SH": -0.25, "SK": 0.5, "SA": -0.2}  # rad, where the search for a pose starts
_ITERATIONS, _TOLERANCE, _LARGEST = 50, 1e-6, 0.2  # of Gauss-Newton; m and rad; rad a joint and iteration


def guess(problem: StepProblem, parameters: Vector, subject: Subject) -> Vector:
    """Bezier control points (12, 8) [rad] of a plausible step."""
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
    """Joint angles that bring pelvis and swing ankle to the target with both level, by damped Gauss-Newton."""
    for _ in range(_ITERATIONS):
        error, jacobian = (np.array(value) for value in errors(pose, target, parameters))
        if np.abs(error).max() < _TOLERANCE:
            break
        normal = jacobian.T @ jacobian + 1e-6 * np.eye(len(pose))
        pose = pose - np.clip(np.linalg.solve(normal, jacobian.T @ error).ravel(), -_LARGEST, _LARGEST)
    return pose
