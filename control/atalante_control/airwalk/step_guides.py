"""Virtual guides of the airwalk controller: one guide filter for each set of gains, and the selection for each step.

`assistance factor -> guide filter, certificate`. A stiff backup policy is needed in a narrow guide, but exceeds the available
torque in a wide one. Each step uses the softest filter that is certified with a margin at its assistance factor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from atalante_control.airwalk.assistance import Assistance
from atalante_control.airwalk.config import AirwalkConfig, baseline_share
from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import Gait
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.backup_policy import BackupPolicy
from atalante_control.guide.certificate import Certificate, certify, largest_assistance
from atalante_control.guide.filter import GuideConfig, GuideFilter
from atalante_control.guide.shapes import GuideShape
from atalante_control.joint.idealization import AssistedInertia
from atalante_hal.robot import LEG_JOINTS, Robot
from atalante_hal.types import Vector

_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")


class StepGuides:
    """Guide filters of one gait and one shape.

    Attributes:
        filters: guide filters in ascending order of their gains.
    """

    def __init__(
        self,
        config: AirwalkConfig,
        shape: GuideShape,
        gait: Gait,
        deadbeat: Deadbeat,
        assistance: Assistance,
        torque_limits: Vector,
    ) -> None:
        """Build the filters, and compute the largest assistance factor for which each filter is used.

        Args:
            config: parameters of the controller.
            shape: shape of the guide.
            gait: right-stance step that repeats.
            deadbeat: re-centring of the gait.
            assistance: inertias and feedforward of SH and SK.
            torque_limits: largest backup torque of SH and SK, shape (2,) [Nm], see `backup_torque_limits`.
        """
        self._config, self._inertia = config, assistance.inertia
        swing = [_SH, _SK]
        nominal, following = gait.coefficients[swing], gait.mirrored().coefficients[swing]
        self.filters = [
            GuideFilter(guide_config, shape, deadbeat, nominal, following, assistance.feedforward)
            for guide_config in guide_configs(config, assistance.inertia, torque_limits)
        ]
        #: Largest assistance factor for which each filter is used; the stiffest filter has no entry.
        self._largest = [
            largest_assistance(guide, config.guide_margin, config.hand_over) for guide in self.filters[:-1]
        ]

    def at(self, xi: float) -> GuideFilter:
        """Return the softest filter with a certificate margin of at least `guide_margin` at Xi, else the stiffest filter.

        Args:
            xi: assistance factor in [0, 1].
        """
        usable = (guide for guide, largest in zip(self.filters, self._largest, strict=False) if xi <= largest)
        return next(usable, self.filters[-1])

    def certificate(self, xi: float) -> Certificate:
        """Return the certificate of the filter used at an assistance factor.

        A guide is not certified where the controller uses another control law than the certificate assumes: for Xi above
        `AirwalkConfig.fade`, and with `AirwalkConfig.decoupled` off.

        Args:
            xi: assistance factor in [0, 1].
        """
        config = self._config
        certificate = certify(self.at(xi), xi, config.hand_over, self._inertia)
        share = baseline_share(xi, config.fade)
        if share == 1.0:
            reason = "at Xi = 1 only the baseline controller drives the joints"
        elif share > 0.0:
            reason = f"fade: the certificate does not cover Xi {config.fade:g} to 1, where the baseline is blended in"
        elif not config.decoupled:
            reason = "the certificate holds for separate inertias, but hip and knee are coupled (decoupled=False)"
        else:
            return certificate
        return replace(certificate, certified=False, reason=reason, joint_torque=None)


def backup_torque_limits(robot: Robot, config: AirwalkConfig, gravity: Gravity, poses: Vector) -> Vector:
    """Return the torque limits of SH and SK minus gravity and friction torques, shape (2,) [Nm].

    Args:
        robot: limits of the joints.
        config: friction of the joints.
        gravity: gravity of the exoskeleton.
        poses: poses along a step in which the left leg swings, shape (n, 12) [rad].
    """
    level = (1.0, 0.0, 0.0, 0.0)
    weight = np.array([np.abs(gravity.torque(pose, level)) for pose in poses[::20].copy()]).max(axis=0)
    return np.array(
        [float(robot.torque_max[joint] - weight[joint]) - config.friction.torque(joint, 2.0) for joint in (_SH, _SK)]
    )


def guide_configs(config: AirwalkConfig, inertia: AssistedInertia, torque_limits: Vector) -> Iterator[GuideConfig]:
    """Yield the configuration of each guide filter, lowest gains first. Each joint has the gains Kp = J w^2 and Kd = 2 d J w.

    J is the inertia of the joint without coupling to the other joint, w the natural frequency and d the damping ratio.

    Args:
        config: natural frequencies, damping ratio, disturbance bounds and horizon.
        inertia: inertias J of SH and SK.
        torque_limits: largest backup torque of SH and SK, shape (2,) [Nm].
    """
    for part in (*config.gentler, 1.0):
        hip, knee = (
            BackupPolicy(j * (part * rate) ** 2, 2.0 * config.guide_damping * j * part * rate, j, limit)
            for j, rate, limit in zip(inertia.inertias, config.guide_rate, torque_limits.tolist(), strict=True)
        )
        yield GuideConfig((hip, knee), config.disturbance, config.points, config.overlap, config.zeta)
