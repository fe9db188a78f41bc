"""The controller of the paper, for an exoskeleton that hangs by its pelvis: `State -> Command`, once a cycle.

    step switch -> q_des = q_nom + s -> PID, gravity, flat foot -> u_t --------------------------.
                                     -> idealization u_i, feedforward u_f, virtual guide u_v ->  merge -> u
                                     -> haptics

Steps alternate right and left stance and change by time: in the air nothing is hit. The swing leg's SH and SK get the
assistive torque, every other joint the baseline torque. What the paper leaves open is settled so:

- *Assistance factor.* Xi is taken over at step changes alone, where the state is re-centred and the torque handed over:
  no guide ever moves under a joint inside a step, so the certificate of each step stays true, whatever the operator does.
- *Xi towards 1.* The assisted joints get w u_t + (1 - w) (u_i + u_f + u_v), with w a smoothstep from 0 at Xi = 0.9 to
  exactly 1 at Xi = 1: there it is the baseline torque to the last bit. Their integrals take the same share w.
  No guide is certified for Xi between 0.9 and 1.
- *Gains.* A stiff backup policy holds a narrow guide, and in a wide one asks for more torque than there is. Each step takes
  the gentlest of a few gains with which its guide is certified, with a margin, at its Xi; the command is continuous in Xi but
  where they change.
- *Hand-over.* At a step change the deadbeat takes the tracking error to zero at once, a leg changes from one law to the
  other, and the horizon jumps back to T. The torque that would jump is carried over and faded out in `blend`: the
  command is continuous. This is part of the baseline, and the same with and without assistance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

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
from atalante_hal.types import Command, State

Vector = npt.NDArray[np.float64]
Pair = tuple[float, float]

_LEG = len(LEG_JOINTS)
_SH, _SK, _SA = (LEG_JOINTS.index(joint) for joint in ("SH", "SK", "SA"))
_PELVIS = IMUS.index("pelvis")


@dataclass(frozen=True)
class AirwalkConfig:
    """Everything that may be chosen.

    Raises:
        ValueError: a number out of range.
    """

    gains: PidGains = AIR_GAINS
    friction: Friction = field(default_factory=Friction)
    alpha: float = 0.4  # of a step, until the deadbeat has met the nominal
    guide_rate: Pair = (28.0, 44.0)  # rad/s, natural frequency of the stiffest backup policy on SH and SK
    gentler: tuple[float, ...] = (0.5, 0.7)  # parts of it to be tried first, rising
    guide_margin: float = (
        0.25  # part of the guide that has to be left where it is tightest, for gentler gains to be taken
    )
    guide_damping: float = 1.05  # damping ratio; 1 and above is monotone
    # Nm, u_ext of SH and SK as separate inertias (see `certificate`). In PyBullet, coupling to the other joints, delay and
    # friction left over came to 14 and 20 Nm in 95 % of the cycles; friction a fifth off, to 43 and 26 Nm.
    disturbance: tuple[Pair, Pair] = ((-30.0, 30.0), (-20.0, 20.0))
    points: int = 100  # intervals of the horizon grid
    overlap: float = 0.1  # s, horizon past the step's end
    zeta: float = 0.01  # s, derivative gain of the guide
    hand_over: HandOver = field(default_factory=HandOver)
    decoupled: bool = True  # SH and SK through their common mass matrix; False: u_v on its own joint, as printed
    feedforward: bool = False  # u_f of the gait on the assisted joints; off in the air
    flat_foot: bool = True
    ankle_offset: float = math.radians(1.0)  # rad, on both sagittal ankles
    fade: float = 0.9  # Xi from which the baseline takes over
    startup: float = 2.0  # s, from the measured pose to the gait's first
    blend: float = 0.03  # s, in which a torque step at the step change fades out
    active: float = 0.05  # gate above which the filter counts as acting

    def __post_init__(self) -> None:
        for name in ("startup", "blend"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= PERIOD):
                raise ValueError(f"{name} is at least one cycle ({PERIOD} s), not {getattr(self, name)!r}")
        if not 0.0 <= self.fade < 1.0:
            raise ValueError(f"fade is an assistance factor in [0, 1), not {self.fade!r}")
        if not (min(self.guide_rate) > 0.0 and self.guide_damping > 0.0):
            raise ValueError("guide_rate and guide_damping are positive")
        if list(self.gentler) != sorted(self.gentler) or not all(0.0 < part < 1.0 for part in self.gentler):
            raise ValueError(f"gentler are parts of guide_rate between 0 and 1, rising, not {self.gentler!r}")


def baseline_share(xi: float, fade: float) -> float:
    """w(Xi): 0 up to `fade`, smoothstep to exactly 1 at Xi = 1."""
    x = (xi - fade) / (1.0 - fade)
    return 0.0 if x <= 0.0 else 1.0 if x >= 1.0 else x * x * (3.0 - 2.0 * x)


class AirwalkController:
    """The controller. It implements `atalante_hal.types.Controller`.

    Attributes:
        guide: the virtual guide filter of this step, one of `guides`, which are the gentlest first.
        statistics: since `reset`.
        telemetry, telemetry_fields: for the recording, see `telemetry.TELEMETRY`.
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
        """Prepare every table; nothing is allocated in the loop.

        Raises:
            GaitError: the gait leaves a limit of the robot or cannot be repeated, see `hanging.check_hung`.
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
        #: Rows (q_nom, q_nom') of a step; the working copy gets the deadbeat.
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
        self._basis = np.zeros((2, self._fading, 2 * n))  # of s(0) and s'(0): added to the rows
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
        #: Assistance factor up to which each but the stiffest is taken.
        self._taken_to = [largest_assistance(guide, config.guide_margin, config.hand_over) for guide in gentler]

        ramp = np.arange(round(config.blend / PERIOD)) * (PERIOD / config.blend)
        self._blend: Vector = 0.5 + 0.5 * np.cos(math.pi * ramp)
        self._startup_cycles = round(config.startup / PERIOD)

        self._last, self._carried, self._share = np.zeros(n), np.zeros(n), np.ones(n)
        self._start_pose, self._start_row = np.zeros(n), np.zeros(2 * n)
        self._deviation, self._rate, self._added = np.zeros(2 * n), np.zeros(2 * n), np.zeros_like(self._basis)
        self._command = Command(self._pid.torque, np.zeros(len(MOTORS)))
        told = np.zeros(1, TELEMETRY)
        self.telemetry = told.view(np.float64)
        self._step = np.zeros(1, STEP)
        self._step["cycles"], self._step["acting"] = self._cycles, config.active
        pid, feet, law = self._pid, self._feet, law_of(config.friction, self._inertia, config.decoupled)
        #: What `kernel.run` works on from `steps` on, but for the guide of the step, which comes last.
        self._kept: tuple[Any, ...] = (
            self._step, feet.ankles, feet.cubics, self._gravity.links, np.zeros(n),
            pid.gains, pid.limit, pid.integral, pid.torque, np.ascontiguousarray(uf), law,
            self._last, self._carried, self._blend, self._command.vibration, told,
        )  # fmt: skip
        self._run = compiled(run)
        self._tables: tuple[Any, ...] = (*self._kept, *self.guide.tables)
        still, attitudes, gyros = self._start_pose, np.zeros((len(IMUS), 4)), np.zeros((len(IMUS), 3))
        self._run(0, False, self._start_row, still, still, attitudes, gyros, still, *self._tables)
        self.statistics = AirwalkStatistics()
        self._forget()

    def guide_at(self, xi: float) -> GuideFilter:
        """The guide of the steps at an assistance factor: the gentlest certified there with `guide_margin`, or the stiffest."""
        return next(
            (guide for guide, to in zip(self.guides, self._taken_to, strict=False) if xi <= to), self.guides[-1]
        )

    def certificate(self, xi: float) -> Certificate:
        """Return what the filter of the steps at an assistance factor is built for, and whether its guide is certified.

        It is not where the certificate's law is not the one that runs: while the baseline fades in, at Xi = 1 and with
        `AirwalkConfig.decoupled` off.
        """
        config = self.config
        certificate = certify(self.guide_at(xi), xi, config.hand_over, self._inertia)
        share = baseline_share(xi, config.fade)
        if share == 1.0:
            reason = "at Xi = 1 the baseline controller drives every joint alone"
        elif share > 0.0:
            reason = f"fade: between Xi {config.fade:g} and 1 the baseline is blended in, which the certificate does not cover"
        elif not config.decoupled:
            reason = "hip and knee are coupled (decoupled=False), and the certificate is that of separate inertias"
        else:
            return certificate
        return replace(certificate, certified=False, reason=reason, joint_torque=None)

    def reset(self, state: State) -> None:
        """Start from where the joints are, and from the torque they have."""
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
        """Backup gains, gentlest first, for the inertia the swing leg shows along the step, and the torque left for them."""
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
        """u_f of the swing leg's SH and SK, meant for the separate inertias: Bezier control points (2, 8) [Nm].

        The gait's own is meant for the coupled pair: it is taken through the mass matrix along the nominal and fitted.
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
        """One cycle: the step switch, then everything else in machine code (`kernel.run`)."""
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
        """Quintic from rest at the pose of `reset` to the gait's first pose and speed, by the baseline alone."""
        x, duration = cycle / self._startup_cycles, self.config.startup
        row, n = self._start_row, len(JOINTS)
        first = self._nominal[RIGHT][0]
        way, speed = first[:n] - self._start_pose, first[n:]
        row[:n] = self._start_pose + way * (x**3 * (10.0 - 15.0 * x + 6.0 * x * x))
        row[:n] += speed * (duration * x**3 * (-4.0 + 7.0 * x - 3.0 * x * x))
        row[n:] = way * (30.0 * x * x * (1.0 - x) ** 2 / duration) + speed * (x * x * (-12.0 + 28.0 * x - 15.0 * x * x))
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
