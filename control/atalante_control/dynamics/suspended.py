"""A walking gait in the air: the feedforward of what hangs there instead of what stands on the ground.

`gait (solved, or of the network), exoskeleton -> the same gait with the u_f of the air -> AirwalkController`. The trajectories
stay; but a step on the ground carries a patient on the other leg, and here an empty exoskeleton hangs by its pelvis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import Gait, check_gait, control_points, motion
from atalante_control.model import ArticulatedModel, ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import JOINTS, Robot

Vector = npt.NDArray[np.float64]

_SAMPLES = 33  # phases the eight control points are fitted at
_SAGITTAL_ANKLES = np.array([float(joint.endswith("_SA")) for joint in JOINTS])
_LEVEL = (1.0, 0.0, 0.0, 0.0)  # attitude of the pelvis, unit quaternion wxyz


def suspended_gait(gait: Gait, exoskeleton: ExoskeletonParameters, robot: Robot) -> Gait:
    """The gait with u_f of the hanging empty exoskeleton: the torques of its inertia alone, since u_g is added to it."""
    return replace(gait, feedforward=_feedforward(gait, pinocchio_model(urdf(exoskeleton, robot))))


def check_hung(gait: Gait, robot: Robot, articulated: ArticulatedModel, gravity: Gravity, ankle_offset: float) -> None:
    """Refuse a gait that the hanging exoskeleton must not or cannot walk.

    The torque limits hold for the sum of u_g, pelvis level, and u_f; where the gait has no u_f, it is that of `suspended_gait`.

    Args:
        gait: a right-stance step that repeats, from whichever source.
        robot: with the limits.
        articulated: the empty exoskeleton, pelvis fixed.
        gravity: of the same exoskeleton.
        ankle_offset: added to both sagittal ankles [rad].

    Raises:
        GaitError: see `check_gait`.
    """
    where = f"gait {gait.name!r}"
    check_gait(gait, robot, where)
    # A constant added to all control points of a polynomial is added to the polynomial.
    coefficients = gait.coefficients + ankle_offset * _SAGITTAL_ANKLES[:, None]
    feedforward = _feedforward(gait, articulated) if gait.feedforward is None else gait.feedforward
    walked = replace(gait, coefficients=coefficients, feedforward=feedforward)
    check_gait(walked, robot, where, lambda pose: gravity.torque(pose, _LEVEL).copy())


def _feedforward(gait: Gait, articulated: ArticulatedModel) -> Vector:
    """Return u_f of the hanging empty exoskeleton as control points, (12, 8) [Nm]."""
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
