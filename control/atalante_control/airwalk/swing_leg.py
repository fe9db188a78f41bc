"""Data of the swing leg for the guide filters (`Leg`): `gait, gravity of the suspended exoskeleton -> Leg`."""

from __future__ import annotations

import numpy as np

from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import Gait, motion
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.disturbance import Leg
from atalante_control.joint.idealization import AssistedInertia
from atalante_hal.robot import LEG_JOINTS
from atalante_hal.types import PERIOD

_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")
#: Number of cycles beyond the end of the step for which the guides predict the motion of the leg.
OVERLAP = 100


def swing_leg(
    config: AirwalkConfig, gait: Gait, inertia: AssistedInertia, gravity: Gravity, overlap: int = OVERLAP
) -> Leg:
    """Return the data of the swing leg along its nominal trajectory, for the guides.

    The data cover one step and the first cycles of the next step, in which the same leg is the stance leg.

    Args:
        config: parameters of the controller; only `alpha` and `friction` are used.
        gait: right-stance step that repeats.
        inertia: mass matrix of SH and SK.
        gravity: gravity of the exoskeleton.
        overlap: number of cycles of the next step to include.
    """
    cycles = gait.cycles
    this = motion(gait.coefficients, gait.duration, np.arange(cycles + 1) / cycles)
    after = motion(gait.mirrored().coefficients, gait.duration, np.arange(1, overlap + 1) / cycles)
    q, qd, qdd = (np.concatenate(rows) for rows in zip(this, after, strict=True))
    level = (1.0, 0.0, 0.0, 0.0)
    weight = np.array([gravity.torque(pose, level).copy() for pose in q.copy()])
    assisted = [_SH, _SK]
    return Leg(
        deadbeat=Deadbeat(gait.duration, config.alpha),
        time=np.arange(cycles + 1 + overlap, dtype=np.float64) * PERIOD,
        q=q[:, assisted],
        qd=qd[:, assisted],
        qdd=qdd[:, assisted],
        gravity=weight[:, assisted],
        inertia=inertia,
        friction=config.friction,
    )
