"""Verification of the gaits of the network: the shipped network passes, and a spoiled gait is counted."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from atalante_control.dynamics.gait_network import Layer, load_network, save_network, subject_of
from atalante_control.gait_optimization.network_error import random_subjects
from atalante_control.gait_optimization.network_verification import network_checks, worst_checks
from atalante_hal.robot import load_robot
from atalante_tools.cli import cli

ROBOT = load_robot()
SHIPPED = load_network()
LARGER_CHANGE = 0.03  # rad, change of a control point that lifts the landing foot from the ground


@pytest.mark.long
def test_gaits_of_the_shipped_network_pass_every_check() -> None:
    corners = map(list, product(*zip(SHIPPED.low.tolist(), SHIPPED.high.tolist(), strict=True)))
    subjects = [*random_subjects(SHIPPED.low, SHIPPED.high, 30, seed=4), *map(subject_of, corners)]
    found = worst_checks([network_checks(SHIPPED, subject, ROBOT) for subject in subjects])
    assert [check for check in found if check.failures] == []


def test_worst_value_and_failures_are_counted_over_all_gaits() -> None:
    *hidden, last = SHIPPED.layers
    bias = last.bias.reshape(12, 8).copy()
    bias[3, 7] += LARGER_CHANGE
    bias[9, 0] += LARGER_CHANGE  # the same knee in the mirrored step: the angles stay continuous
    spoiled = replace(SHIPPED, layers=(*hidden, Layer(last.weights, bias.ravel())))
    subject = next(random_subjects(SHIPPED.low, SHIPPED.high, 1, seed=5))
    good, bad = (network_checks(network, subject, ROBOT) for network in (SHIPPED, spoiled))
    found = {check.name: check for check in worst_checks([good, bad, good])}
    landing = found["height error of the landing foot"]
    assert landing.failures == 1
    assert landing.value == max(check.value for check in bad if check.name == landing.name) > landing.limit
    assert found["joint torque relative to its limit"].failures == 0


def test_command_reports_failures_and_exits_with_1(tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["gait", "verify", "--count", "2"])
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert lines[0].split() == ["2", "gaits", "of", "the", "network", "worst", "limit", "unit", "failures"]
    assert all(line.endswith(" 0") for line in lines[1:])
    names = "\n".join(lines)
    for name in ("joint torque", "centre of pressure across", "friction", "below its intended height", "sole corner"):
        assert name in names

    fast = np.where(np.arange(len(SHIPPED.low)) == 3, 0.45 / SHIPPED.low, 1.0)
    stretched = replace(SHIPPED, low=SHIPPED.low * fast, high=SHIPPED.high * fast)
    save_network(stretched, tmp_path / "fast.npz")
    done = CliRunner().invoke(
        cli, ["gait", "verify", "--network", str(tmp_path / "fast.npz"), "--count", "3", "--json"]
    )
    assert done.exit_code == 1
    failed = {row["name"]: row["failures"] for row in map(json.loads, done.stdout.splitlines()) if row["failures"]}
    assert 0 < max(failed.values()) <= 3
