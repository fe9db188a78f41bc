"""Parameters of the walking controller."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from atalante_control.guide.config import StepGuideConfig
from atalante_control.guide.disturbance import HandOver
from atalante_control.joint.pid import PidGains
from atalante_control.walking.contact import ImpactConfig
from atalante_control.walking.lean import LeanConfig
from atalante_control.walking.placement import PlacementConfig
from atalante_hal.robot import JOINTS
from atalante_hal.types import PERIOD, Vector

Pair = tuple[float, float]

#: Default of `WalkConfig.steering`. The transverse hip turns by 0.5 rad per rad of heading error, plus 0.15 rad per metre of
#: sideways deviation from the path. Without a turn, the limit of the sum is 3 degrees.
STEERING = 0.5, 0.15, math.radians(3.0)

_NO_INTEGRAL = (0.0,) * 6
#: Largest absolute value of `WalkConfig.turn` (rotation of the walking direction before each periodic step) [rad].
#: With a turn of 5 degrees, a passive patient of 91 kg and 1.93 m fell in guided steps at assistance factor 0.
#: With an active patient of 91 kg and 1.93 m, the largest DCM error was 0.15 m at a turn of 3 degrees, and 0.19 m at 4 degrees.
TURN_MAX = math.radians(3.0)
#: Gains without integral terms. With integral terms, the robot began to limp after about 120 steps in MuJoCo.
#: The PIDs act against the ankle stabiliser, so the integral terms of the two legs drifted apart.
WALK_GAINS = PidGains(
    stance=replace(PidGains().stance, ki=_NO_INTEGRAL), swing=replace(PidGains().swing, ki=_NO_INTEGRAL)
)
#: Parameters of the guide on the ground.
#: `stiffness` is larger than in the air, because the leg of the exoskeleton also carries the leg of the patient.
#: `hand_over` (largest deviations at the start of a step for which the guide is certified) covers the deviations after a landing.
#: On the ground, the controller adds no torque that smooths the torque jump at a stance change (`carried` is 0).
#: So only the torque limiter of the HAL limits how fast the torque changes after a stance change.
WALK_GUIDE = StepGuideConfig(
    stiffness=(4500.0, 3300.0),
    hand_over=HandOver(
        deviation=math.radians(1.0), rate=0.3, torque=(95.0, 52.0), carried=(0.0, 0.0), acceleration=30.0
    ),
)


@dataclass(frozen=True)
class WalkConfig:
    """Parameters of the walking controller.

    Raises:
        ValueError: If a parameter is out of range.
    """

    gains: PidGains = WALK_GAINS
    #: Fraction by which each cycle of delay (`State.delay`) reduces the derivative gains of the stance leg (SH, SK, SA).
    #: With a delay of d cycles, the gains are multiplied by 1 - damping_loss * d. Example: by 0.75 with the default and d = 3.
    #: With full gains and a delay of 3 cycles, the stance leg of a light patient oscillates with 50 Hz after a landing.
    damping_loss: float = 1.0 / 12.0
    impact: ImpactConfig = field(default_factory=ImpactConfig)
    #: Duration of the re-centring, as a fraction of the duration of the step or weight shift.
    #: During the re-centring, the desired motion returns from the measured pose to the nominal motion.
    alpha: float = 0.3
    #: True: the periodic steps use the literal law, exactly as printed in Gurriet et al. (2019), see `WalkConfig.literal`.
    #: The guide of the periodic steps is then not certified.
    literal_law: bool = False
    #: Gain of the ankle stabiliser [m/m]: shift of the centre of pressure per metre of DCM error.
    #: DCM: divergent component of motion.
    stabiliser: float = 2.5
    shift_limit: Pair = (0.12, 0.05)  # m, largest shift of the centre of pressure (along the walk, sideways)
    #: m, smallest permitted distance from the centre of pressure to the front edge and to the rear edge of the stance sole.
    #: The torque of the sagittal ankle is limited so that the centre of pressure keeps the distance `edge`.
    edge: float = 0.005
    placement: PlacementConfig = field(default_factory=PlacementConfig)  # parameters of foot placement and step timing
    lean: LeanConfig = field(default_factory=LeanConfig)  # parameters of the lean of the trunk
    flat_foot: bool = True  # whether the ankle of the swing leg holds the sole horizontal
    #: m/s, downward speed of a late swing foot (a swing foot that has not landed at the nominal end of the step).
    #: Element 0 applies to the start step and to the periodic step. Element 1 applies to the stop step.
    reach_speed: Pair = (0.3, 0.03)
    #: s, longest time for which a late swing foot moves down. Hip and knee stop earlier if the knee angle falls to `reach_knee`.
    reach_time: float = 0.2
    #: rad/s, largest speed of sagittal hip and knee while a late swing foot moves down.
    #: With an almost straight leg, even a slow foot needs high joint speeds. The foot is then slower than `reach_speed`.
    reach_rate: float = 2.5
    reach_knee: float = 0.05  # rad, smallest knee angle while a late swing foot moves down
    #: Steering adds an offset to the transverse hip.
    #: Element 0: offset of the hip per heading error [rad/rad]. Element 1: offset per sideways deviation from the path [rad/m].
    #: Element 2: largest offset of the hip [rad], without a turn. A turn increases the largest offset by abs(`turn`).
    steering: tuple[float, float, float] = STEERING
    #: rad, rotation of the walking direction before each periodic step, positive to the left
    turn: float = 0.0
    #: s, longest wait for a landing after the nominal end of a step. After the wait, the step ends without a detected landing.
    landing_timeout: float = 0.4
    load_bandwidth: float = 35.0  # Hz, cut-off frequency of the low-pass of the vertical foot forces
    observer_bandwidth: float = 2.0  # rad/s, natural frequency of the attitude observer
    #: True: the heading of the pelvis IMU corrects the drift of the gyro, see `walking.heading`.
    #: If True, the pelvis IMU must have a heading reference, such as a magnetometer.
    #: False: the estimated heading is the integral of the gyro.
    heading_reference: bool = False
    loaded: float = 0.3  # smallest load with which a standing foot counts as loaded, as a fraction of the weight
    #: Smallest load on a foot with which the full stance gains apply, as a fraction of the weight.
    #: If the foot carries less load, the gains are between the swing gains (no load) and the stance gains.
    #: Element 0 applies to each leg while the robot stands. Element 1 applies to the ankle of the stance leg during a step.
    full_gains: Pair = (0.25, 0.5)
    settle: float = 1.0  # s, time for which both feet must be loaded before the robot walks
    #: m, largest permitted distance of one foot ahead of the other at the start of a walk on the ground.
    #: The motion to the standing pose moves both feet at once, so a robot with one foot ahead would fall.
    stride: float = 0.05
    posture: float = 2.0  # s, duration of the motion from the measured pose to the standing pose
    shift: float = 1.5  # s, duration of a weight shift, onto one foot or back to both feet
    rest: float = 0.3  # s, wait after each weight shift
    guide: StepGuideConfig = WALK_GUIDE
    #: Duration of the re-centring of swing hip and knee (SH, SK) in a guided step, as a fraction of the step duration.
    #: With the shorter duration `alpha`, the drives of SH and SK would reach the torque limit.
    #: For all other joints, the duration is `alpha`. With the longer `guided_alpha` for all joints, the robot would fall.
    guided_alpha: float = 0.5
    #: s, time in which the smallest permitted weight of the backup torque falls from 1 to 0 at the start of a guided step.
    #: The backup torque holds the leg inside the guide.
    engage: float = 0.02
    #: s, time in which the torques of SH and SK change from the guide to the baseline controller.
    #: The change begins at the nominal end of a guided step.
    release: float = 0.03

    @classmethod
    def literal(cls) -> WalkConfig:
        """Return the parameters with which the periodic steps follow the paper literally, for comparisons.

        In the periodic steps, the baseline controller is the PID with re-centring, impact detection and flat foot. This
        controller has no gravity torque, no feedforward, no ankle stabiliser and no steering. Below Xi = 1,
        `guide.literal` drives SH and SK of the swing leg. Standing, weight shifts, start step and stop step follow the default
        law, because the paper does not define these phases. The PID gains with integral apply in all phases. The integral is
        not limited in the periodic steps, and at most 10 Nm in the other phases. The ankle offset of one degree is
        left out, as it is in the default walk.
        """
        return cls(literal_law=True, gains=PidGains(), steering=(0.0, 0.0, 0.0))

    def leg_gains(self, delay: int = 0) -> Vector:
        """Return two sets of PID gains for all joints: the gains of a swing leg and the gains of a stance leg.

        Args:
            delay: number of cycles by which torques act late, `State.delay`.

        Returns:
            Gains, shape (2, 3, 12). Axis 0: swing leg, stance leg. Axis 1: Kp [Nm/rad], Kd [Nm s/rad], Ki times the cycle
            time [Nm/rad]. Axis 2: joint, in the order of `JOINTS`.
        """
        roles = self.gains.swing, self.gains.stance
        gains = np.array([[2 * g.kp, 2 * g.kd, np.array(2 * g.ki) * PERIOD] for g in roles])
        sagittal = [joint.endswith(("SH", "SK", "SA")) for joint in JOINTS]
        gains[1, 1, sagittal] *= 1.0 - self.damping_loss * delay
        return gains

    def __post_init__(self) -> None:
        for name in ("reach_time", "landing_timeout", "settle", "posture", "shift", "rest", "engage", "release"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= PERIOD):
                raise ValueError(f"{name} must be at least one cycle ({PERIOD} s), got {getattr(self, name)!r}")
        if not 0.0 <= self.stabiliser <= 10.0:
            raise ValueError(
                "stabiliser (shift of the centre of pressure per error of the divergent component of motion) "
                f"must be from 0 to 10 m/m, got {self.stabiliser!r}"
            )
        if not 0.0 <= self.damping_loss <= 0.25:
            raise ValueError(f"damping_loss must be from 0 to 0.25 per cycle, got {self.damping_loss!r}")
        if not 0.0 <= self.edge <= 0.1:
            raise ValueError(f"edge must be from 0 to 0.1 m, got {self.edge!r}")
        if not abs(self.turn) <= TURN_MAX:
            raise ValueError(f"turn must be from {-TURN_MAX:.4f} to {TURN_MAX:.4f} rad, got {self.turn!r}")
        placement = self.placement
        if not 0.0 < placement.slowest <= 1.0:
            raise ValueError(f"placement.slowest must be above 0 and at most 1, got {placement.slowest!r}")
        if not 1.0 <= placement.fastest < math.inf:
            raise ValueError(f"placement.fastest must be finite and at least 1, got {placement.fastest!r}")
        if not (math.isfinite(placement.frozen) and placement.frozen >= PERIOD):
            raise ValueError(f"placement.frozen must be at least one cycle ({PERIOD} s), got {placement.frozen!r}")
        for name, part in (("loaded", self.loaded), ("full_gains[0]", self.full_gains[0])):
            if not 0.0 < part < 0.5:
                raise ValueError(f"{name} must be above 0 and below 0.5 (fraction of the weight), got {part!r}")
