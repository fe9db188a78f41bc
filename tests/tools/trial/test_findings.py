"""Findings: each one passes on results that show it and fails on results that do not. The report contains all of them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from atalante_tools.trial.findings import (
    assist_findings,
    protocol_findings,
    push_findings,
    robust_findings,
    shape_findings,
    step_variation,
    sweep_findings,
)
from atalante_tools.trial.plan import SWEEP, PushTrial, RobustTrial, ShapeTrial, TreadmillTrial, WalkTrial, fields
from atalante_tools.trial.report import write_report
from atalante_tools.trial.run import EDGES

MASSES = (58.0, 62.0, 66.0, 70.0, 75.0, 80.0, 85.0, 91.0)
VERSIONS = {"atalante-hal": "0.1.0", "source": "0123456789abcdef"}
Result = dict[str, Any]


def shape_result(shape: str, ratio: float) -> Result:
    curve = [[0.1 * k, 5.0, 4.0, 8.0, 0.0] for k in range(11)]
    trial = ShapeTrial(shape, 1, 0.5, 0, "mujoco")
    return {"trial": fields(trial), "versions": VERSIONS, "outcome": "done", "max_ratio": ratio, "curves": [curve]}


def walk_result(
    mass: float, active: bool, xi: float, *, net: float, error: float, outer: float = 0.5, spread: float = 0.3,
    variation: float = 0.1, order: str = "",
) -> Result:  # fmt: skip
    trial = WalkTrial(mass, 1.75, active, xi, (1, 1, 1), "constant", 1.0, 1.0, 7, "mujoco", order)
    histogram = [10] * (len(EDGES) - 1)
    guide = {"outer": outer, "spread": spread, "histogram": [histogram, histogram]} if xi < 1.0 else None
    return {
        "trial": fields(trial), "versions": VERSIONS, "outcome": "stood", "steps": 3, "certified": True if xi < 1.0 else None,
        "true_lateral_m": -0.4, "true_yaw_deg": 0.5, "attitude_rms_deg": 0.07,
        "max_ratio": 0.6 if xi < 1.0 else None, "error_deg": {"full": 0.5, "transition": 0.7, "target": error},
        "metabolic_w_kg": {"full": 1.44, "transition": 1.44, "target": 1.44 + net}, "muscle_w_kg": net, "guide": guide,
        "respirometer": {"segment": [0, 1, 2], "rate_w_kg": [1.44, 1.44, 1.44 + net]},
        # hip and knee of two steps: measured, desired, bounds
        "curves": [[[0.1 * k, 5.0 + s, 20.0, 4.0, 21.0, 4.0, 4.0] for k in range(9)] for s in (-variation, variation)],
    }  # fmt: skip


def study(**changed: dict[str, float]) -> list[Result]:
    """Return the results of a study that shows all findings of the paper, with other values in some conditions."""
    values: dict[str, dict[str, float]] = {
        "passive_full": {"net": 0.0, "error": 0.5},
        "passive_partial": {"net": 0.001, "error": 2.0, "outer": 0.8, "spread": 0.2},
        "active_full": {"net": 0.002, "error": 0.5},
        "active_partial": {"net": 0.1, "error": 1.5, "outer": 0.4, "spread": 0.4, "variation": 0.4},
    }
    for name, change in changed.items():
        values[name].update(change)
    return [
        walk_result(mass, name.startswith("active"), 1.0 if name.endswith("full") else 0.5, **value)  # type: ignore[arg-type]
        for mass in MASSES
        for name, value in values.items()
    ]


def sweep(slope: float = 0.2, drift: float = 0.0, error_slope: float = 2.0) -> list[Result]:
    results = [
        walk_result(75.0, True, xi, net=slope * (1.0 - xi) + drift * k, error=0.5 + error_slope * (1.0 - xi) + 10 * drift * k,
                    order=f"day1-{k + 1:02d}")
        for k, xi in enumerate(SWEEP)
    ]  # fmt: skip
    rates = {"full": None, "transition": 2.3, "target": 2.41}
    treadmill = {
        "trial": fields(TreadmillTrial(75.0, 0.2, 300, 0, "day1")),
        "versions": VERSIONS,
        "outcome": "computed",
    }
    return [{**treadmill, "metabolic_w_kg": rates}, *results]


def verdicts(findings: list[Any]) -> dict[str, bool | None]:
    return {finding.id: finding.passed for finding in findings}


def test_study_that_shows_all_findings_passes() -> None:
    found = verdicts(assist_findings(study()))
    assert list(found) == [
        "assist-contained", "passive-gather", "active-spread", "active-vary", "passive-flat", "active-partial-above",
        "active-full-near-passive", "active-tracks-better",
    ]  # fmt: skip
    assert set(found.values()) == {True}


@pytest.mark.parametrize(
    ("finding", "changed"),
    [
        ("passive-gather", {"passive_partial": {"outer": 0.3}}),
        ("active-spread", {"active_partial": {"spread": 0.1}}),
        ("active-vary", {"active_partial": {"variation": 0.05}}),
        ("passive-flat", {"passive_partial": {"net": 0.05}}),
        ("passive-flat", {"passive_partial": {"net": -0.05}}),
        ("active-partial-above", {"active_partial": {"net": 0.0}}),
        ("active-full-near-passive", {"active_full": {"net": 0.05}}),
        ("active-tracks-better", {"active_partial": {"error": 2.1}}),
    ],
)
def test_study_without_a_finding_fails_this_finding_alone(finding: str, changed: dict[str, dict[str, float]]) -> None:
    found = verdicts(assist_findings(study(**changed)))
    assert [name for name, passed in found.items() if not passed] == [finding]


def test_a_joint_outside_or_a_fall_fails_containment() -> None:
    for change in ({"max_ratio": 1.01}, {"outcome": "fell"}):
        results = study()
        results[1].update(change)
        assert verdicts(assist_findings(results))["assist-contained"] is False
    assert verdicts(shape_findings([shape_result("constant", 0.5), shape_result("snap", 1.0)])) == {
        "shapes-contained": True
    }
    assert verdicts(shape_findings([shape_result("constant", 0.5), shape_result("snap", 1.1)])) == {
        "shapes-contained": False
    }


def test_one_subject_of_eight_against_a_finding_is_accepted_two_are_not() -> None:
    results = study()
    for wrong, passed in ((0, True), (1, True), (2, False)):
        for result in results:
            trial = result["trial"]
            if trial["mass"] in MASSES[:wrong] and trial["active"] and trial["xi"] == 0.5:
                result["error_deg"]["target"] = 3.0
        assert verdicts(assist_findings(results))["active-tracks-better"] is passed  # p = 0.004, 0.035, 0.145


def test_sweep_findings_pass_and_fail() -> None:
    assert set(verdicts(sweep_findings(sweep())).values()) == {True}
    flat = verdicts(sweep_findings(sweep(slope=0.0)))
    assert flat["sweep-metabolic-trend"] is False
    assert flat["sweep-error-trend"] is True
    falling = verdicts(sweep_findings(sweep(error_slope=-0.2)))
    assert falling["sweep-error-trend"] is False
    tired = verdicts(sweep_findings(sweep(slope=0.1, drift=0.05)))
    assert tired["sweep-metabolic-symmetry"] is False
    assert tired["sweep-error-symmetry"] is False


@pytest.mark.parametrize("positions", [(5,), (1, 9), (9,), (2, 3, 4, 5, 6, 7, 8, 9)])
def test_symmetry_has_no_verdict_if_the_only_day_has_a_missing_trial(positions: tuple[int, ...]) -> None:
    results = sweep()
    for position in positions:
        results[position]["outcome"] = "fell"  # results[0] is the treadmill
    found = verdicts(sweep_findings(results))
    assert found["sweep-metabolic-symmetry"] is found["sweep-error-symmetry"] is None


def test_symmetry_leaves_out_a_day_with_a_missing_trial() -> None:
    complete, incomplete = sweep(), sweep(drift=0.05)
    for result in incomplete:
        result["trial"]["order"] = result["trial"]["order"].replace("day1", "day2")
    del incomplete[5]  # the trial with Xi = 0
    found = {finding.id: finding for finding in sweep_findings([*complete, *incomplete])}
    expected = {finding.id: finding for finding in sweep_findings(complete)}
    for id_ in ("sweep-metabolic-symmetry", "sweep-error-symmetry"):
        assert found[id_] == expected[id_]


def test_changing_baseline_fails_its_finding() -> None:
    results = sweep()
    results[1]["metabolic_w_kg"]["full"] = 2.0
    assert verdicts(sweep_findings(results))["sweep-baseline"] is False


def test_findings_without_results_have_no_verdict() -> None:
    for findings in (shape_findings([]), assist_findings([]), sweep_findings([])):
        assert {finding.passed for finding in findings} == {None}


def test_variation_of_steps_is_the_mean_standard_deviation_at_equal_phase() -> None:
    # hip at +-0.4 deg in a guide of 4 deg: standard deviation 0.1; knee without variation
    assert step_variation(walk_result(75.0, True, 0.5, net=0.0, error=1.0, variation=0.4)) == pytest.approx(0.05)


@pytest.mark.parametrize("experiment", ["shapes", "assist", "sweep"])
def test_report_contains_every_finding_and_requests_nothing(experiment: str, tmp_path: Path) -> None:
    results, find = {
        "shapes": ([shape_result("constant", 0.5), shape_result("snap", 1.2)], shape_findings),
        "assist": (study(active_partial={"net": -0.1}), assist_findings),
        "sweep": (sweep(drift=0.05), sweep_findings),
    }[experiment]
    findings = find(results)
    path = tmp_path / "report.html"
    write_report(experiment, results, findings, True, 1, path)
    text = path.read_text()
    for finding in findings:
        row = next(row for row in text.split("<tr>") if f"<td>{finding.id}</td>" in row)
        assert f">{'pass' if finding.passed else 'FAIL'}</td>" in row
        assert finding.statistic.split(";")[0].replace("&", "&amp;").replace("'", "&#x27;") in row
    assert any(finding.passed is False for finding in findings)
    rows = [line for line in path.with_suffix(".md").read_text().splitlines() if line.startswith("| `")]
    assert [row.split("`")[1] for row in rows] == [finding.id for finding in findings]
    assert {len(row.split(" | ")) for row in rows} == {4}
    for result in results:
        assert f"| {result['trial']['name']} | {result['outcome']} |" in path.with_suffix(".md").read_text()
    assert "Short trials" in text
    assert "1 trials have no result" in text
    assert "0123456789abcdef" in text
    assert "seeds" in text
    assert "engine" in text
    assert text.count("data:image/png;base64,") == {"shapes": 1, "assist": 4, "sweep": 2}[experiment]
    sources = re.findall(r"(?:src|href|url)\s*[=(]\s*['\"]?([^'\" >]{1,30})", text)
    assert all(source.startswith("data:image/png") for source in sources)
    assert "http" not in re.sub(r"base64,[^']*", "", text)


def robust_result(number: int, outcome: str = "stood", *, safe: bool = True) -> Result:
    trial = RobustTrial(number, 75.0, 1.75, 1.05, 0.5, (1, 0, 1), 0.01, ((1.0, 90.0),), 100.0, 60, number, "mujoco")
    return {
        "trial": fields(trial), "versions": VERSIONS, "outcome": outcome, "steps": 60, "state": "ACTIVE", "safe": safe,
        "max_dcm_error_m": 0.05, "diagnostics": {}, "true_lateral_m": 0.1,
    }  # fmt: skip


def test_robustness_needs_98_percent_with_all_steps_and_a_safe_end_of_the_others() -> None:
    stood = [robust_result(k) for k in range(98)]
    held = [robust_result(98 + k, "hold") for k in range(2)]
    assert verdicts(robust_findings([*stood, *held])) == {"robust-walk": True, "robust-safe": True}
    assert verdicts(robust_findings([*stood[1:], *held, robust_result(0, "fell")]))["robust-walk"] is False
    early = {**robust_result(0), "steps": 59}
    assert verdicts(robust_findings([*stood[1:], *held, early])) == {"robust-walk": False, "robust-safe": True}
    unsafe = robust_findings([*stood, robust_result(99, "fell", safe=False)])
    assert verdicts(unsafe)["robust-safe"] is False
    assert "robust-099" in unsafe[1].statistic
    assert verdicts(robust_findings([])) == {"robust-walk": None, "robust-safe": None}


def push_result(direction: float, phase: float, largest: float) -> Result:
    trial = PushTrial(direction, phase, (50.0, 100.0), 75.0, 1.75, 0, "mujoco")
    return {
        "trial": fields(trial), "versions": VERSIONS, "outcome": "computed", "largest_push_n": largest, "end": "fell",
        "diagnostics": {},
    }  # fmt: skip


def test_pushes_have_a_limit_for_the_worst_direction_and_one_forwards() -> None:
    strong = [push_result(0.0, 0.0, 300.0), push_result(0.0, 0.5, 350.0), push_result(90.0, 0.0, 200.0)]
    assert verdicts(push_findings(strong)) == {"push-worst": True, "push-forward": True}
    weak_forwards = push_findings([*strong, push_result(0.0, 0.75, 250.0)])
    assert verdicts(weak_forwards) == {"push-worst": True, "push-forward": False}
    assert "smallest 250 N, mean 300 N; 2 of 3 pushes" in weak_forwards[1].statistic
    assert verdicts(push_findings([*strong, push_result(90.0, 0.5, 150.0)])) == {
        "push-worst": False,
        "push-forward": True,
    }
    assert verdicts(push_findings(strong[2:])) == {"push-worst": True, "push-forward": None}


def test_protocol_needs_certified_guides_and_no_alarm() -> None:
    walks = [
        {**walk_result(75.0, False, 0.5, net=0.0, error=1.0), "diagnostics": {"TORQUE_SATURATED": 4}} for _ in range(20)
    ]
    assert verdicts(protocol_findings(walks)) == {
        "protocol-contained": True,
        "protocol-certified": True,
        "protocol-diagnostics": True,
        "protocol-line": True,
        "protocol-attitude": True,
    }
    walks[0]["certified"] = False
    assert verdicts(protocol_findings(walks))["protocol-certified"] is True
    walks[1]["certified"] = False
    assert verdicts(protocol_findings(walks))["protocol-certified"] is False
    alarmed = [*walks[2:], {**walks[2], "diagnostics": {"ENC_DRIFT": 1}}]
    assert verdicts(protocol_findings(alarmed))["protocol-certified"] is True
    assert verdicts(protocol_findings(alarmed))["protocol-diagnostics"] is False
    assert verdicts(protocol_findings([{**walks[2], "outcome": "fell"}]))["protocol-contained"] is False


def test_walks_without_a_guide_say_nothing_about_containment() -> None:
    walk = {**walk_result(75.0, False, 1.0, net=0.0, error=0.5), "diagnostics": {}}
    contained = protocol_findings([walk])[0]
    assert (contained.statistic, contained.passed) == ("1 of 1 walks ended standing; no walk inside a guide", None)
    fallen = protocol_findings([walk, {**walk, "outcome": "fell"}])[0]
    assert (fallen.statistic, fallen.passed) == ("1 of 2 walks ended standing; no walk inside a guide", False)


def test_full_assistance_has_no_guide_to_certify() -> None:
    walks = [walk_result(75.0, False, 1.0, net=0.0, error=0.5)]
    walks[0]["diagnostics"] = {}
    assert verdicts(protocol_findings(walks))["protocol-certified"] is None
    guided = {**walk_result(75.0, False, 0.5, net=0.0, error=0.5), "diagnostics": {}}
    assert verdicts(protocol_findings([*walks, guided]))["protocol-certified"] is True


@pytest.mark.parametrize(("reference", "limit"), [(False, 1.5), (True, 0.5)])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_walks_end_near_their_line(reference: bool, limit: float, side: float) -> None:
    walk = {**walk_result(75.0, False, 0.5, net=0.0, error=1.0), "diagnostics": {}}
    walk["trial"]["heading_reference"] = reference
    for deviation, near in ((limit, True), (limit + 0.001, False)):
        other = {**walk, "true_lateral_m": side * deviation}
        assert verdicts(protocol_findings([walk, other]))["protocol-line"] is near
    fallen = {**walk, "true_lateral_m": None}
    assert verdicts(protocol_findings([fallen]))["protocol-line"] is None
    assert "no walk ended standing" in {finding.statistic for finding in protocol_findings([fallen])}


@pytest.mark.parametrize(("error", "passed"), [(0.499, True), (0.5, False), (None, None)])
def test_attitude_error_has_a_limit(error: float | None, passed: bool | None) -> None:
    walk = {**walk_result(75.0, False, 0.5, net=0.0, error=1.0), "diagnostics": {}, "attitude_rms_deg": error}
    assert verdicts(protocol_findings([walk]))["protocol-attitude"] is passed


@pytest.mark.parametrize("experiment", ["protocol", "robustness", "pushes"])
def test_reports_of_walks_contain_every_trial(experiment: str, tmp_path: Path) -> None:
    if experiment == "robustness":
        results = [robust_result(1), robust_result(2, "fell")]
        findings = robust_findings(results)
    elif experiment == "pushes":
        results = [push_result(direction, phase, 100.0) for direction in (0.0, 90.0, 270.0) for phase in (0.0, 0.5)]
        results.pop()  # a trial is missing
        findings = push_findings(results)
    else:
        results = [{**walk_result(75.0, True, 0.5, net=0.1, error=1.0), "diagnostics": {}}]
        findings = protocol_findings(results)
    write_report(experiment, results, findings, False, 0, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert all(result["trial"]["name"] in text for result in results)
    assert all(finding.id in text for finding in findings)
    assert text.count("data:image/png") == 1
