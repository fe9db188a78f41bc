"""Parameters of the airwalk controller."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from atalante_control.guide.config import StepGuideConfig
from atalante_control.joint.pid import AIR_GAINS, PidGains
from atalante_hal.types import PERIOD


@dataclass(frozen=True)
class AirwalkConfig(StepGuideConfig):
    """Parameters of the airwalk controller. `literal` returns the parameter values of the paper.

    Raises:
        ValueError: If a parameter is out of range.
    """

    #: Whether the control law of the paper is used: assistive torque of `guide.literal`, baseline without gravity torque.
    #: With the control law of the paper, there is no proof that the joints stay inside the guide under disturbance torques.
    literal_law: bool = False
    gains: PidGains = AIR_GAINS
    #: fraction of the step duration after which the desired trajectory is the nominal trajectory again, see `gait.recentering`
    alpha: float = 0.4
    flat_foot: bool = True  # whether the ankle of the swing leg keeps the sole horizontal
    ankle_offset: float = math.radians(1.0)  # rad, offset added to the desired angles of both sagittal ankles
    startup: float = 2.0  # s, shortest duration of the motion from the measured pose to the first pose of the gait
    #: s, fade-out time of the torque that prevents a jump at a stance change (`carry_over`); with 0, the torque can jump
    blend: float = 0.02
    #: s, fade-out time of the same torque at sagittal hip and knee of a leg with a guide; `blend` applies to all other joints.
    #: The certificate of the guide assumes the fade-out time `guided_blend`.
    guided_blend: float = 0.006

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (math.isfinite(self.startup) and self.startup >= PERIOD):
            raise ValueError(f"startup must be at least one cycle ({PERIOD} s), got {self.startup!r}")
        for name in ("blend", "guided_blend"):
            if not ((value := getattr(self, name)) == 0.0 or PERIOD <= value < math.inf):
                raise ValueError(f"{name} must be 0 or at least one cycle ({PERIOD} s), got {value!r}")

    @classmethod
    def literal(cls) -> AirwalkConfig:
        """Return the parameters with which the controller follows the paper literally, for comparisons.

        With these parameters no guide has a promise: the certificate states no disturbance torques under which the joints stay
        inside the guide. Every departure from the paper that can be undone is undone here. `docs/reference/paper.md` explains
        each departure.
        """
        return cls(
            # In the paper, each assisted joint has a separate control law, and the backup torque u_b uses the gains of the PID.
            # The baseline controller of the paper adds no gravity torque.
            literal_law=True,
            gains=replace(AIR_GAINS, integral_limit=math.inf),
            feedforward=0.0,  # the paper used no feedforward in its experiment in the air
            gentler=(),  # only the stiffest backup gains are used, no softer ones
            blend=0.0,  # the torque can jump at a stance change
            guided_blend=0.0,
        )
