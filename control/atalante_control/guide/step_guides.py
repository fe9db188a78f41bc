"""Virtual guides of a walk: several guide filters with different stiffnesses. One filter is selected for each step.

`assistance factor -> guide filter, promise, certificate`. The walk is in the air or on the ground. The backup policy is
the spring and damper that returns the leg to its desired trajectory. A narrow guide requires a stiff backup policy, but a stiff
policy reaches the torque limit in a wide guide. Each step uses the filter with the lowest stiffness that is certified for the
requested promise (disturbance torques) at the assistance factor of the step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from atalante_control.guide.backup_policy import BackupPolicy
from atalante_control.guide.certificate import SMALLEST, Certificate, PromiseLimits
from atalante_control.guide.config import StepGuideConfig
from atalante_control.guide.disturbance import Leg
from atalante_control.guide.filter import GuideConfig, GuideFilter
from atalante_control.guide.prediction import Assumptions, prediction_of
from atalante_control.guide.shapes import GuideShape, half_width
from atalante_control.joint.idealization import AssistedInertia
from atalante_hal.robot import LEG_JOINTS, Robot
from atalante_hal.types import PERIOD, Vector

#: Knee angle in the middle of the swing [rad]. The gains of the backup policy (spring and damper) are computed at `_MIDDLE`.
#: At any knee angle other than `_MIDDLE`, mass matrix and stiffness of the joints are different, see `BackupPolicy.mass`.
_MIDDLE = math.radians(30.0)
#: Indices of SH and SK of the left leg. SH and SK have the same limits in both legs.
_ASSISTED = [LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")]
#: Assumed disturbance torques as a fraction of the largest certifiable torques, if the requested torques cannot be certified.
#: With the fraction 1, a prediction would reach its limit without a push, so the filter would apply the full backup torque.
_MARGIN = 0.95
#: Number of intervals between the assistance factors 0 and 1. A filter is chosen for each of the factors 0, 0.01, ..., 1.
_FACTORS = 100


class Choice(NamedTuple):
    """Guide filter that is used in a step, and its certified disturbance torques."""

    guide: GuideFilter
    #: Certified torques as a fraction of the torques that the configuration requests, in [0, 1].
    #: `promise` is 0 if the certified torque at the hip would be below `certificate.SMALLEST`.
    promise: float


class StepGuides:
    """Guide filters for one gait and one guide shape, one filter for each stiffness of the backup policy.

    Attributes:
        filters: guide filters in ascending order of their stiffness.
    """

    def __init__(
        self, config: StepGuideConfig, robot: Robot, shape: GuideShape, leg: Leg, blend: Vector, overlap: int
    ) -> None:
        """Build the filters.

        Args:
            config: gains, promise, and assumptions of the promise.
            robot: limits of the joints.
            shape: shape of the guide.
            leg: swing leg along the nominal trajectory, to the end of the overlap.
            blend: smallest allowed weight of the backup torque in each cycle since the stance change, shape (m,).
            overlap: number of cycles of the leg after the end of the step.
        """
        limits = filter_config(config, robot)
        assumptions = Assumptions(
            promise=config.promise,
            mismatch=config.mismatch,
            hand_over=config.hand_over,
            rate=limits.rate_limit,
            overlap=overlap,
        )
        phases = leg.time / leg.time[len(leg.time) - 1 - overlap]
        # The predictions depend on the width only if a shape is wider than `half_width(0)`, and no shape of the package is wider.
        widest = max(half_width(0.0), float(shape.bounds(phases, 0.0).max()))
        self.filters = [
            GuideFilter(limits, shape, prediction_of(policy, leg, assumptions, blend, widest), blend)
            for policy in policies(config, leg.inertia)
        ]
        self._limits = [PromiseLimits(guide) for guide in self.filters]
        self._choices: dict[int, Choice] = {}

    def prepare(self) -> None:
        """Choose and store the filter and its certified torques for every assistance factor that `at` uses.

        The computation for one assistance factor takes longer than a cycle. In real time, `prepare` must therefore be called
        before a walk. After `prepare`, `at` computes nothing for any assistance factor.
        """
        for number in range(_FACTORS + 1):
            self.at(number / _FACTORS)

    def at(self, xi: float) -> Choice:
        """Return the softest guide filter that is certified for the requested disturbance torques.

        The softest filter has the lowest stiffness of the backup policy. If no filter can be certified for the requested torques,
        return the filter with the largest certifiable torques.

        The filter is chosen for the assistance factor rounded up to 0.01. A larger factor reduces the certifiable torques, so
        the certified torques of the choice are also certified for the exact factor.

        Args:
            xi: assistance factor in [0, 1].
        """
        # Without `round`, the number for 0.07 would be 8, because 0.07 * 100 is above 7 in floating point.
        number = math.ceil(round(xi * _FACTORS, 6))
        if number not in self._choices:
            self._choices[number] = self._choose(number / _FACTORS)
        return self._choices[number]

    def _choose(self, xi: float) -> Choice:
        best, most = self.filters[0], -math.inf
        for guide, promise_limits in zip(self.filters, self._limits, strict=True):
            scale = promise_limits.largest(xi)
            if scale >= 1.0:
                return self._choice(guide, 1.0)
            if scale > most:
                best, most = guide, scale
        return self._choice(best, min(1.0, _MARGIN * most))

    def _choice(self, guide: GuideFilter, promise: float) -> Choice:
        return Choice(guide, promise if promise * guide.prediction.assumptions.promise[0] >= SMALLEST else 0.0)

    def certificate(self, xi: float) -> Certificate:
        """Return the certificate of the filter used at an assistance factor.

        Args:
            xi: assistance factor in [0, 1].
        """
        guide, promise = self.at(xi)
        if xi >= 1.0:
            reason = "no promise: at Xi = 1 only the baseline controller drives the joints"
            return Certificate(guide.shape.name, xi, False, reason, None, None, -math.inf)
        return self._limits[self.filters.index(guide)].certificate(xi, promise)


def filter_config(config: StepGuideConfig, robot: Robot) -> GuideConfig:
    """Return the parameters of the guide filters.

    The limits are the limits of SH and SK of the robot. `torque_limit` and `speed_limit` are smaller by the reserves in `config`.

    Args:
        config: reserves, gains and intensities.
        robot: limits of the joints.

    Raises:
        ValueError: If a reserve is not smaller than the limit of the robot.
    """
    return GuideConfig(
        torque_limit=float(robot.torque_max[_ASSISTED].min()) - config.torque_reserve,
        rate_limit=float(robot.torque_rate_max[_ASSISTED].min()) * PERIOD,
        speed_limit=float(robot.velocity_max[_ASSISTED].min()) - config.speed_reserve,
        worst_speed_limit=float(robot.top_speed[_ASSISTED].min()),
        zeta=config.zeta,
        idealization=config.idealization,
        feedforward=config.feedforward,
    )


def policies(config: StepGuideConfig, inertia: AssistedInertia) -> list[BackupPolicy]:
    """Return the backup policies in ascending order of stiffness.

    Args:
        config: stiffness and damping.
        inertia: mass matrix of SH and SK.
    """
    hip, knee = config.stiffness
    mass = inertia.block(_MIDDLE)
    return [BackupPolicy((part * hip, part * knee), config.damping, mass) for part in (*config.gentler, 1.0)]
