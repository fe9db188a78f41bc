"""Controller of the paper for an exoskeleton suspended by its pelvis: `State -> Command`, once a cycle.

    step switch -> q_des = q_nom + s -> PID, gravity, flat foot -> u_t --------------------------.
                                     -> idealization u_i, feedforward u_f, virtual guide u_v ->  merge -> u
                                     -> haptics

Steps alternate between right and left stance. They change by time, because no foot touches the ground in the air. SH and SK of
the swing leg get the assistive torque; every other joint gets the baseline torque. The paper leaves four points open. They are
decided as follows:

- *Assistance factor.* Xi changes only at a step change, where the state is re-centred and the torque is handed over. The guide
  therefore never moves during a step, and the certificate of each step stays valid for any input of the operator.
- *Xi towards 1.* The assisted joints get w u_t + (1 - w) (u_i + u_f + u_v). The weight w is a smoothstep from 0 at Xi = 0.9 to
  exactly 1 at Xi = 1, where the torque is bitwise equal to the baseline torque. Their integrals are scaled by the same w.
  No guide is certified for Xi between 0.9 and 1.
- *Gains.* A stiff backup policy is needed in a narrow guide, but exceeds the available torque in a wide one. Each step uses the
  lowest of a few gains with which its guide is certified, with a margin, at its Xi. The command is continuous in Xi except
  where the gains change.
- *Hand-over.* At a step change the re-centring sets the tracking error to zero, a leg changes from one control law to the
  other, and the horizon returns to its full length. The resulting torque step is carried over and faded out within `blend`, so
  the command is continuous. This is part of the baseline and is the same with and without assistance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from atalante_control.airwalk.kernel import STEP, hand_over, run
from atalante_control.airwalk.telemetry import TELEMETRY, AirwalkStatistics
from atalante_control.dynamics.gravity import Gravity
from atalante_control.dynamics.suspended import check_hung
from atalante_control.gait.gait import PERIOD, Gait, bezier, step_over
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.backup_policy import BackupPolicy
from atalante_control.guide.certificate import Certificate, HandOver, certify, largest_assistance
from atalante_control.guide.filter import GuideConfig, GuideFilter
from atalante_control.guide.shapes import GuideShape
from atalante_control.joint.flat_foot import LevelFeet
from atalante_control.joint.haptics import intensity
from atalante_control.joint.idealization import AssistedInertia, Friction, law_of
from atalante_control.joint.pid import AIR_GAINS, LEFT, RIGHT, Pid, PidGains
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.compiled import compiled
from atalante_hal.robot import IMUS, JOINTS, LEG_JOINTS, MOTORS, Robot
from atalante_hal.types import Command, State, Vector

Pair = tuple[float, float]

_LEG = len(LEG_JOINTS)
_SH, _SK, _SA = (LEG_JOINTS.index(joint) for joint in ("SH", "SK", "SA"))
_PELVIS = IMUS.index("pelvis")


@dataclass(frozen=True)
class AirwalkConfig:
    """Parameters of the airwalk controller.

    Raises:
        ValueError: If a parameter is out of range.
    """

    gains: PidGains = AIR_GAINS
    friction: Friction = field(default_factory=Friction)
    alpha: float = 0.4  # fraction of the step after which re-centring reaches the nominal trajectory
    guide_rate: Pair = (28.0, 44.0)  # rad/s, natural frequency of the stiffest backup policy on SH and SK
    gentler: tuple[float, ...] = (0.5, 0.7)  # fractions of guide_rate tried first, ascending
    guide_margin: float = 0.25  # smallest certificate margin, as a fraction of the guide, at which lower gains are used
    guide_damping: float = 1.05  # damping ratio of the backup policy; monotone from 1 on
    # Nm, bounds of u_ext of SH and SK as separate inertias (see `certificate`). Measured in PyBullet, 95 % of the cycles:
    # coupling to other joints, delay and residual friction cause 14 and 20 Nm; a friction error of 20 % causes 43 and 26 Nm.
    disturbance: tuple[Pair, Pair] = ((-30.0, 30.0), (-20.0, 20.0))
    points: int = 100  # intervals of the horizon grid
    overlap: float = 0.1  # s, length of the horizon after the end of the step
    zeta: float = 0.01  # s, derivative gain of the guide
    hand_over: HandOver = field(default_factory=HandOver)
    decoupled: bool = (
        True  # convert u_v through the mass matrix of SH and SK; False: apply u_v directly, as in the paper
    )
    feedforward: bool = False  # apply u_f of the gait to the assisted joints; off in the air
    flat_foot: bool = True  # hold the swing sole level
    ankle_offset: float = math.radians(1.0)  # rad, added to both sagittal ankles
    fade: float = 0.9  # Xi above which the baseline is blended in
    startup: float = 2.0  # s, duration of the motion from the measured pose to the first pose of the gait
    blend: float = 0.03  # s, time in which a torque step at the step change fades out
    active: float = 0.05  # gate above which the filter counts as active

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


class AirwalkController:
    """Airwalk controller. It implements `atalante_hal.types.Controller`.

    Attributes:
        guide: virtual guide filter of this step, one of `guides`.
        guides: guide filters in ascending order of their gains.
        statistics: statistics of the guide since `reset`.
        telemetry: telemetry of the last cycle, for the recording.
        telemetry_fields: name and width of each field of `telemetry`, see `telemetry.TELEMETRY`.
    """

    telemetry_fields = tuple((name, TELEMETRY[name].itemsize // 8) for name in TELEMETRY.names or ())

    def __init__(
        self,
        robot: Robot,
        gait: Gait,
        shape: GuideShape,
        config: AirwalkConfig | None = None,
        exoskeleton: ExoskeletonParameters | None = None,
    ) -> None:
        """Prepare every table, so that the control loop allocates no memory.

        Args:
            robot: limits of the joints.
            gait: right-stance step that repeats.
            shape: shape of the virtual guide.
            config: parameters of the controller; None: the defaults.
            exoskeleton: geometry and masses of the empty exoskeleton; None: the defaults.

        Raises:
            GaitError: If the gait exceeds a limit of the robot or is not periodic, see `suspended.check_hung`.
        """
        self.config = config = config or AirwalkConfig()
        exoskeleton = exoskeleton or ExoskeletonParameters()
        articulated = pinocchio_model(urdf(exoskeleton, robot))
        self._gravity = Gravity(articulated)
        check_hung(gait, robot, articulated, self._gravity, config.ankle_offset)
        self._cycles = gait.cycles
        self._deadbeat = Deadbeat(gait.duration, config.alpha)
        self._pid = Pid(config.gains)

        gaits = {RIGHT: gait, LEFT: gait.mirrored()}
        tables = {stance: step.tables() for stance, step in gaits.items()}
        ankles = [_SA, _LEG + _SA]
        #: Rows (q_nom, q_nom') of a step; re-centring is added to the copy in `_reference`.
        self._nominal = {}
        for stance, table in tables.items():
            rows = np.hstack([table.q, table.qd])
            rows[:, ankles] += config.ankle_offset
            self._nominal[stance] = rows
        swinging = [self._nominal[RIGHT], self._nominal[LEFT]]  # left leg, right leg
        self._feet = LevelFeet(robot, exoskeleton, articulated, self._deadbeat, swinging, config.ankle_offset)
        self._reference = {stance: rows.copy() for stance, rows in self._nominal.items()}
        time: Vector = np.arange(self._cycles + 1, dtype=np.float64) * PERIOD
        (c0, c1), (c0d, c1d), _ = self._deadbeat.basis(time)
        self._fading = int(np.searchsorted(time, self._deadbeat.end))
        n = len(JOINTS)
        self._basis = np.zeros((2, self._fading, 2 * n))  # rows to add per unit of s(0) and of s'(0)
        self._basis[0, :, :n], self._basis[0, :, n:] = c0[: self._fading, None], c0d[: self._fading, None]
        self._basis[1, :, :n], self._basis[1, :, n:] = c1[: self._fading, None], c1d[: self._fading, None]

        self._inertia = AssistedInertia(articulated, tables[RIGHT].q)
        feedforward = self._ideal_feedforward(gait) if config.feedforward else None
        uf: Vector = np.zeros((len(time), 2)) if feedforward is None else bezier(feedforward, time / gait.duration)
        swing = [_SH, _SK]
        self.guides = [
            GuideFilter(
                guide_config,
                shape,
                self._deadbeat,
                gait.coefficients[swing],
                gaits[LEFT].coefficients[swing],
                feedforward,
            )
            for guide_config in self._guide_configs(robot, tables[RIGHT].q)
        ]
        self.guide = self.guides[-1]
        gentler = self.guides[:-1]
        #: Largest assistance factor at which each guide is used; the stiffest guide has no entry.
        self._taken_to = [largest_assistance(guide, config.guide_margin, config.hand_over) for guide in gentler]

        ramp = np.arange(round(config.blend / PERIOD)) * (PERIOD / config.blend)
        self._blend: Vector = 0.5 + 0.5 * np.cos(math.pi * ramp)
        self._startup_cycles = round(config.startup / PERIOD)

        self._last, self._carried, self._share = np.zeros(n), np.zeros(n), np.ones(n)
        self._start_pose, self._start_row = np.zeros(n), np.zeros(2 * n)
        self._deviation, self._rate, self._added = np.zeros(2 * n), np.zeros(2 * n), np.zeros_like(self._basis)
        self._command = Command(self._pid.torque, np.zeros(len(MOTORS)))
        telemetry = np.zeros(1, TELEMETRY)
        self.telemetry = telemetry.view(np.float64)
        self._step = np.zeros(1, STEP)
        self._step["cycles"], self._step["acting"] = self._cycles, config.active
        pid, feet, law = self._pid, self._feet, law_of(config.friction, self._inertia, config.decoupled)
        #: Arguments of `kernel.run` from `steps` on, without the guide tables of the step, which are the last arguments.
        self._kept: tuple[Any, ...] = (
            self._step, feet.ankles, feet.cubics, self._gravity.links, np.zeros(n),
            pid.gains, pid.limit, pid.integral, pid.torque, np.ascontiguousarray(uf), law,
            self._last, self._carried, self._blend, self._command.vibration, telemetry,
        )  # fmt: skip
        self._run = compiled(run)
        self._tables: tuple[Any, ...] = (*self._kept, *self.guide.tables)
        still, attitudes, gyros = self._start_pose, np.zeros((len(IMUS), 4)), np.zeros((len(IMUS), 3))
        self._run(0, False, self._start_row, still, still, attitudes, gyros, still, *self._tables)
        self.statistics = AirwalkStatistics()
        self._forget()

    def guide_at(self, xi: float) -> GuideFilter:
        """Return the guide of lowest gains that is certified at Xi with `guide_margin`, or else the stiffest guide.

        Args:
            xi: assistance factor in [0, 1].
        """
        return next(
            (guide for guide, to in zip(self.guides, self._taken_to, strict=False) if xi <= to), self.guides[-1]
        )

    def certificate(self, xi: float) -> Certificate:
        """Return the certificate of the guide used at an assistance factor.

        The guide is not certified where the running control law differs from the certified one: while the baseline fades in,
        at Xi = 1, and with `AirwalkConfig.decoupled` off.

        Args:
            xi: assistance factor in [0, 1].
        """
        config = self.config
        certificate = certify(self.guide_at(xi), xi, config.hand_over, self._inertia)
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

    def reset(self, state: State) -> None:
        """Restart the motion from the measured pose and torque of the joints.

        Args:
            state: measured state of the robot.
        """
        self._forget()
        self._changed_at = state.cycle
        self._start_pose[:] = state.position
        self._last[:] = state.torque
        if state.torque_sent is not None:
            self._pid.torque[:] = state.torque_sent
        self._step["carry"] = True

    def _forget(self) -> None:
        self._walking, self._stance, self._w, self._changed_at = False, RIGHT, 1.0, 0
        self._step["carry"] = False
        self._pid.reset()
        self._share.fill(1.0)
        self._pid.start_step(RIGHT, self._share)
        self._command.vibration.fill(0.0)
        self._command.outside = False
        self.telemetry.fill(0.0)
        self.statistics = AirwalkStatistics()

    def _guide_configs(self, robot: Robot, q: Vector) -> Iterator[GuideConfig]:
        """Yield the configuration of each guide, lowest gains first.

        The gains follow from the inertia of the swing leg along the step. The torque limit is what gravity and friction leave.
        """
        config = self.config
        level = (1.0, 0.0, 0.0, 0.0)
        weight = np.array([np.abs(self._gravity.torque(pose, level)) for pose in q[::20].copy()]).max(axis=0)
        limits = [
            float(robot.torque_max[joint] - weight[joint]) - config.friction.torque(joint, 2.0) for joint in (_SH, _SK)
        ]
        for part in (*config.gentler, 1.0):
            hip, knee = (
                BackupPolicy(j * (part * rate) ** 2, 2.0 * config.guide_damping * j * part * rate, j, limit)
                for j, rate, limit in zip(self._inertia.inertias, config.guide_rate, limits, strict=True)
            )
            yield GuideConfig((hip, knee), config.disturbance, config.points, config.overlap, config.zeta)

    def _ideal_feedforward(self, gait: Gait) -> Vector | None:
        """Return u_f of SH and SK of the swing leg for the separate inertias: Bezier control points (2, 8) [Nm].

        The feedforward of the gait applies to the coupled pair. It is converted with the mass matrix along the nominal
        trajectory and fitted again.
        """
        swing = [_SH, _SK]
        if gait.feedforward is None or not self.config.decoupled:
            return None if gait.feedforward is None else gait.feedforward[swing]
        table = gait.tables()
        ideal = [
            self._inertia.ideal(float(q[_SK]), float(qd[_SH]), float(qd[_SK]), (float(uf[_SH]), float(uf[_SK])))
            for q, qd, uf in zip(table.q, table.qd, table.uf, strict=True)
        ]
        degree = gait.feedforward.shape[1] - 1
        basis = bezier(np.eye(degree + 1), np.arange(self._cycles + 1) / self._cycles)
        return np.asarray(np.linalg.lstsq(basis, np.array(ideal), rcond=None)[0].T)

    # -- one cycle ---------------------------------------------------------------------------------------------------

    def update(self, state: State) -> Command:
        """Compute the command of one cycle: the step switch, then the compiled kernel (`kernel.run`).

        Args:
            state: measured state of the robot.

        Returns:
            The command, overwritten by the next call.
        """
        cycle = state.cycle - self._changed_at
        if self._walking:
            if step_over(cycle, self._cycles):
                if self._stance == RIGHT:
                    self.statistics.steps += 1
                self._change_step(state, LEFT if self._stance == RIGHT else RIGHT)
                cycle = 0
        elif cycle < self._startup_cycles:
            return self._move_to_start(state, cycle)
        else:
            self._walking = True
            self._change_step(state, RIGHT)
            cycle = 0
        row, side = self._reference[self._stance][cycle], 1 - self._stance
        level = self.config.flat_foot and self._feet.heard(state, side)
        if self.config.flat_foot and not level:
            self._feet.put(state, side, cycle, row)
        sent = self._pid.torque if state.torque_sent is None else state.torque_sent
        sensed = state.position, state.velocity, state.imu_quaternion, state.imu_gyro, sent
        ratio, h, acting = self._run(cycle, level, row, *sensed, *self._tables)
        self.statistics.count(cycle, ratio, h, acting)
        self._command.outside = self._w < 1.0 and h < 0.0
        return self._command

    def _move_to_start(self, state: State, cycle: int) -> Command:
        """Move along a quintic from rest at the pose of `reset` to the first pose and speed of the gait, baseline only."""
        x, duration = cycle / self._startup_cycles, self.config.startup
        row, n = self._start_row, len(JOINTS)
        first = self._nominal[RIGHT][0]
        gap, speed = first[:n] - self._start_pose, first[n:]
        row[:n] = self._start_pose + gap * (x**3 * (10.0 - 15.0 * x + 6.0 * x * x))
        row[:n] += speed * (duration * x**3 * (-4.0 + 7.0 * x - 3.0 * x * x))
        row[n:] = gap * (30.0 * x * x * (1.0 - x) ** 2 / duration) + speed * (x * x * (-12.0 + 28.0 * x - 15.0 * x * x))
        torque = self._pid.update(row, state.position, state.velocity, state.torque_sent)
        torque += self._gravity.torque(state.position, state.imu_quaternion[_PELVIS].tolist())
        hand_over(self._step, cycle, torque, self._last, self._carried, self._blend)
        self.telemetry[:n] = row[:n]
        return self._command

    def _change_step(self, state: State, stance: int) -> None:
        self._changed_at, self._stance = state.cycle, stance
        self._command.step = (self._command.step or 0) + 1
        config, n = self.config, len(JOINTS)
        xi = min(1.0, max(0.0, state.assistance_factor))
        self.statistics.factors.add(xi)
        self._w = baseline_share(xi, config.fade)
        leg = _LEG if stance == LEFT else 0
        self._share.fill(1.0)
        self._share[[leg + _SH, leg + _SK]] = self._w
        self._pid.start_step(stance, self._share)

        nominal, deviation, rate = self._nominal[stance], self._deviation, self._rate
        np.subtract(state.position, nominal[0, :n], out=deviation[:n])
        np.subtract(state.velocity, nominal[0, n:], out=rate[:n])
        deviation[n:], rate[n:] = deviation[:n], rate[:n]
        np.multiply(self._basis[0], deviation, out=self._added[0])
        np.multiply(self._basis[1], rate, out=self._added[1])
        np.add(self._added[0], self._added[1], out=self._added[0])
        np.add(nominal[: self._fading], self._added[0], out=self._reference[stance][: self._fading])

        hip, knee = leg + _SH, leg + _SK
        deviations, rates = (float(deviation[hip]), float(deviation[knee])), (float(rate[hip]), float(rate[knee]))
        self.guide = self.guide_at(xi)
        self.guide.start_step(xi, deviations, rates)
        self._tables = (*self._kept, *self.guide.tables)
        largest = config.hand_over
        exceeded = max(map(abs, deviations)) > largest.deviation or max(map(abs, rates)) > largest.rate
        if exceeded and self.statistics.steps:
            self.statistics.hand_overs_exceeded += 1
        if config.flat_foot:
            self._feet.start_step(state, 1 - stance)
        step = self._step[0]
        if not step["carry"]:
            self._last[:] = self._pid.torque
        step["stance"], step["completed"], step["carry"] = stance, self.statistics.steps, True
        step["xi"], step["share"], step["intensity"] = xi, self._w, intensity(xi)
