"""Findings of the paper, tested on the results of the trials: `results -> one line per finding, with statistic and verdict`.

The limits in this file were chosen before the trials of the documentation ran. The finding `active-vary` was added after these
trials. `active-vary` compares steps at equal phase, because the standard deviation over whole steps (`active-spread`) mostly
measures the shape of the mean trajectory. A finding without results has no verdict.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from atalante_tools.faults.false_alarms import EXPECTED

Result = dict[str, Any]

#: Phases of a step at which `step_variation` compares steps with each other.
#: The last phase is 0.8, because a step with an early landing ends at a phase of about 0.9.
_PHASES: Final = np.linspace(0.1, 0.8, 29)

#: Largest difference of two mean metabolic rates that count as equal, as a fraction of the rate of quiet standing.
SAME: Final = 0.02
STANDING: Final = 1.44  # metabolic rate of quiet standing [W/kg]
#: `TREND`: Some values must fall as the assistance factor rises. Their rank correlation with the factor must be <= -`TREND`.
#: `ASYMMETRY`: On each day of the sweep, the factor falls from 1 to 0 and then rises to 1, so each factor above 0 has two walks.
#: The mean absolute difference between two walks with the same factor must be at most `ASYMMETRY` times the range of all values.
TREND, ASYMMETRY = 0.8, 0.25
#: Largest accepted coefficient of variation of the metabolic rates with full assistance in the walks of a sweep.
VARIATION: Final = 0.05


#: `CERTIFIED` is the smallest accepted share of guides with certified torques (a promise).
#: The certified torques are the disturbance torques up to which the joints stay inside the guide.
#: `ROBUST` is the smallest accepted share of walks of `robustness` in which the robot completes all steps and stands at the end.
CERTIFIED, ROBUST = 0.95, 0.98
#: Largest accepted sideways distance between the robot and its initial walking line at the end of a walk of `protocol` [m].
#: `SIDEWAYS` applies if the heading comes from the gyro alone.
#: `SIDEWAYS_WITH_REFERENCE` applies if the IMUs have a heading reference.
SIDEWAYS, SIDEWAYS_WITH_REFERENCE = 1.5, 0.5
#: Upper limit of the root mean square error of the estimated vertical in each walk [deg].
ATTITUDE: Final = 0.5
#: Push forces [N] that the robot must withstand at every phase of a step. A push lasts 0.2 s.
#: `PUSH_WORST` applies to every direction, `PUSH_FORWARD` to a push forwards.
PUSH_WORST, PUSH_FORWARD = 200.0, 300.0


@dataclass(frozen=True)
class Finding:
    """Claim that is tested on the results of an experiment. The field names are the keys of `--json`."""

    id: str
    claim: str  # statement of the paper or expected property of the robot, in one short sentence
    statistic: str  # measured values and limit
    passed: bool | None  # whether the results agree with the claim; None if results are missing


def shape_findings(results: Sequence[Result]) -> list[Finding]:
    """Return the finding of the experiment `shapes`.

    Args:
        results: results of `shape` trials.
    """
    claim = "in every guide shape, the joints stay inside the bounds"
    ratios = {r["trial"]["shape"]: r["max_ratio"] for r in results if r["outcome"] == "done"}
    if not ratios:
        return [Finding("shapes-contained", claim, "no results", None)]
    worst = max(ratios, key=lambda name: ratios[name])
    inside = sum(ratio <= 1.0 for ratio in ratios.values())
    text = f"{inside} of {len(results)} shapes contained; largest |e|/q_bound {ratios[worst]:.2f} ({worst}), limit 1"
    return [Finding("shapes-contained", claim, text, inside == len(results))]


def assist_findings(results: Sequence[Result]) -> list[Finding]:
    """Return the findings of the experiment `assist`.

    Args:
        results: results of `walk` trials, four for each subject.
    """
    subjects = _by_subject(results)
    return [
        _contained("assist-contained", results),
        _paired(
            "passive-gather", "passive trajectories gather at the guide more than active ones", subjects,
            lambda s: s["passive partial"]["guide"]["outer"], lambda s: s["active partial"]["guide"]["outer"],
            "share of time in the outer half of the guide, passive {a:.2f}, active {b:.2f}",
        ),
        _paired(
            "active-spread", "active trajectories spread over more of the guide than passive ones", subjects,
            lambda s: s["active partial"]["guide"]["spread"], lambda s: s["passive partial"]["guide"]["spread"],
            "standard deviation of e/q_bound, active {a:.3f}, passive {b:.3f}",
        ),
        _paired(
            "active-vary", "active trajectories vary more from step to step than passive ones", subjects,
            lambda s: step_variation(s["active partial"]), lambda s: step_variation(s["passive partial"]),
            "standard deviation of e/q_bound over the steps at equal phase, active {a:.3f}, passive {b:.3f}",
        ),
        _same(
            "passive-flat", "the metabolic rate of passive subjects is the same with full and with partial assistance",
            subjects, "passive partial", "passive full",
        ),
        _paired(
            "active-partial-above", "with partial assistance, active subjects have a higher metabolic rate than passive ones",
            subjects, lambda s: _net(s["active partial"]), lambda s: _net(s["passive partial"]),
            "exercise minus baseline, active {a:+.4f} W/kg, passive {b:+.4f} W/kg",
        ),
        _same(
            "active-full-near-passive", "with full assistance, active subjects have nearly the metabolic rate of passive ones",
            subjects, "active full", "passive full",
        ),
        _paired(
            "active-tracks-better", "with partial assistance, active subjects track the gait better than passive ones",
            subjects, lambda s: s["passive partial"]["error_deg"]["target"],
            lambda s: s["active partial"]["error_deg"]["target"],
            "RMS tracking error, passive {a:.3f} deg, active {b:.3f} deg",
        ),
    ]  # fmt: skip


def sweep_findings(results: Sequence[Result]) -> list[Finding]:
    """Return the findings of the experiment `sweep`.

    Args:
        results: results of `walk` trials of the sweep; results of `treadmill` trials are ignored.
    """
    walks = sorted((r for r in results if _complete(r)), key=lambda r: str(r["trial"]["order"]))
    rate, error = "the normalised metabolic rate rises as Xi falls", "the tracking error rises as Xi falls"
    return [
        _contained("sweep-contained", [r for r in results if r["trial"]["kind"] == "walk"]),
        _trend("sweep-metabolic-trend", rate, walks, normalised, ".3f"),
        _trend("sweep-error-trend", error, walks, lambda r: r["error_deg"]["target"], ".2f"),
        _symmetry("sweep-metabolic-symmetry", "the metabolic rate is symmetric in time about Xi = 0", walks, normalised),
        _symmetry(
            "sweep-error-symmetry", "the tracking error is symmetric in time about Xi = 0", walks,
            lambda r: r["error_deg"]["target"],
        ),
        _baseline(walks),
    ]  # fmt: skip


def protocol_findings(results: Sequence[Result]) -> list[Finding]:
    """Return the findings of the experiment `protocol`.

    Each walk begins with full assistance, continues with a transition, and ends with the assistance factor of the trial.

    The claims are: each walk ends standing, inside the guide and near the line; the guides are certified; no fault is reported;
    the estimated vertical is accurate.

    Args:
        results: results of `walk` trials.
    """
    guided = [r for r in results if r["certified"] is not None]  # with full assistance, there is no guide
    certified, alarms = sum(r["certified"] for r in guided), _alarms(results)
    share = f"{certified} of {len(guided)} guides with a promise, at least {CERTIFIED:.0%} wanted"
    return [
        _contained("protocol-contained", results),
        Finding(
            "protocol-certified", "the guides have a promise", share,
            certified >= CERTIFIED * len(guided) if guided else None,
        ),
        Finding(
            "protocol-diagnostics", "no fault is reported", alarms or "no diagnostic",
            not alarms if results else None,
        ),
        _line(results),
        _attitude(results),
    ]  # fmt: skip


def _line(results: Sequence[Result]) -> Finding:
    """Test whether the robot walks along a line, and return the finding. Robots that fell are left out."""
    reference = any(r["trial"]["heading_reference"] for r in results)
    limit = SIDEWAYS_WITH_REFERENCE if reference else SIDEWAYS
    deviations = [abs(r["true_lateral_m"]) for r in results if r["true_lateral_m"] is not None]
    claim = f"with {'a heading reference' if reference else 'the gyro alone'}, the robot stays near its line"
    if not deviations:
        return Finding("protocol-line", claim, "no walk ended standing", None)
    text = f"largest true deviation {max(deviations):.2f} m in {len(deviations)} walks, limit {limit:g} m"
    return Finding("protocol-line", claim, text, max(deviations) <= limit)


def _attitude(results: Sequence[Result]) -> Finding:
    """Test whether the error of the estimated vertical is below `ATTITUDE` in every walk, and return the finding."""
    errors = [r["attitude_rms_deg"] for r in results if r["attitude_rms_deg"] is not None]
    claim = "the attitude of the pelvis is known"
    if not errors:
        return Finding("protocol-attitude", claim, "no robot walked", None)
    text = f"largest RMS error of a walk {max(errors):.2f} deg, limit {ATTITUDE:g} deg"
    return Finding("protocol-attitude", claim, text, max(errors) < ATTITUDE)


def robust_findings(results: Sequence[Result]) -> list[Finding]:
    """Return the findings of the experiment `robustness`.

    Args:
        results: results of `robust` trials.
    """
    count = len(results)
    walked = sum(map(walked_all_steps, results))
    unsafe = [r["trial"]["name"] for r in results if not r["safe"]]
    walks = f"{walked} of {count} robots walked all steps and stood, at least {ROBUST:.0%} wanted"
    ends = f"{count - len(unsafe)} of {count} robots stood or were stopped, all wanted" + (": not " if unsafe else "")
    tested = bool(results)
    return [
        Finding(
            "robust-walk", "the robot walks in spite of errors of model, floor and bus, and of pushes", walks,
            walked >= ROBUST * count if tested else None,
        ),
        Finding(
            "robust-safe", "a walk that does not end standing ends with the controller stopped and all drives holding or off",
            ends + ", ".join(unsafe), not unsafe if tested else None,
        ),
    ]  # fmt: skip


def walked_all_steps(result: Result) -> bool:
    """Return whether the robot walked all steps of a trial of `robustness`, and stood at the end.

    Args:
        result: result of a `robust` trial.
    """
    return bool(result["outcome"] == "stood" and result["steps"] == result["trial"]["steps"])


def push_findings(results: Sequence[Result]) -> list[Finding]:
    """Return the findings of the experiment `pushes`.

    Args:
        results: results of `push` trials.
    """
    forwards = [r for r in results if r["trial"]["direction"] == 0.0]
    return [
        _withstood("push-worst", "the robot withstands a push in every direction at every phase", results, PUSH_WORST),
        _withstood("push-forward", "the robot withstands a push forwards at every phase", forwards, PUSH_FORWARD),
    ]


def _withstood(id_: str, claim: str, results: Sequence[Result], limit: float) -> Finding:
    if not results:
        return Finding(id_, claim, "no results", None)
    forces = [float(r["largest_push_n"]) for r in results]
    enough = sum(force >= limit for force in forces)
    text = (
        f"smallest {min(forces):.0f} N, mean {statistics.fmean(forces):.0f} N; "
        f"{enough} of {len(forces)} pushes with at least {limit:.0f} N, all wanted"
    )
    return Finding(id_, claim, text, enough == len(forces))


def condition(result: Result) -> str:
    """Return the condition of a walk: passive or active, full or partial.

    Args:
        result: result of a walk.
    """
    trial = result["trial"]
    return f"{'active' if trial['active'] else 'passive'} {'full' if trial['xi'] == 1.0 else 'partial'}"


def normalised(result: Result) -> float:
    """Return the normalised metabolic rate of a walk.

    A walk begins with full assistance and ends with the assistance factor of the trial. The rate of the last part is divided by
    the rate of the first part.

    Args:
        result: result of a walk.
    """
    return float(result["metabolic_w_kg"]["target"] / result["metabolic_w_kg"]["full"])


def step_variation(result: Result) -> float:
    """Return how much the joint angle errors vary over the last steps of a walk, as a fraction of the guide half-width.

    The ratio e / q_bound is the angle error of a joint divided by the half-width of the guide. Its standard deviation over the
    steps is computed at each phase and for each joint. The result is the mean of these standard deviations.

    Args:
        result: result of a guided walk.
    """
    steps = []
    for curve in result["curves"]:
        phase, *columns = np.array(curve).T
        measured, desired, bound = np.array(columns).reshape(3, 2, -1)
        ratio = (measured - desired) / bound
        steps.append([np.interp(_PHASES, phase, joint) for joint in ratio])
    return float(np.std(steps, axis=0).mean())


def _alarms(results: Sequence[Result]) -> str:
    """Return the unexpected diagnostics of walks without a fault, each with the number of its reports, as text."""
    counts: dict[str, int] = {}
    for result in results:
        for code, count in result["diagnostics"].items():
            if code not in EXPECTED:
                counts[code] = counts.get(code, 0) + count
    return ", ".join(f"{code} {count}" for code, count in sorted(counts.items()))


def _net(result: Result) -> float:
    """Return the metabolic rate [W/kg] in the last part of a walk, minus the rate in the part with full assistance."""
    return float(result["metabolic_w_kg"]["target"] - result["metabolic_w_kg"]["full"])


def _complete(result: Result) -> bool:
    return bool(result["trial"]["kind"] == "walk" and result["outcome"] == "stood")


def _by_subject(results: Sequence[Result]) -> list[dict[str, Result]]:
    """Return one mapping per subject: condition -> result. A subject with a missing or failed trial is left out."""
    subjects: dict[float, dict[str, Result]] = {}
    for result in results:
        if _complete(result):
            subjects.setdefault(result["trial"]["mass"], {})[condition(result)] = result
    return [subject for _, subject in sorted(subjects.items()) if len(subject) == 4]


def _contained(id_: str, results: Sequence[Result]) -> Finding:
    claim = "in all trials, the trajectories stay inside the guide"
    ratios = [r["max_ratio"] for r in results if r["max_ratio"] is not None]
    if not results:
        return Finding(id_, claim, "no results", None)
    stood = sum(r["outcome"] == "stood" for r in results)
    ended = f"{stood} of {len(results)} walks ended standing; "
    if not ratios:  # all walks had full assistance, or ended before the guide was used
        return Finding(id_, claim, ended + "no walk inside a guide", None if stood == len(results) else False)
    text = f"{ended}largest |e|/q_bound {max(ratios):.2f}, limit 1"
    return Finding(id_, claim, text, stood == len(results) and max(ratios) <= 1.0)


def _paired(
    id_: str,
    claim: str,
    subjects: Sequence[dict[str, Result]],
    larger: Callable[[dict[str, Result]], float],
    smaller: Callable[[dict[str, Result]], float],
    text: str,
) -> Finding:
    """Test whether one quantity is larger than another (one-sided sign test over the subjects), and return the finding.

    The significance level is 5 %. With fewer than five subjects no sign test reaches this level. Then the difference must have
    the claimed sign in every subject.
    """
    if not subjects:
        return Finding(id_, claim, "no results", None)
    a, b = [larger(s) for s in subjects], [smaller(s) for s in subjects]
    count, wins = len(subjects), sum(x > y for x, y in zip(a, b, strict=True))
    probability = sum(math.comb(count, k) for k in range(wins, count + 1)) / 2**count
    means = text.format(a=statistics.fmean(a), b=statistics.fmean(b))
    passed = probability < 0.05 if count >= 5 else wins == count
    return Finding(id_, claim, f"{means}; in {wins} of {count} subjects, sign test p = {probability:.3f}", passed)


def _same(id_: str, claim: str, subjects: Sequence[dict[str, Result]], one: str, other: str) -> Finding:
    if not subjects:
        return Finding(id_, claim, "no results", None)
    differences = [_net(s[one]) - _net(s[other]) for s in subjects]
    mean, limit = statistics.fmean(differences), SAME * STANDING
    spread = statistics.stdev(differences) if len(differences) > 1 else 0.0
    text = (
        f"{one} minus {other}: {mean:+.4f} W/kg, standard deviation {spread:.4f}, {len(subjects)} subjects, "
        f"limit {limit:.3f} (2 % of standing)"
    )
    return Finding(id_, claim, text, abs(mean) <= limit)


def _trend(id_: str, claim: str, walks: Sequence[Result], value: Callable[[Result], float], form: str) -> Finding:
    factors = [r["trial"]["xi"] for r in walks]
    if len(set(factors)) < 3:
        return Finding(id_, claim, "no results", None)
    values = [value(r) for r in walks]
    means = {
        xi: statistics.fmean(v for v, x in zip(values, factors, strict=True) if x == xi) for xi in sorted(set(factors))
    }
    rho = statistics.correlation(_ranks(factors), _ranks(values)) if len(set(values)) > 1 else 0.0
    shown = ", ".join(f"Xi {xi:g}: {mean:{form}}" for xi, mean in reversed(means.items()))
    passed = rho <= -TREND and means[min(means)] > means[max(means)]
    return Finding(id_, claim, f"{shown}; rank correlation with Xi {rho:+.2f}, limit {-TREND:+.1f}", passed)


def _symmetry(id_: str, claim: str, walks: Sequence[Result], value: Callable[[Result], float]) -> Finding:
    """Compare a value in pairs of walks with equal assistance factor, and return the finding.

    On each day of the sweep, the assistance factor falls from 1 to 0 and then rises to 1. Each factor above 0 therefore has two
    values. Days with a missing trial are left out.
    """
    days: dict[str, list[Result]] = {}
    count = 0  # number of walks on a complete day of the sweep
    for walk in walks:
        day, position = walk["trial"]["order"].split("-")
        days.setdefault(day, []).append(walk)
        count = max(count, int(position))
    pairs, values = list[float](), list[float]()
    for trials in days.values():
        factors = [r["trial"]["xi"] for r in trials]
        if len(trials) == count and factors == factors[::-1]:
            values += [value(r) for r in trials]
            pairs += [abs(value(trials[k]) - value(trials[-1 - k])) for k in range(count // 2)]
    if not pairs:
        return Finding(id_, claim, "no results", None)
    span = max(values) - min(values)
    ratio = statistics.fmean(pairs) / span if span else 0.0
    text = f"mean difference of the way down and the way up: {ratio:.2f} of the range of the sweep, limit {ASYMMETRY:g}"
    return Finding(id_, claim, text, ratio <= ASYMMETRY)


def _baseline(walks: Sequence[Result]) -> Finding:
    claim = "the baseline metabolic rate is consistent between the trials"
    rates = [r["metabolic_w_kg"]["full"] for r in walks]
    if len(rates) < 2:
        return Finding("sweep-baseline", claim, "no results", None)
    variation = statistics.stdev(rates) / statistics.fmean(rates)
    text = (
        f"mean {statistics.fmean(rates):.3f} W/kg, "
        f"coefficient of variation {100 * variation:.1f} %, limit {100 * VARIATION:.0f} %"
    )
    return Finding("sweep-baseline", claim, text, variation <= VARIATION)


def _ranks(values: Sequence[float]) -> list[float]:
    """Return the rank of each value. Equal values share the mean of their ranks."""
    return [sum(v < value for v in values) + 0.5 * (sum(v == value for v in values) - 1) for value in values]
