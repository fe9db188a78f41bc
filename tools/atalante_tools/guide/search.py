"""Search for the worst push on the ideal plant: `guide, limits of the push -> push with the largest |e| / q_bound`.

|e| / q_bound is the tracking error e of a joint, divided by the distance q_bound from the desired angle to the edge of the guide.
A joint with a ratio above 1 is outside the guide.

The search uses the equation of motion, but not the control law. The search has three stages:

1. *Guesses.* Constant pushes. Pushes that follow the sign of the error, or of the rate of the error (pumping). Pushes
   that switch at random. Bang-bang pushes. A bang-bang push makes the error of one joint at a chosen time as large as
   possible. At each earlier time, the push has the direction in which an impulse increases this error. The effect of an
   impulse is computed for a linear loop. The stiffness and damping of the loop are identified from the worst step so
   far.
2. *Beam search.* Every 40 ms, each kept push is continued in each of the four `DIRECTIONS`. The pushes with the largest predicted
   deviation are kept.
3. *Local search.* One of the pushes with the largest |e| / q_bound is changed a little: its switching times, its feedback, the
   start of the step, or the condition of the plant. The changed push is kept if it is one of the worst pushes so far.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeVar

import numpy as np

from atalante_hal.types import Vector
from atalante_tools.guide.episode import FEATURES, IdealLeg, Push, Setup, Start, Walked, noise_of
from atalante_tools.guide.plant import Condition, Plant, dynamics

Pair = tuple[float, float]
_Choice = TypeVar("_Choice")

#: The four directions of a push: (sign of the torque at the hip, sign of the torque at the knee).
DIRECTIONS: Final = tuple(itertools.product((1.0, -1.0), repeat=2))
#: A stage of the beam search has `_STAGE` cycles, and keeps the `_BEAM` pushes with the largest predicted deviation.
_STAGE, _BEAM = 40, 6
#: Time over which the beam search extrapolates a tracking error with its current rate [s].
_AHEAD: Final = 0.03
#: Smallest budget with which `search` runs the beam search [simulated steps].
_WITH_BEAM: Final = 1000
#: `_identified` uses a cycle only if |e| / q_bound of hip or knee exceeds `_ACTING` in this cycle.
_ACTING: Final = 0.5
#: Number of worst steps from which the local search chooses the next step to change.
_PARENTS: Final = 6


class Tried(NamedTuple):
    """Walking step that the search has simulated on the plant: inputs and result."""

    ratio: float  # largest |e| / q_bound of the step; above 1: a joint was outside the guide
    kind: str  # origin of the push
    start: Start
    push: Push
    condition: Condition
    noise: int  # seed of the random encoder noise and of the random frame losses
    walked: Walked


@dataclass
class Adversary:
    """Search for the worst push in one guide at one assistance factor.

    Attributes:
        steps: number of simulated steps.
        tried: worst steps so far, the worst first.
    """

    setup: Setup
    leg: IdealLeg
    conditions: Sequence[Condition]
    starts: Sequence[Start]
    seed: int
    steps: int = 0
    tried: list[Tried] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._generator = np.random.default_rng(self.seed)
        self._plants: dict[Condition, Plant] = {c: self.setup.plant(c) for c in self.conditions}

    def search(self, box: Pair, budget: int) -> Tried:
        """Simulate about `budget` steps with pushes up to the limits `box`, and return the worst step.

        Args:
            box: largest push at hip and knee [Nm].
            budget: number of steps.
        """
        self.tried, end = [], self.steps + budget
        for kind, push in itertools.islice(self._guesses(), math.ceil(0.4 * budget)):
            self._try(box, kind, self._any(self.starts), push, self._any(self.conditions), self._number())
        for joint, sign in itertools.product((0, 1), (1.0, -1.0)):
            if budget >= _WITH_BEAM and end - self.steps > 0.5 * budget:
                self._beam(box, joint, sign)
        while self.steps < end:
            self._mutate(box)
        return self.tried[0]

    def leaving_factor(self, box: Pair, largest: float, budget: int) -> float | None:
        """Search for the smallest factor for which a push up to the limits `factor * box` moves a joint out of the guide.

        Example: the factor is 1.5 if a push up to the limits `1.5 * box` moves a joint out of the guide. The factor grows until
        the search finds such a push. A bisection then makes the factor accurate to 5 %. Return None if the search finds no such
        push up to the limits `largest * box`.

        Args:
            box: push limits at hip and knee for the factor 1 [Nm].
            largest: largest factor to try.
            budget: number of steps per factor.
        """
        inside, outside = 1.0, None
        factor = 1.25
        while outside is None:
            if self._leaves(box, factor, budget):
                outside = factor
            elif factor >= largest:
                return None
            else:
                inside, factor = factor, min(largest, 1.3 * factor)
        while outside / inside > 1.05:
            factor = (inside * outside) ** 0.5
            if self._leaves(box, factor, budget):
                outside = factor
            else:
                inside = factor
        return outside

    def _leaves(self, box: Pair, factor: float, budget: int) -> bool:
        """Return whether the search finds a push up to the limits `factor * box` that moves a joint out of the guide.

        The search begins with the worst pushes so far.
        """
        larger, known, end = (factor * box[0], factor * box[1]), self.tried, self.steps + budget
        self.tried = []
        for one in known:
            if self._try(larger, one.kind, one.start, one.push, one.condition, one.noise).ratio > 1.0:
                break
        while self.steps < end and self.tried[0].ratio <= 1.0:
            self._mutate(larger)
        return self.tried[0].ratio > 1.0

    # -- one step ----------------------------------------------------------------------------------------------------

    def _try(self, box: Pair, kind: str, start: Start, push: Push, condition: Condition, noise: int) -> Tried:
        numbers = noise_of(self.leg.cycles, condition, np.random.default_rng(noise))
        walked = self.leg.walk(self._plants[condition], start, push, box, numbers)
        self.steps += 1
        one = Tried(walked.ratio, kind, start, push, condition, noise, walked)
        # A step with exactly the same ratio as a stored step is the same step, so it is not stored again.
        if all(one.ratio != other.ratio for other in self.tried):
            self.tried.append(one)
        self.tried.sort(key=lambda other: -other.ratio)
        del self.tried[4 * _PARENTS :]
        return one

    def _any(self, choices: Sequence[_Choice]) -> _Choice:
        return choices[int(self._generator.integers(len(choices)))]

    def _number(self) -> int:
        return int(self._generator.integers(1 << 32))

    # -- candidate pushes --------------------------------------------------------------------------------------------

    def _guesses(self) -> Iterator[tuple[str, Push]]:
        """Yield pushes of all kinds in turn."""
        cycles = self.leg.cycles + 1
        kinds = [self._constant(cycles), self._following(cycles), self._switching(cycles), self._bang_bang(cycles)]
        while True:
            for kind in kinds:
                yield next(kind)

    def _constant(self, cycles: int) -> Iterator[tuple[str, Push]]:
        for direction in itertools.cycle(DIRECTIONS):
            yield "constant", Push(np.tile(direction, (cycles, 1)), _no_feedback())

    def _following(self, cycles: int) -> Iterator[tuple[str, Push]]:
        """Yield pushes whose sign depends on the current tracking errors and error rates.

        First, the push follows the tracking error of one joint, its rate, or both. Then, without end, the push follows a random
        linear combination of the errors and error rates of both joints.
        """
        for joint, (error, rate) in itertools.product((0, 1), ((0.0, 1.0), (1.0, 0.0), (1.0, 1.0))):
            # Try both signs of the push at the joint `1 - joint`, because the mass matrix couples hip and knee.
            for other in (-1.0, 1.0):
                feedback = np.zeros((2, FEATURES))
                for i in range(2):
                    feedback[i, [joint, 2 + joint]] = np.array([error, rate]) * (1.0 if i == joint else other)
                yield "pumping" if rate else "outwards", Push(np.full((cycles, 2), 1e-6), feedback)
        while True:
            feedback = self._generator.standard_normal((2, FEATURES))
            bias = self._generator.standard_normal(2) * 0.3
            yield "feedback", Push(np.tile(bias, (cycles, 1)), feedback)

    def _switching(self, cycles: int) -> Iterator[tuple[str, Push]]:
        """Yield pushes whose sign changes at random times, at hip and knee separately or at both joints together."""
        while True:
            signs, slowest = np.ones((cycles, 2)), float(self._generator.choice([15.0, 40.0, 100.0, 250.0]))
            together = self._generator.random() < 0.5
            for joint in range(2):
                lengths = 5 + self._generator.exponential(slowest, cycles // 5)
                switches = np.searchsorted(np.cumsum(lengths), np.arange(cycles))
                signs[:, joint] = 1.0 - 2.0 * (switches % 2)
            if together:
                signs[:, 1] = signs[:, 0] * self._generator.choice([-1.0, 1.0])
            yield "switching", Push(signs * self._generator.choice([-1.0, 1.0]), _no_feedback())

    def _bang_bang(self, cycles: int) -> Iterator[tuple[str, Push]]:
        """Yield pushes that make the tracking error of a random joint as large as possible in a random cycle.

        The effect of a push is predicted for a linear loop, see `_impulse_signs`. The loop has 0, 30, 60 or 100 % of the
        identified stiffness and damping.
        """
        while True:
            joint, sign = int(self._generator.integers(2)), float(self._generator.choice([-1.0, 1.0]))
            end, share = int(self._generator.integers(30, cycles)), float(self._generator.choice([0.0, 0.3, 0.6, 1.0]))
            stiffness, damping = self._identified()
            signs = self._impulse_signs(joint, end, share * stiffness, share * damping)
            yield (
                "bang-bang",
                Push(sign * np.concatenate([signs, np.tile(signs[-1:], (cycles - end, 1))]), _no_feedback()),
            )

    def _impulse_signs(self, joint: int, end: int, stiffness: Vector, damping: Vector) -> Vector:
        """Predict whether a torque in a single cycle raises or lowers the error in the later cycle `end`.

        Args:
            joint: joint with the error: 0 for the hip, 1 for the knee.
            end: cycle in which the error is predicted.
            stiffness: stiffness of the linear loop, shape (2, 2) [1/s2].
            damping: damping of the linear loop, shape (2, 2) [1/s].

        Returns:
            1 if a positive torque in one cycle raises the error, -1 if the torque lowers the error. Shape (end, 2): the row is
            the cycle of the torque, the column is the joint on which the torque acts (hip, knee).
        """
        step = np.block([[np.eye(2), 1e-3 * np.eye(2)], [-1e-3 * stiffness, np.eye(2) - 1e-3 * damping]])
        gain, signs = np.zeros(4), np.empty((end, 2))
        gain[joint] = 1.0
        knees = self.leg.nominal[0][:, 1]
        plant = self._plants[self.conditions[0]]
        for cycle in range(end - 1, -1, -1):
            signs[cycle] = gain[2:] @ _inverse(plant, float(knees[cycle]))
            gain = gain @ step
        return np.where(signs >= 0.0, 1.0, -1.0)

    def _identified(self) -> tuple[Vector, Vector]:
        """Identify stiffness and damping of the controlled leg from the worst step so far.

        Returns:
            Stiffness [1/s2] and damping [1/s], each of shape (2, 2). The row is the joint that is accelerated, the column is the
            joint with the error (hip, knee). All elements are zero before the first step, and if the worst step has fewer than
            40 usable cycles.
        """
        if not self.tried:
            return np.zeros((2, 2)), np.zeros((2, 2))
        one = self.tried[0]
        log, goal, plant = one.walked.log, self.leg.goal(one.start), self._plants[one.condition]
        rows = np.flatnonzero(np.abs(log[:, 2:4]).max(axis=1) > _ACTING)
        if len(rows) < 40:
            return np.zeros((2, 2)), np.zeros((2, 2))
        states, gained = np.hstack([log[rows, :2], log[rows, 8:10], np.ones((len(rows), 1))]), []
        for row in rows:
            q, qd = goal.q[row] + log[row, :2], goal.qd[row] + log[row, 8:10]
            bias = dynamics(plant, q[0], q[1], qd[0], qd[1])[3:]
            gained.append(_inverse(plant, float(q[1])) @ (log[row, 6:8] - bias) - self.leg.nominal[2][row])
        fit = np.linalg.lstsq(states, np.array(gained), rcond=None)[0]
        return -fit[:2].T, -fit[2:4].T

    # -- beam and local search ---------------------------------------------------------------------------------------

    def _beam(self, box: Pair, joint: int, sign: float) -> None:
        """Search for the push that moves a joint farthest to one side. Each stage tries all directions of the push."""
        cycles, start, condition = self.leg.cycles + 1, self._any(self.starts), self._any(self.conditions)
        noise, kept = self._number(), [np.ones((cycles, 2))]
        for begin in range(0, cycles, _STAGE):
            ahead: list[tuple[float, Vector]] = []
            for signs, direction in itertools.product(kept, DIRECTIONS):
                longer = signs.copy()
                longer[begin:] = direction
                one = self._try(box, "beam", start, Push(longer, _no_feedback()), condition, noise)
                at = min(begin + _STAGE, cycles - 1)
                log = one.walked.log[at]
                ratio, rate = log[2 + joint], log[8 + joint] / self.leg.bounds[joint, at].min()
                ahead.append((float(sign * (ratio + _AHEAD * rate)), longer))
            ahead.sort(key=lambda pair: -pair[0])
            kept = [signs for _, signs in ahead[:_BEAM]]

    def _mutate(self, box: Pair) -> None:
        """Change one of the worst steps slightly at random, and simulate the changed step."""
        generator, cycles = self._generator, self.leg.cycles + 1
        parent = self.tried[int(generator.integers(min(_PARENTS, len(self.tried))))]
        start, push, condition, noise = parent.start, parent.push, parent.condition, parent.noise
        signs, feedback = push.signs.copy(), push.feedback.copy()
        change = generator.random()
        if change < 0.2:
            start = self._any(self.starts)
        elif change < 0.35:
            condition, noise = self._any(self.conditions), self._number()
        elif feedback.any() and change < 0.7:
            feedback += 0.3 * generator.standard_normal(feedback.shape)
        else:
            # Only planned signs (`Push.signs`) can be changed below. If the push has feedback, its signs depend on the motion.
            # In this case, first replace `signs` with the signs of the push in the parent step, and remove the feedback.
            if feedback.any():
                signs, feedback = np.where(parent.walked.log[:, 4:6] >= 0.0, 1.0, -1.0), _no_feedback()
            begin, length = int(generator.integers(cycles)), int(1 + generator.exponential(30.0))
            joints = [[0], [1], [0, 1]][int(generator.integers(3))]
            if generator.random() < 0.5:
                signs[np.ix_(range(begin, min(cycles, begin + length)), joints)] *= -1.0
            else:
                signs[:, joints] = np.roll(signs[:, joints], int(generator.integers(-20, 21)), axis=0)
        self._try(box, parent.kind, start, Push(signs, feedback), condition, noise)


def _no_feedback() -> Vector:
    return np.zeros((2, FEATURES))


def _inverse(plant: Plant, knee: float) -> Vector:
    """Return the inverse of the mass matrix at a knee angle, shape (2, 2)."""
    m11, m12, m22, _, _ = dynamics(plant, 0.0, knee, 0.0, 0.0)
    return np.array([[m22, -m12], [-m12, m11]]) / (m11 * m22 - m12 * m12)
