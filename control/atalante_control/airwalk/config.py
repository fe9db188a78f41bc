"""Parameters of the airwalk controller."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from atalante_control.gait.gait import PERIOD
from atalante_control.guide.certificate import HandOver
from atalante_control.joint.idealization import Friction
from atalante_control.joint.pid import AIR_GAINS, PidGains

Pair = tuple[float, float]


@dataclass(frozen=True)
class AirwalkConfig:
    """Parameters of the airwalk controller.

    Raises:
        ValueError: If a parameter is out of range.
    """

    gains: PidGains = AIR_GAINS
    friction: Friction = field(default_factory=Friction)
    alpha: float = 0.4  # end of the re-centring, as a fraction of the step duration
    guide_rate: Pair = (28.0, 44.0)  # rad/s, natural frequencies of SH and SK under the stiffest backup policy
    gentler: tuple[float, ...] = (0.5, 0.7)  # natural frequencies of the softer guides as fractions of guide_rate
    guide_margin: float = 0.25  # a softer guide needs at least this certificate margin, as a fraction of its width
    guide_damping: float = 1.05  # damping ratio of the backup policy; with a ratio of at least 1 the loop is monotone
    # Nm, bounds of the disturbance u_ext of SH and SK, as torques u in J q'' = u (see `guide.certificate`).
    # In PyBullet, the disturbance from coupling, delay and friction is below 14 Nm (SH) and 20 Nm (SK) in 95 % of the cycles.
    # If the friction parameters are wrong by 20 %, the 95 % values are 43 Nm (SH) and 26 Nm (SK).
    disturbance: tuple[Pair, Pair] = ((-30.0, 30.0), (-20.0, 20.0))
    points: int = 100  # number of intervals of the prediction grid over one step
    overlap: float = 0.1  # s, length of the prediction beyond the end of the step
    zeta: float = 0.01  # s, gain of the derivative term lambda_d of the guide filter
    hand_over: HandOver = field(default_factory=HandOver)
    #: True: u_v is converted with the mass matrix of SH and SK. False: u_v is applied directly, as in the paper.
    decoupled: bool = True
    feedforward: bool = False  # True: u_f of the gait is applied to the assisted joints
    flat_foot: bool = True  # True: the sole of the swing foot is held level
    ankle_offset: float = math.radians(1.0)  # rad, offset added to the desired SA angles of both legs
    fade: float = 0.9  # assistance factor Xi above which the baseline torque is blended in
    startup: float = 2.0  # s, duration of the motion from the measured pose to the first pose of the gait
    blend: float = 0.03  # s, time in which the compensation of a torque jump fades out (see `carry_over`)
    active: float = 0.05  # weight of the backup torque above which the filter counts as active

    def __post_init__(self) -> None:
        for name in ("startup", "blend"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= PERIOD):
                raise ValueError(f"{name} must be at least one cycle ({PERIOD} s), got {getattr(self, name)!r}")
        if not 0.0 <= self.fade < 1.0:
            raise ValueError(f"fade must be an assistance factor in [0, 1), got {self.fade!r}")
        if not (min(self.guide_rate) > 0.0 and self.guide_damping > 0.0):
            raise ValueError(
                f"guide_rate and guide_damping must be positive, got {self.guide_rate!r} and {self.guide_damping!r}"
            )
        if list(self.gentler) != sorted(self.gentler) or not all(0.0 < part < 1.0 for part in self.gentler):
            raise ValueError(f"gentler must be ascending fractions of guide_rate in (0, 1), got {self.gentler!r}")


def baseline_share(xi: float, fade: float) -> float:
    """Return the weight w(Xi) of the baseline torque: 0 up to `fade`, then a smoothstep to exactly 1 at Xi = 1.

    Args:
        xi: assistance factor in [0, 1].
        fade: `AirwalkConfig.fade`, in [0, 1).
    """
    x = (xi - fade) / (1.0 - fade)
    return 0.0 if x <= 0.0 else 1.0 if x >= 1.0 else x * x * (3.0 - 2.0 * x)
