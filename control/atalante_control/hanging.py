"""A walking gait in the air: the feedforward of what hangs there instead of what stands on the ground.

`gait (solved, or of the network), exoskeleton -> the same gait with the u_f of the air -> HangController`. The trajectories
stay; but a step on the ground carries a patient on the other leg, and here an empty exoskeleton hangs by its pelvis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio

from atalante_control.gait import Gait, control_points, motion
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import Robot

_SAMPLES = 33  # phases the eight control points are fitted at


def hung(gait: Gait, exoskeleton: ExoskeletonParameters, robot: Robot) -> Gait:
    """The gait with u_f of the hanging empty exoskeleton: the torques of its inertia alone, since u_g is added to it."""
    model, into, out_of = pinocchio_model(urdf(exoskeleton, robot))
    data = model.createData()
    phase = np.linspace(0.0, 1.0, _SAMPLES)
    torque = np.zeros((_SAMPLES, model.nv))
    q, v, a = np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.nv)
    for row, (position, velocity, acceleration) in enumerate(
        zip(*motion(gait.coefficients, gait.duration, phase), strict=True)
    ):
        q[into], v[out_of], a[out_of] = position, velocity, acceleration
        torque[row] = pinocchio.rnea(model, data, q, v, a) - pinocchio.computeGeneralizedGravity(model, data, q)
    return replace(gait, feedforward=control_points(phase, torque[:, out_of]))
