r"""Guide certificate: the disturbance torques that cannot move a joint out of a guide. `guide filter -> Certificate`.

**The promise.** Both joints stay inside the guide while disturbance torques of at most `hip` Nm act on the sagittal hip (SH) and
at most `knee` Nm on the sagittal knee (SK), at the same time and in any direction. The friction of the leg may differ from the
model by 20 %, and the mass and inertia of the leg by 10 %. The loop may have one more cycle of delay than the model. The step may
start with any deviation inside the hand-over box (`HandOver`). The promise does not cover a step that starts outside this box.
The controller compares each start with the box and counts these steps. The running filter is built for exactly this promise.

**Why the promise holds.** A prediction starts at the true state of the leg, under the backup policy and the worst of these
disturbances. Let r be the largest ratio of error to width in this prediction, and h = 1 - r^2. Three conditions are
sufficient.

1. *Start.* Re-centring sets the error to zero at the start of a step. In every cycle, the error that can arise since the start
   must be below the width. Disturbances, the torque jump at the stance change and the unknown part of the velocity cause this
   error. So h is at least 0 at the start. The jump acts completely until the first new command arrives, up to two cycles later.
   Then it decreases to the added torque as fast as the limiter permits. Apart from this decrease, the limiter does not act, and
   the drives do not saturate, because the same condition bounds the predicted torque and speed.
2. *Backup.* If the gate is 1, the leg follows the backup policy. Then h does not fall, because all disturbances in the
   prediction of the next cycle are already in the current prediction. Each new prediction adds one cycle at the end of
   the horizon. This cycle must not be the worst cycle. At the end of the horizon the free motion has decayed. The error
   in the added cycle therefore follows from the errors in earlier cycles of the prediction. This error must be smaller than
   the width minus the effect of the disturbances. The next prediction compares the error in the added cycle with the narrowest
   place of the following cycles, not with the width. The tests check that the error is smaller than this, too, in the shapes
   `constant`, `widening`, `narrowing` and `asymmetric`. In the shape `pinched` with an assistance factor up to 0.75 it is not, so
   condition 2 is not proved there, and only `atalante guide check` supports it.
3. *Gate.* Let g be the effect that one cycle without backup torque has on r. Near h = 0 the gate is at least 1 - 3 h. A
   cycle with this gate lowers 1 - r by at most 6 g (1 - r). So r stays below 1 if 6 g is at most 1. If the intensity of u_i
   or u_f is below 1, the torque that is not compensated in this cycle is part of g. The tests check that 6 g is at most 1
   for the shape `constant`, at zero intensities. In the other shapes of the package 6 g reaches 1.4 if the smallest width of
   a step is taken as the width. This estimate is too large by an unknown factor, because these guides are wider in most
   cycles. For these shapes condition 3 is not proved. Condition 3 is supported only by `atalante guide check`, which
   searches for pushes that break a promise.

The filter does not know the true state, so it uses bounds. Errors of inertia and delay change the rows of the prediction
(`Prediction.slack`), and the measured velocity lags behind the true velocity (part of `Prediction.reach`). So the h of the
filter is at most the true h, and the gate is at least as large as the proof requires.

All bounds are linear in the promise. The largest possible promise is therefore a multiple of the requested promise. The certified
promise is the smaller of the largest possible and the requested promise. The certified promise does not depend on the
intensities of idealization u_i and feedforward u_f. The backup torque includes u_i and u_f completely, so conditions 1
and 2 do not depend on the intensities. A torque that is not compensated acts only while the gate is below 1, so it
affects only condition 3. At zero intensities this torque increases 6 g by less than 0.2 in each shape of the package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from atalante_control.guide.filter import GuideFilter, tail
from atalante_control.guide.kernel import START_CYCLES
from atalante_control.guide.prediction import SIZES
from atalante_hal.types import Vector

Pair = tuple[float, float]

_JOINTS = ("SH", "SK")
#: Smallest disturbance torque at the hip that is certified [Nm]. If only a smaller one is possible, no torques are certified.
SMALLEST = 1.0


@dataclass(frozen=True)
class JointTorque:
    """Disturbance torques that may act on hip and knee at the same time, in any direction."""

    hip: float  # Nm, at SH
    knee: float  # Nm, at SK


class Limit(NamedTuple):
    """Condition of the guide certificate, with the largest disturbance torques that meet the condition.

    The guide is certified for the requested disturbance torques of hip and knee, or for smaller torques in the same ratio.
    """

    #: Ratio of the largest allowed disturbance torques to the requested disturbance torques.
    #: The ratio is negative if the condition fails even without disturbance torques.
    #: Example: if 30 and 18 Nm are requested at hip and knee, a `scale` of 0.8 allows 24 and 14.4 Nm.
    scale: float
    what: str  # condition in words, for a message


@dataclass(frozen=True)
class Certificate:
    """Result of the certification of a guide: the disturbance torques under which both joints stay inside the guide."""

    shape: str
    xi: float
    certified: bool  # False if no disturbance torques are certified
    reason: str  # sentence that states what limits the certified torques, or why there are none
    #: certified disturbance torques, which the running filter assumes; None if no torques are certified
    promise: JointTorque | None
    #: Largest disturbance torques that meet all conditions with the gains of the guide filter; at least as large as `promise`.
    #: None if no torques are certified.
    largest: JointTorque | None
    #: smallest fraction of the guide width that remains free under the certified torques; -inf if no torques are certified
    margin: float


class PromiseLimits:
    """Conditions that a guide filter must meet for a certificate: limits of errors, torques, speeds and torque rates.

    The conditions on torques, speeds and torque rates do not depend on the assistance factor, so they are computed once.
    """

    def __init__(self, guide: GuideFilter) -> None:
        """Compute the conditions that do not depend on the assistance factor: torque, speed and torque rate of the drives.

        Args:
            guide: filter with shape, gains and gait; it is not changed.
        """
        self._guide = guide
        prediction, config, steps = guide.prediction, guide.config, guide.cycles
        leg, box, start = prediction.leg, prediction.assumptions.hand_over, prediction.start
        _, slopes, curvatures = leg.deadbeat.basis(leg.time)
        torque = np.abs(prediction.torque) + np.abs(prediction.mass).sum(axis=2) * box.largest(curvatures)[:, None]
        speed = np.abs(leg.qd) + box.largest(slopes)[:, None]
        fading = -np.diff(box.added(guide.blend), axis=0, append=0.0)[: len(speed) - 1]
        room = np.full_like(speed, config.rate_limit)
        room[1 : len(fading) + 1] -= fading
        self._of_drives = [
            _limit(
                config.torque_limit - torque,
                start.torque,
                steps,
                f"the backup torque reaches {config.torque_limit:g} Nm at",
            ),
            _limit(
                config.speed_limit - speed, start.speed, steps, f"the speed reaches {config.speed_limit:g} rad/s at"
            ),
            _limit(
                config.worst_speed_limit - speed,
                start.worst_speed,
                steps,
                f"with errors of the model, the speed reaches {config.worst_speed_limit:g} rad/s at",
            ),
            _limit(
                room,
                start.change,
                steps,
                "the backup torque changes too fast at",
            ),
        ]
        self._horizon = _Horizon(guide)

    def at(self, xi: float) -> list[Limit]:
        """Return the conditions at an assistance factor, sorted from the strictest to the weakest.

        Args:
            xi: assistance factor in [0, 1].
        """
        guide, horizon = self._guide, self._horizon.cycles
        width = guide.widths(xi)
        narrowest = 1.0 / tail(1.0 / width)
        room = np.concatenate([width[:horizon], narrowest[horizon:]])
        too_narrow = _limit(room, guide.prediction.start.error, guide.cycles, "the guide is too narrow at")
        found = [too_narrow, *self._of_drives, self._horizon.limit(width, narrowest, following=width)]
        return sorted(found, key=lambda limit: limit.scale)

    def largest(self, xi: float) -> float:
        """Return the largest torques that can be certified, as a multiple of the requested torques.

        The result is at most 0 if no torques can be certified.

        Args:
            xi: assistance factor in [0, 1].
        """
        return self.at(xi)[0].scale

    def certificate(self, xi: float, promise: float) -> Certificate:
        """Return the certificate of the guide at an assistance factor.

        Args:
            xi: assistance factor in [0, 1].
            promise: promise for which the filter is built, as a fraction of the requested promise.
        """
        guide, strictest = self._guide, self.at(xi)[0]
        chosen = np.array(guide.prediction.assumptions.promise)
        largest = _pair(strictest.scale * chosen)
        made = _pair(min(promise, strictest.scale) * chosen)
        if made is None:
            why = strictest.what if chosen[0] >= SMALLEST else f"the requested torque is {chosen[0]:g} Nm"
            text = f"no promise of {SMALLEST:g} Nm or more at the hip: {why}; the robot may leave the guide"
            return Certificate(guide.shape.name, xi, False, text, None, None, -math.inf)
        start, width = guide.prediction.start.error, guide.widths(xi)
        used = ((start[:, :2] + promise * start[:, 2:]) / width)[: guide.cycles + 1]
        return Certificate(
            guide.shape.name, xi, True, f"limit: {strictest.what}", made, largest, 1.0 - float(used.max())
        )


def _pair(torque: Vector) -> JointTorque | None:
    """Return the torques rounded down to 0.01 Nm; None if the hip torque is below `SMALLEST`."""
    hip, knee = (np.floor(100.0 * torque + 1e-9) / 100.0).tolist()
    return JointTorque(hip, knee) if hip >= SMALLEST else None


def _limit(room: Vector, reach: Vector, steps: int, what: str) -> Limit:
    """Compute the disturbance torques at which the tracking error, torque, speed or torque change of a joint reaches its limit.

    The quantity is the tracking error, the torque, the speed or the torque change of SH and SK. The model errors use up a part
    of the room below the limit. The disturbance torques may use the rest. `Limit.scale` is therefore
    (room - effect of the model errors) / (effect of the requested torques), in the worst cycle and for the worse joint. The
    message `Limit.what` names this cycle and this joint.

    Args:
        room: limit minus the value of the quantity without disturbances, for SH and SK in each cycle, shape (n, 2).
        reach: largest change of the quantity in each cycle, shape (n, 4). Columns 0 and 1: SH and SK, due to the model errors.
            Columns 2 and 3: SH and SK, due to the requested disturbance torques.
        steps: number of cycles of a step. The cycles 1 to `steps` are checked.
        what: start of the message; joint and phase are appended.
    """
    budget, promise = reach[1 : steps + 1, :2], reach[1 : steps + 1, 2:]
    scales = (room[1 : steps + 1] - budget) / np.maximum(promise, 1e-12)
    at, joint = np.unravel_index(int(scales.argmin()), scales.shape)
    return Limit(float(scales[at, joint]), f"{what} {(at + 1) / steps:.2f} T ({_JOINTS[joint]})")


class _Horizon:
    """Condition on the tracking error one cycle after the prediction ends: the error must still be inside the guide.

    At the end of the prediction, fast motions have decayed. The error in the next cycle is therefore a factor times the error in
    the last predicted cycle, plus a small remainder. The errors in two earlier predicted cycles determine the remainder.
    The largest possible remainder follows, because all predicted errors are inside the guide.

    The constructor computes three upper bounds of the remainder. Each bound is a weighted sum of the absolute errors in two
    earlier cycles. `limit` uses the bound with the best result.

    Attributes:
        cycles: number of predicted cycles.
    """

    def __init__(self, guide: GuideFilter) -> None:
        prediction = guide.prediction
        self.cycles, self._step = len(prediction.ahead) - 1, guide.cycles
        rows = prediction.ahead @ prediction.compress * SIZES
        beyond = prediction.beyond * SIZES
        # Error in the cycle after the prediction: factor * (error in the last predicted cycle) + remainder.
        self._factor = (beyond * rows[-1]).sum(axis=1) / (rows[-1] ** 2).sum(axis=1)
        remainder = beyond - self._factor[:, None] * rows[-1]
        #: Three upper bounds of abs(remainder). Each bound is described by two predicted cycles and by weights of shape (4, 2).
        #: The bound for hip and knee is `errors @ weights`, shape (2,) [rad].
        #: `errors` contains four absolute errors [rad]: hip and knee in the first cycle, then hip and knee in the second cycle.
        self._remainders: list[tuple[tuple[int, int], Vector]] = []
        for near, far in ((0.1, 0.3), (0.25, 0.5), (0.4, 0.7)):
            lags = round(near * self.cycles), round(far * self.cycles)
            inverse = np.linalg.pinv(np.concatenate([rows[lag] for lag in lags]), rcond=1e-9)
            self._remainders.append((lags, np.abs(remainder @ inverse).T))
        self._starts = np.arange(0, max(1, len(prediction.leg.time) - self.cycles - 1), START_CYCLES)
        self._reach = prediction.reach[self._starts // START_CYCLES]

    def limit(self, width: Vector, narrowest: Vector, following: Vector) -> Limit:
        """Compute the disturbance torques that move a joint to the bound of the guide in the first cycle after the prediction.

        The next error is the error one cycle after the last predicted cycle. `scale` is the ratio of the computed torques to the
        requested torques.

        In each cycle, the error without disturbances may be at most `free - scale * used`. Here, `free` is the guide width minus
        the effect of the model errors, and `used` is the effect of the requested torques. In the worst case, the error has this
        largest value in the last predicted cycle and in the two earlier cycles. Then the next error is at most

            factor * (last_free - scale * last_used) + (early_free - scale * early_used) @ weights

        This value must be at most `next_free - scale * next_used`. With `scale` on the left side only, the condition is
        `scale * need <= have`, where

            have = next_free - factor * last_free - early_free @ weights
            need = next_used - factor * last_used - early_used @ weights

        Args:
            width: distance from q_des to the nearer bound of the guide in each cycle, shape (n, 2) [rad].
            narrowest: largest allowed error if the prediction ends in the cycle, shape (n, 2) [rad], see `filter.tail`.
            following: largest allowed error in the cycle after the last predicted cycle, shape (n, 2) [rad].
        """

        def parts(lag: int) -> tuple[Vector, Vector]:
            """Return the arrays `free` and `used` for the cycle that is `lag` cycles after the start of a prediction.

            `free`: largest allowed error minus the tracking error that the model errors can cause.
            `used`: tracking error that the requested disturbance torques can cause.
            Both have the shape (starts, 2) [rad]. Row i: prediction that starts in cycle `self._starts[i]`. Columns: SH, SK.
            """
            added = self._reach[:, min(lag, self.cycles)]
            widths = width if lag < self.cycles else narrowest if lag == self.cycles else following
            return widths[np.minimum(self._starts + lag, len(widths) - 1)] - added[:, :2], added[:, 2:]

        (last_free, last_used), (next_free, next_used) = parts(self.cycles), parts(self.cycles + 1)
        found = []
        for lags, weights in self._remainders:
            early_free, early_used = (np.hstack(pair) for pair in zip(*map(parts, lags), strict=True))
            have = next_free - self._factor * last_free - early_free @ weights
            need = next_used - self._factor * last_used - early_used @ weights
            with np.errstate(divide="ignore"):
                scales = np.where(need > 0.0, have / np.maximum(need, 1e-12), np.where(have >= 0.0, np.inf, -1.0))
            found.append(scales.min(axis=1))
        best = np.max(found, axis=0)
        at = int(best.argmin())
        return Limit(float(best[at]), f"the horizon is too short at {at * START_CYCLES / self._step:.2f} T")
