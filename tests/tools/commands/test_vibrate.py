"""`atalante vibrate`: one motor runs, all others are off."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from atalante_emulator.faults import Fault
from atalante_hal.robot import MOTORS
from atalante_tools.cli import cli
from atalante_tools.session import rig as rig_module
from atalante_tools.session.rig import Rig


def vibrate(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["vibrate", *arguments])


@pytest.mark.parametrize("index", [0, 5])
def test_only_the_chosen_motor_runs_and_it_stops_afterwards(monkeypatch: pytest.MonkeyPatch, index: int) -> None:
    levels: list[np.ndarray] = []
    original = rig_module.open_hal

    @contextmanager
    def open_hal(*arguments: Any, **options: Any) -> Iterator[Rig]:
        with original(*arguments, **options) as rig:
            assert rig.emulator is not None
            rig.emulator.before_send.append(lambda now, values: levels.append(rig.hal.state.vibration.copy()))
            yield rig
            for _ in range(300):
                rig.hal.read()
                rig.hal.hold()

    monkeypatch.setattr(rig_module, "open_hal", open_hal)
    result = vibrate(MOTORS[index].upper(), "0.6", "--for", "0.4", "--json")
    assert result.exit_code == 0, result.stderr
    printed = json.loads(result.stdout)
    assert printed["motor"] == MOTORS[index]
    assert printed["measured"] == pytest.approx(0.6, abs=0.02)
    strongest = np.max(levels, axis=0)
    assert strongest[index] == pytest.approx(0.6, abs=0.02)
    assert np.delete(strongest, index).max() == 0.0
    assert levels[-1].max() < 0.02


def test_the_output_contains_commanded_and_measured_level() -> None:
    result = vibrate("left_thigh_front", "0.5", "--for", "0.4")
    assert result.exit_code == 0
    assert result.stdout == "left_thigh_front: commanded 0.50, measured at most 0.50, for 0.4 s\n"
    assert result.stderr.endswith("the robot is in HOLD\n")


@pytest.mark.parametrize(
    ("fault", "seconds", "code"),
    [
        (Fault("value", "HAPTICS_STATE", LeftThighFront_Amplitude=0.2), "0.4", 1),
        (Fault("value", "HAPTICS_STATE", LeftThighFront_Amplitude=0.3), "0.4", 0),
        (Fault("value", "HAPTICS_STATE", LeftThighFront_Amplitude=0.0), "0.05", 0),  # too short to check
        (Fault("drop", "HAPTICS_STATE"), "0.4", 1),
        (Fault("drop", "HAPTICS_COMMAND"), "0.4", 1),
    ],
)
def test_motor_that_does_not_reach_half_of_its_level_ends_with_1(
    monkeypatch: pytest.MonkeyPatch, fault: Fault, seconds: str, code: int
) -> None:
    monkeypatch.setattr(rig_module, "open_hal", partial(rig_module.open_hal, faults=[fault]))
    result = vibrate("left_thigh_front", "0.5", "--for", seconds)
    assert result.exit_code == code, result.stderr
    assert ("left_thigh_front must reach half of the commanded level 0.5, but at most" in result.stderr) == bool(code)
    assert "the robot is in HOLD\n" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["left_thigh_fron", "0.5"], "got 'left_thigh_fron'. Did you mean left_thigh_front"),
        (["nose", "0.5"], f"motor must be one of {', '.join(MOTORS)}, got 'nose'"),
        (["left_thigh_front", "50"], "50.0 is not in the range 0.0<=x<=1.0"),
        (["left_thigh_front", "0.5", "--for", "0"], "0.0 is not in the range"),
        (["left_thigh_front"], "Missing argument 'LEVEL'"),
    ],
)
def test_invalid_command_line_prints_one_sentence_and_exits_with_2(arguments: list[str], sentence: str) -> None:
    result = vibrate(*arguments)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1
