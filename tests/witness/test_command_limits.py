"""Tests of the independent command check: it covers every HAL of a test, in all processes, and reports each violation."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_limits import FD, RECORD, CommandLimits, main

from atalante_dbc import load
from atalante_hal.robot import load_robot
from atalante_hal.safety.limiter import Limiter
from atalante_hal.types import Command, SupervisorState
from atalante_hal.wire.cia402 import Controlword
from atalante_hal.wire.process_image import TransmitImage

NETWORK, ROBOT = load(), load_robot()
LIMIT = ROBOT.torque_max.copy()


@pytest.fixture
def transmit() -> TransmitImage:
    """Return the two command frames with enabled drives and zero torque."""
    image = TransmitImage([NETWORK.message("COMMAND_LEFT_LEG"), NETWORK.message("COMMAND_RIGHT_LEG")])
    image.values[image.codec.slice("Controlword")] = Controlword.ENABLE_OPERATION
    image.values[image.codec.slice("MaxTorque")] = LIMIT
    return image


def violations_of(image: TransmitImage, *torques: Any) -> list[str]:
    check = CommandLimits()
    for torque in torques:
        image.values[image.codec.slice("TargetTorque")] = torque
        check.check(image.seal().view(np.uint8).view(RECORD))
    assert check.command_frames == 2 * len(torques)
    return check.violations


def test_commands_within_the_limits_have_no_violations(transmit: TransmitImage) -> None:
    step = ROBOT.torque_rate_max * 1e-3
    assert violations_of(transmit, np.zeros(12), step, 2 * step, step) == []
    assert violations_of(transmit, LIMIT, LIMIT - step, LIMIT) == []
    assert violations_of(transmit, -LIMIT) == []


@pytest.mark.parametrize("joint", range(12))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_or_torque_limit_above_the_joint_limit_is_reported(
    transmit: TransmitImage, joint: int, sign: float
) -> None:
    torque = np.zeros(12)
    torque[joint] = sign * (LIMIT[joint] + 0.02)
    (violation,) = violations_of(transmit, torque)
    assert f"allowed is {LIMIT[joint]} Nm" in violation
    transmit.values[transmit.codec.slice("MaxTorque").start + joint] = LIMIT[joint] + 0.02
    (violation,) = violations_of(transmit, np.zeros(12))
    assert f"with limit {LIMIT[joint] + 0.02:.2f}" in violation.replace("00 Nm", " Nm")


@pytest.mark.parametrize("joint", range(12))
def test_step_above_the_rate_is_reported_only_between_enabled_frames(transmit: TransmitImage, joint: int) -> None:
    torque = np.zeros(12)
    torque[joint] = ROBOT.torque_rate_max[joint] * 1e-3 + 0.03
    (violation,) = violations_of(transmit, np.zeros(12), torque)
    assert "moves by 20.0250 Nm in a cycle" in violation
    assert len(violations_of(transmit, -torque, 0.0 * torque, torque)) == 2
    words = transmit.values[transmit.codec.slice("Controlword")]
    words[joint] = Controlword.QUICK_STOP
    assert violations_of(transmit, np.zeros(12), torque) == []
    words[joint] = Controlword.ENABLE_OPERATION


def test_frame_of_another_sender_length_or_format_is_reported(transmit: TransmitImage) -> None:
    frame = transmit.seal()[:1].view(np.uint8).view(RECORD).copy()
    for field, value, expected in (
        ("id", NETWORK.message("LEFT_SK_STATE").frame_id, "0x184, which is none of its messages"),
        ("id", 0x100 | 1 << 31, "which is none of its messages"),
        ("length", 32, "COMMAND_LEFT_LEG with 32 bytes"),
        ("flags", 0, f"flags {0:#x}"),
    ):
        wrong = frame.copy()
        wrong[field] = value
        check = CommandLimits()
        (violation,) = check.check(wrong)
        assert expected in violation
    assert frame["flags"][0] & FD


def test_command_line_checks_a_can_log(
    make_rig: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = make_rig()
    rig.until(SupervisorState.ACTIVE)
    rig.run(50)
    lines = [
        f"({number * 1e-3:.6f}) can0 {frame['can_id']:03X}##5{frame['data'][: frame['len']].tobytes().hex()}"
        for number, frames in enumerate(rig.sent)
        for frame in frames
    ]
    log, empty = tmp_path / "run.log", tmp_path / "empty.log"
    log.write_text("\n".join(lines) + "\n")
    empty.write_text(lines[0] + "\n")
    commands = 2 * rig.hal.state.cycle
    assert main([str(log)]) == 0
    assert capsys.readouterr().out == f"{log}: {commands} command frames: ok\n"
    assert main([str(empty)]) == 1
    assert "no command frame in it" in capsys.readouterr().out


def test_call_without_a_log_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert capsys.readouterr().err == "usage: python tests/witness/command_limits.py LOG...\n"


def test_log_that_cannot_be_read_fails_the_check_and_the_next_log_is_still_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text.log").write_text("not a frame\n")
    (tmp_path / "notes.md").write_text("not a log\n")
    paths = [str(tmp_path / name) for name in ("missing.log", "notes.md", "text.log")]
    assert main(paths) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(": ")[0] for line in lines] == paths
    assert lines[0].endswith(": cannot be read: No such file or directory")
    assert ".md" in lines[1]


def test_witness_counts_frames_of_a_hal_in_this_process(make_rig: Callable[..., Any], witness: Any) -> None:
    witness.check()
    hals, frames = witness.counts
    rig = make_rig()
    rig.run(40)
    assert witness.check() == []
    assert witness.counts == (hals + 1, frames + 2 * 40)


def test_witness_reports_a_limiter_without_limits(
    make_rig: Callable[..., Any], witness: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig()
    rig.until(SupervisorState.ACTIVE)

    def bypass_limits(limiter: Limiter, torque: np.ndarray, *others: Any) -> Any:
        found = apply(limiter, np.zeros(12), *others)
        limiter.last[:] = torque
        return found

    apply = Limiter.apply
    monkeypatch.setattr(Limiter, "apply", bypass_limits)
    assert witness.check() == []
    rig.hal.read()
    rig.hal.write(Command(LIMIT + 1.0, np.zeros(8)))
    (violation,) = witness.check()
    assert "allowed is 350.0 Nm" in violation
    assert "in a cycle" in violation


@pytest.mark.parametrize("killed", [False, True])
def test_witness_counts_frames_of_a_hal_in_a_subprocess(witness: Any, killed: bool) -> None:
    program = (
        "import os, sys\n"
        "from atalante_dbc import load\n"
        "from atalante_hal.bus.pair import lockstep_pair\n"
        "from atalante_hal.hal import Hal\n"
        "from atalante_hal.robot import load_robot\n"
        "hal = Hal(load(), load_robot(), lockstep_pair()[0], patience=0.0)\n"
        "for _ in range(25):\n"
        "    hal.read()\n"
        "    hal.hold()\n"
        "if sys.argv[1] == 'True':\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    hals, frames = witness.counts
    done = subprocess.run([sys.executable, "-c", program, str(killed)], check=False, env=os.environ)
    assert done.returncode == (-9 if killed else 0)
    assert witness.check() == []
    assert witness.counts == (hals + 1, frames + 2 * 25)
