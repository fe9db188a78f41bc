"""Model of the swing leg in a step on the ground, for the guide filter.

`gait, kinematics -> model, torque w that the model leaves out`

The guide filter computes the torques of sagittal hip and knee (SH, SK) with the mass matrix of the swing leg. The mass matrix
includes the leg of the patient, and is computed for a fixed pelvis. On the ground, the pelvis moves with the stance leg. The
torque u_g + u_f of the gait includes the effect of the pelvis motion and the weight of the patient's leg. The gravity torque u_g
of the empty exoskeleton and a torque computed with the mass matrix include neither. The filter therefore adds the missing torque
w to u_g. w depends on the time t in the step:

    w(t) = u_f - M(q_nom) q_nom'' - c(q_nom, q_nom')

Here M is the mass matrix and c are the velocity torques. A motion of the pelvis that differs from the motion in the gait acts as
a disturbance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import Gait, motion
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.disturbance import Leg
from atalante_control.joint.idealization import AssistedInertia, Friction
from atalante_control.joint.pid import RIGHT
from atalante_control.model import ArticulatedModel
from atalante_control.walking.kinematics import Kinematics
from atalante_control.walking.rotation import tilt_quaternion
from atalante_hal.robot import LEG_JOINTS
from atalante_hal.types import PERIOD, Vector

_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")


class SwingLeg(NamedTuple):
    """Model of the swing leg with a fixed pelvis in one step, and the additional torque w due to pelvis motion and patient."""

    leg: Leg  # model of sagittal hip and knee for the guide filter; `leg.gravity` is u_g + w
    #: (n + 1, 2) Nm, torque w of hip and knee. w carries the patient's leg and compensates the pelvis motion. Row: cycle.
    #: The controller adds w to the gravity torque of the exoskeleton in the measured pose.
    unmodelled: Vector


def swing_leg(
    gait: Gait, alpha: float, worn: ArticulatedModel, kinematics: Kinematics, gravity: Gravity, friction: Friction
) -> SwingLeg:
    """Return the model of the swing leg along the nominal trajectory of a step, up to the landing at the end of the step.

    Args:
        gait: right-stance step. By symmetry, the result also applies to the left-stance step.
        alpha: end of the re-centring, as a fraction of the step duration.
        worn: model of the robot with the patient, with a fixed pelvis.
        kinematics: kinematics of the robot with the patient.
        gravity: gravity torques u_g, which the controller adds to the feedforward.
        friction: friction of the joints.
    """
    table, assisted = gait.tables(), [_SH, _SK]
    _, _, acceleration = motion(gait.coefficients, gait.duration, np.arange(gait.cycles + 1) / gait.cycles)
    weight = np.array([_gravity(q, qd, kinematics, gravity)[assisted] for q, qd in zip(table.q, table.qd, strict=True)])
    leg = Leg(
        deadbeat=Deadbeat(gait.duration, alpha),
        time=np.arange(gait.cycles + 1, dtype=np.float64) * PERIOD,
        q=table.q[:, assisted],
        qd=table.qd[:, assisted],
        qdd=acceleration[:, assisted],
        gravity=np.zeros((gait.cycles + 1, 2)),
        inertia=AssistedInertia(worn, table.q),
        friction=friction,
    )
    unmodelled = table.uf[:, assisted] - leg.torque()
    return SwingLeg(leg._replace(gravity=weight + unmodelled), unmodelled)


def _gravity(q: Vector, qd: Vector, kinematics: Kinematics, gravity: Gravity) -> Vector:
    """Return the gravity torques u_g of a pose with the right foot flat on the ground, shape (12,) [Nm]."""
    up = kinematics.update(q, qd).soles[RIGHT].rotation[:, 2]
    return gravity.torque(q, tilt_quaternion((up[0], up[1], up[2])))
