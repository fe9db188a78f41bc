"""Figure of a checked guide: the bounds, the safe area inside the bounds, and the worst simulated step."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np

from atalante_tools.guide.episode import Start
from atalante_tools.guide.promise_check import Checked

matplotlib.use("Agg")
from matplotlib import pyplot as plt

_JOINTS = ("hip (SH)", "knee (SK)")
_CENTRE = Start((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))


def draw(checked: Checked, picture: Path) -> None:
    """Draw hip and knee over one step: bounds of the guide, safe area inside the bounds, and the worst simulated step.

    From an angle in the safe area, the backup policy keeps both joints inside the guide. The figure calls this area the safe
    backward image. The area is computed for the speeds of the desired motion. For the worst step, the figure shows the angles and
    the pushes.

    Args:
        checked: result of a check. If no push was searched (`Checked.worst` is None), the figure has no worst step.
        picture: file to write.
    """
    leg, worst = checked.leg, checked.worst
    start = _CENTRE if worst is None else worst.start
    goal, image = leg.goal(start), np.degrees(leg.image(start))
    phase, desired, bounds = np.linspace(0.0, 1.0, len(goal.q)), np.degrees(goal.q), np.degrees(goal.bounds)
    figure, axes = plt.subplots(4, 1, figsize=(8.0, 9.0), sharex=True, height_ratios=(3, 1, 3, 1))
    for joint, name in enumerate(_JOINTS):
        angle, torque = axes[2 * joint], axes[2 * joint + 1]
        middle, (upper, lower) = desired[:, joint], bounds[joint].T
        angle.fill_between(phase, middle - lower, middle + upper, color="0.85", label="guide")
        known = ~np.isnan(image[joint, :, 0])
        angle.fill_between(
            phase[known],
            middle[known] - image[joint, known, 1],
            middle[known] + image[joint, known, 0],
            color="tab:green",
            alpha=0.25,
            label="safe backward image",
        )
        angle.plot(phase, middle, "--", color="0.4", linewidth=1.0, label="desired")
        if worst is not None:
            log = worst.walked.log
            walked = np.flatnonzero(np.abs(log[:, 2:4]).max(axis=1) > 0.0)
            cycles = slice(0, int(walked[-1]) + 1 if len(walked) else 1)
            angle.plot(
                phase[cycles], middle[cycles] + np.degrees(log[cycles, joint]), color="tab:red", label="worst step"
            )
            torque.plot(phase[cycles], log[cycles, 4 + joint], color="tab:red", linewidth=0.8)
        angle.set_ylabel(f"{name} [deg]")
        torque.set_ylabel("push [Nm]")
    axes[0].legend(loc="best", fontsize=8)
    axes[3].set_xlabel("phase t / T")
    figure.suptitle(_title(checked), fontsize=10)
    figure.tight_layout()
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def _title(checked: Checked) -> str:
    verdict = checked.verdict
    guide = f"{verdict.shape}, Xi {verdict.xi:g}: "
    if checked.worst is None:
        return guide + "no promise"
    return (
        f"{guide}pushes of {verdict.promise_hip_nm:.2f} Nm (hip) and {verdict.promise_knee_nm:.2f} Nm (knee), "
        f"largest |e| / q_bound on the plant {checked.worst.ratio:.3f}\n{checked.worst.kind}, {checked.worst.condition}"
    )
