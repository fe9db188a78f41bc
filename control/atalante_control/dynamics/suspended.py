"""Gait for the exoskeleton suspended in the air: it has the trajectories of a gait on the ground, but another feedforward.

`gait (solver or network), exoskeleton -> gait with u_f for the air`. `AirwalkController` uses this gait. The
feedforward of a gait on the ground includes the load of the patient on the stance leg. In the air the exoskeleton is
empty and suspended at the pelvis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio

from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import Gait, check_gait, control_points, motion
from atalante_control.model import ArticulatedModel, ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import Vector

_SAMPLES = 33  # number of samples per step for the fit of the control points
_SAGITTAL_ANKLES = np.array([float(joint.endswith("_SA")) for joint in JOINTS])
_LEVEL = (1.0, 0.0, 0.0, 0.0)  # attitude of a level pelvis, unit quaternion wxyz


def suspended_gait(gait: Gait, exoskeleton: ExoskeletonParameters, robot: Robot) -> Gait:
    """Return a gait with the feedforward u_f of the empty exoskeleton suspended in the air.

    This u_f consists of the inertia torques alone, because the controller adds the gravity torque u_g.

    Args:
        gait: gait of any source.
        exoskeleton: geometry and masses of the empty exoskeleton.
        robot: limits of the joints.
    """
    return replace(gait, feedforward=_feedforward(gait, pinocchio_model(urdf(exoskeleton, robot))))


def check_suspended(
    gait: Gait, robot: Robot, articulated: ArticulatedModel, gravity: Gravity, ankle_offset: float
) -> None:
    """Raise `GaitError` if the suspended exoskeleton would exceed a limit while it follows a gait.

    The torque limits apply to the sum of feedforward u_f and gravity torque u_g. The gravity torque is computed for a
    level pelvis. A gait without u_f gets the u_f of `suspended_gait`.

    Args:
        gait: right-stance step that repeats, of any source.
        robot: limits of the joints.
        articulated: model of the empty exoskeleton with the pelvis fixed.
        gravity: gravity torques of the same exoskeleton.
        ankle_offset: angle added to both sagittal ankles [rad].

    Raises:
        GaitError: If the gait is invalid, see `check_gait`.
    """
    where = f"gait {gait.name!r}"
    check_gait(gait, robot, where)
    # If a constant is added to all control points, the Bezier polynomial changes by the same constant.
    coefficients = gait.coefficients + ankle_offset * _SAGITTAL_ANKLES[:, None]
    feedforward = _feedforward(gait, articulated) if gait.feedforward is None else gait.feedforward
    walked = replace(gait, coefficients=coefficients, feedforward=feedforward)
    check_gait(walked, robot, where, lambda pose: gravity.torque(pose, _LEVEL).copy())


def _feedforward(gait: Gait, articulated: ArticulatedModel) -> Vector:
    """Return the feedforward u_f of the suspended empty exoskeleton as Bezier control points, shape (12, 8) [Nm]."""
    model, into, out_of = articulated
    data = model.createData()
    phase = np.linspace(0.0, 1.0, _SAMPLES)
    torque = np.zeros((_SAMPLES, model.nv))
    q, v, a = np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.nv)
    for row, (position, velocity, acceleration) in enumerate(
        zip(*motion(gait.coefficients, gait.duration, phase), strict=True)
    ):
        q[into], v[out_of], a[out_of] = position, velocity, acceleration
        torque[row] = pinocchio.rnea(model, data, q, v, a) - pinocchio.computeGeneralizedGravity(model, data, q)
    return control_points(phase, torque[:, out_of])
