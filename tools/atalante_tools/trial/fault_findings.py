"""Findings of the experiment `faults`: `results -> one finding per fault`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby
from typing import Any, Final

from atalante_tools.faults.matrix import load_matrix
from atalante_tools.trial.fault_plan import DOUBLE_SUPPORT, NO_FRAMES
from atalante_tools.trial.findings import Finding, Result

#: Cases in which the robot must not fall: fault ID -> regular expression for the case name.
#: An empty expression matches all cases of the fault. The faults are:
#: - lost, late and doubled frames, and errors on the bus;
#: - a failed IMU, foot or force cell, and an exception of the controller;
#: - a few late cycles, STOP, the release of the dead-man switch, and the loss of the pendant.
#: In other cases of these faults, all drives hold their position immediately, so the robot may fall. Examples:
#: - The HAL loop stays much slower than 1 kHz. The joints then move too far in a cycle, and the HAL rejects their velocity.
#: - A drive sends nothing for ten cycles. The HAL then does not know the angle of the joint.
#: - The operator presses HOLD.
NO_FALL: Final = {
    **dict.fromkeys(("F01", "F02", "F03", "F05", "F20", "F24", "F30", "F31", "F32", "F33"), ""),
    "F04": "LEFT|RIGHT",
    "F06": "[0-4] cycles|by 4 cycles",
    "F19": "IMU|FOOT",
    "F44": "[23] cycles|cycles of 1.05 ms",
    "F45": "",
    "F56": "STOP|dead-man|pendant",
    **dict.fromkeys(("F63", "F64", "F65"), ""),
}
#: IDs of the faults after which the HAL sends no more frames. The robot must not fall if such a fault begins in double support.
NO_FALL_IN_DOUBLE_SUPPORT: Final = NO_FRAMES


def fault_findings(results: Sequence[Result]) -> list[Finding]:
    """Return one finding per fault.

    If `NO_FALL` contains the fault and the case, no run may end in a fall. For a fault in `NO_FALL_IN_DOUBLE_SUPPORT`, no run in
    which the fault begins in double support may end in a fall. After any other fall, the HAL must have reported a diagnostic, and
    must have left ACTIVE and FULL_ASSIST. The HAL must not raise an exception in any run.

    Args:
        results: results of `fault` trials.
    """
    matrix = load_matrix()
    return [
        _finding(id_, matrix[id_].fault, list(group))
        for id_, group in groupby(results, key=lambda result: str(result["trial"]["id"]))
    ]


def _finding(id_: str, fault: str, results: Sequence[Result]) -> Finding:
    runs = [(result["trial"]["case"], one) for result in results for one in result["runs"]]
    falls = [(case, one) for case, one in runs if one["outcome"] == "fell"]
    failed = [one for case, one in runs if one["outcome"] == "exception" or _wrong_fall(id_, case, one)]
    parts = [f"{len(falls)} of {len(runs)} walks fell"]
    parts += [f"{case}: {_moments(cases)}" for case, cases in _by_case(falls)]
    parts += [f"longest duration without a fall {_longest(result)}" for result in results if result["longest"]]
    if unfinished := sum(one["outcome"] == "unfinished" for _, one in runs):
        parts.append(f"{unfinished} unfinished")
    parts += [f"exception: {one['reason']}" for _, one in runs if one["outcome"] == "exception"]
    return Finding(id_, f"{fault}: {_claim(id_)}", "; ".join(parts), not failed)


def _claim(id_: str) -> str:
    if id_ in NO_FALL:
        cases = NO_FALL[id_].replace("|", ", ")
        return f"no fall (cases {cases}), and a diagnostic with every other fall" if cases else "no fall"
    if id_ in NO_FALL_IN_DOUBLE_SUPPORT:
        return "no fall in double support, and a diagnostic before every other fall"
    return "a diagnostic with each fall"


def _wrong_fall(id_: str, case: str, run: dict[str, Any]) -> bool:
    """Return whether a run ended in a fall that makes the finding fail.

    Each of the following is sufficient: the robot must not fall in this case (`NO_FALL`, `NO_FALL_IN_DOUBLE_SUPPORT`), the HAL
    reported no diagnostic, or the HAL ended in ACTIVE or FULL_ASSIST.
    """
    if run["outcome"] != "fell":
        return False
    required = (id_ in NO_FALL and re.match(NO_FALL[id_], case)) or (
        id_ in NO_FALL_IN_DOUBLE_SUPPORT and run["moment"] in DOUBLE_SUPPORT
    )
    return bool(required) or not run["codes"] or run["state"] in ("ACTIVE", "FULL_ASSIST")


def _by_case(falls: Sequence[tuple[str, dict[str, Any]]]) -> list[tuple[str, list[dict[str, Any]]]]:
    return [(case, [run for _, run in group]) for case, group in groupby(falls, key=lambda fall: fall[0])]


def _moments(falls: Sequence[dict[str, Any]]) -> str:
    """Return text about all falls in one case: moments, final states, first diagnostics, and the reason of the first fall."""
    moments = ", ".join(run["moment"] for run in falls)
    states = ", ".join(dict.fromkeys(run["state"] for run in falls))
    codes = ", ".join(dict.fromkeys(run["codes"][0] if run["codes"] else "no diagnostic" for run in falls))
    return f"at {moments} ({states}; {codes}; {falls[0]['reason'] or 'no reason'})"


def _longest(result: Result) -> str:
    """Return the longest fault duration [cycles] that the robot withstands at every tested moment of the walk, as text.

    For example, the robot withstands a fault of 80 cycles in the weight shift, but only of 30 cycles at phase 0.375. The text is
    then "30 cycles (at phase 0.375)". If the robot withstands a permanent fault at all moments, the text is "is not limited".
    """
    limited = [
        (cycles, run["moment"])
        for cycles, run in zip(result["longest"], result["runs"], strict=True)
        if cycles is not None
    ]
    if not limited:
        return "is not limited"
    cycles, moment = min(limited, key=lambda one: one[0])
    return f"{cycles} cycles (at {moment})"
