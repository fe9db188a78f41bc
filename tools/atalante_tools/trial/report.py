"""Report of an experiment as one HTML file, with embedded images: `results, findings -> tables, figures, report.html`."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

from atalante_tools.console.html import html_table, page
from atalante_tools.console.terminal import print_message
from atalante_tools.trial.fault_table import fault_table
from atalante_tools.trial.findings import Finding, Result, condition

#: Title of each experiment, and an explanation of its numbers.
EXPERIMENTS: Final = {
    "shapes": (
        "Guide shapes",
        "The empty exoskeleton walks in the air, without feedforward, inside each guide shape (first experiment of the paper).",
    ),
    "assist": (
        "Full and partial assistance",
        "Virtual subjects walk on the ground, passive and active, with full and with partial assistance (second experiment of "
        "the paper). A passive subject has no muscle torque, so its metabolic rate is always the rate of quiet standing. An "
        "active subject tracks the gait at hip and knee of the swing leg. The measured metabolic rate is computed from oxygen "
        "uptake and carbon dioxide output with the equation of Brockway.",
    ),
    "sweep": (
        "Assistance factors",
        "One active virtual subject walks with a falling and then rising assistance factor (third experiment of the paper). Each "
        "trial starts with a subject who has learned nothing and is not tired, so the symmetry in time tests noise, not "
        "exhaustion. The metabolic rate on the treadmill comes from an equation for level walking at the same speed (Looney et "
        "al. 2019), without a simulated body. The normalised metabolic rate is the rate during exercise divided by the rate "
        "during the baseline. The resting rate is not subtracted: with full assistance the virtual subject rests, so the "
        "difference would be close to zero.",
    ),
    "faults": (
        "Faults during walks on the ground",
        "Each case of the fault matrix begins at ten moments of a walk with a passive wearer: at eight phases of the second "
        "step, and in the weight shifts (both feet carry load) before and after the steps. The faults F15, F16 and F41, after "
        "which the HAL sends no more frames, begin at 13 moments: also while the robot stands, at the start of the first step, "
        "and at the landing of the stop step. With --quick, there are two moments. A robot has fallen if its "
        "pelvis leans by more than 35 degrees. The longest duration of a permanent fault without a fall is found by bisection.",
    ),
    "protocol": (
        "Full and then partial assistance",
        "Virtual subjects walk on the ground with full assistance, then with the assistance factor of the trial. The robot "
        "stands at the start and at the end of each walk.",
    ),
    "robustness": (
        "Robustness",
        "The emulated robot differs at random from the model of the controller: mass of the patient, friction of the floor, late "
        "messages and motors. The buses lose frames, and the robot is pushed at the pelvis. Each result contains all parameters.",
    ),
    "pushes": (
        "Pushes",
        "The robot walks with full assistance and a passive wearer, and is pushed at the pelvis for 0.2 s in a right-stance "
        "step. The robot has withstood the push if it walks four more steps, makes the stop step and stands. The force rises "
        "from walk to walk until the robot falls or stops. The table contains the largest force that the robot has withstood, "
        "and how the next walk ended.",
    ),
}  # fmt: skip
_CERTIFIED: Final = {True: "yes", False: "no", None: "-"}
_VERDICT: Final = {True: "pass", False: "FAIL", None: "not tested"}


def verdict(finding: Finding) -> str:
    """Return the verdict of a finding as text.

    Args:
        finding: finding to describe.
    """
    return _VERDICT[finding.passed]


def write_report(
    experiment: str, results: Sequence[Result], findings: Sequence[Finding], quick: bool, missing: int, path: Path
) -> None:
    """Write the HTML report, and its tables as Markdown in the same folder. Without Matplotlib, the report contains no figures.

    Args:
        experiment: key of `EXPERIMENTS`.
        results: results of the trials, in their order.
        findings: findings of the experiment.
        quick: whether the trials were shortened.
        missing: number of trials without a result.
        path: file to write.
    """
    title, text = EXPERIMENTS[experiment]
    parts = [f"<p>{escape(text)}</p>"]
    if quick:
        parts.append(
            "<p class='bad'>Short trials (--quick): few subjects and few steps. "
            "The findings test the program, not the claims.</p>"
        )
    if missing:
        parts.append(f"<p class='bad'>{missing} trials have no result.</p>")
    parts += [
        "<h2>Findings</h2>",
        _findings(findings),
        "<h2>Trials</h2>",
        html_table(*_trials(results)),
    ]
    if experiment != "faults":
        parts += ["<h2>Figures</h2>", *_figures(experiment, results)]
    parts += ["<h2>How it was computed</h2>", html_table(("Item", "Value"), _provenance(results))]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page(f"atalante trial {experiment}", title, parts), encoding="utf-8")
    path.with_suffix(".md").write_text(markdown(results, findings), encoding="utf-8")


def markdown(results: Sequence[Result], findings: Sequence[Finding]) -> str:
    """Return findings, trials and provenance as Markdown.

    Args:
        results: results of the trials.
        findings: findings of the experiment.
    """
    head = ["finding", "verdict", "claim", "statistic"]
    tables = [_markdown_table(head, [[f"`{f.id}`", verdict(f), f.claim, f.statistic] for f in findings])]
    tables.append(_markdown_table(*_trials(results)))
    tables.append("\n".join(f"- {name}: {value}" for name, value in _provenance(results)))
    return "\n\n".join(tables) + "\n"


def _markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [
        [cell.replace("|", "&#124;") for cell in head],
        ["---"] * len(head),
        *([cell.replace("|", "&#124;") for cell in row] for row in rows),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def summary(result: Result) -> dict[str, Any]:
    """Return a result without curves, time series, guide statistics and versions.

    Args:
        result: result of a trial.
    """
    return {
        name: value for name, value in result.items() if name not in ("curves", "respirometer", "guide", "versions")
    }


def _findings(findings: Sequence[Finding]) -> str:
    kinds = {True: "good", False: "bad", None: "small"}
    rows = "".join(
        f"<tr><td>{escape(f.id)}</td><td class='{kinds[f.passed]}'>{verdict(f)}</td>"
        f"<td>{escape(f.claim)}</td><td>{escape(f.statistic)}</td></tr>"
        for f in findings
    )
    return f"<table><tr><th>Finding</th><th>Verdict</th><th>Claim</th><th>Statistic</th></tr>{rows}</table>"


def _trials(results: Sequence[Result]) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of the table of trials. A column without values is left out."""
    if results and all(r["trial"]["kind"] == "fault" for r in results):
        return fault_table(results)
    columns: list[tuple[str, Callable[[Result], str]]] = [
        ("trial", lambda r: r["trial"]["name"]),
        ("outcome", lambda r: r["outcome"]),
        ("steps", lambda r: str(r.get("steps", "-"))),
        (
            "longest without a fall [cycles]",
            lambda r: ", ".join("-" if n is None else str(n) for n in r.get("longest") or ()) or "-",
        ),
        ("certified", lambda r: _CERTIFIED[r.get("certified")]),
        ("largest |e|/q_bound", lambda r: _number(r.get("max_ratio"), 2)),
        ("RMS error, full [deg]", lambda r: _number(r.get("error_deg", {}).get("full"), 3)),
        ("RMS error, target [deg]", lambda r: _number(r.get("error_deg", {}).get("target"), 3)),
        ("baseline [W/kg]", lambda r: _number(r.get("metabolic_w_kg", {}).get("full"), 4)),
        ("exercise [W/kg]", lambda r: _number(r.get("metabolic_w_kg", {}).get("target"), 4)),
        ("true exercise above standing [W/kg]", lambda r: _number(r.get("muscle_w_kg"), 4)),
        ("true sideways [m]", lambda r: _number(r.get("true_lateral_m"), 2)),
        ("true heading [deg]", lambda r: _number(r.get("true_yaw_deg"), 1)),
        ("RMS attitude error [deg]", lambda r: _number(r.get("attitude_rms_deg"), 2)),
        ("patient [kg]", lambda r: _number(r["trial"]["mass"], 0) if "mass_share" in r["trial"] else "-"),
        ("true mass / known mass", lambda r: _number(r["trial"].get("mass_share"), 2)),
        ("friction", lambda r: _number(r["trial"].get("friction"), 2)),
        ("delay of states, commands, motors [ms]", lambda r: _delays(r["trial"].get("delay", ()))),
        ("state at the end", lambda r: r.get("state", "-")),
        ("largest push [N]", lambda r: _number(r.get("largest_push_n"), 0)),
        ("end of the last walk", lambda r: r.get("end", "-")),
        ("largest DCM error [m]", lambda r: _number(r.get("max_dcm_error_m"), 3)),
    ]
    filled = [(head, cells) for head, value in columns if set(cells := [value(r) for r in results]) != {"-"}]
    return [head for head, _ in filled], [list(row) for row in zip(*(cells for _, cells in filled), strict=True)]


def _delays(delays: Sequence[int]) -> str:
    return ", ".join(map(str, delays)) or "-"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _provenance(results: Sequence[Result]) -> list[tuple[str, str]]:
    """Return how the results were computed, as pairs of name and text: versions, seeds, engine, options, kind of robot."""
    versions = {f"{name} {value}" for r in results for name, value in r["versions"].items()}
    rows = [("versions", ", ".join(sorted(versions)))]
    for name, meaning in (
        ("seed", "seeds"), ("engine", "engine"), ("protocol", "steps: full assistance, transition, target"),
        ("shape", "guide shape"), ("idealization", "idealization"), ("feedforward", "feedforward"),
        ("literal", "law of the paper"), ("heading_reference", "heading reference"), ("haptics", "response to vibration"),
    ):  # fmt: skip
        values = dict.fromkeys(str(r["trial"][name]) for r in results if name in r["trial"])
        if values:
            rows.append((meaning, ", ".join(values)))
    if networks := dict.fromkeys(tuple(r["trial"]["network"]) for r in results if r["trial"].get("network")):
        rows.append(("gait network", ", ".join(f"{file} (SHA-256 {digest})" for file, digest in networks)))
    rows.append(("mode", "emulated robot in lock-step (virtual time), HAL and bus in the loop, no virtual operator"))
    return rows


def _figures(experiment: str, results: Sequence[Result]) -> list[str]:
    ended = [r for r in results if r["outcome"] in ("stood", "done", "computed")]
    if not ended and experiment != "robustness":
        return ["<p>No trial ended.</p>"]
    try:
        from atalante_tools.trial import figures
    except ModuleNotFoundError as error:
        print_message(f"no figures: {error.name} is not installed; type `pip install 'atalante-hal[plot]'`")
        return [f"<p>No figures: {escape(str(error.name))} is not installed.</p>"]
    walks = [r for r in ended if r["trial"]["kind"] == "walk"]
    if experiment == "pushes":
        return [_image("largest push over its direction", lambda: figures.pushes(ended))]
    if experiment == "shapes":
        return [_image("left hip in each guide shape", lambda: figures.shapes(ended))]
    if experiment == "robustness":
        return [_image("outcome of each walk", lambda: figures.robustness(results))]
    if not walks:
        return ["<p>No walk ended standing.</p>"]
    if experiment == "protocol":
        return [_image("position in the guide", lambda: figures.positions(walks))]
    if experiment == "assist":
        masses = [r["trial"]["mass"] for r in walks]
        mass = 75.0 if 75.0 in masses else masses[0]
        partial = [r for r in walks if condition(r).endswith("partial")] or walks
        return [
            _image("metabolic rate over the time of a trial", lambda: figures.scenario(partial[-1])),
            _image("hip and knee in the four conditions", lambda: figures.joints(walks, mass)),
            _image("position in the guide", lambda: figures.positions(walks)),
            _image("metabolic rate and tracking error", lambda: figures.power_and_error(walks)),
        ]
    return [
        _image("metabolic rates and tracking errors in time", lambda: figures.sweep_in_time(ended)),
        _image("normalised metabolic rate and tracking error", lambda: figures.sweep_trend(walks)),
    ]


def _image(text: str, draw: Callable[[], bytes]) -> str:
    return f"<p><img alt='{escape(text)}' src='data:image/png;base64,{base64.b64encode(draw()).decode()}'></p>"
