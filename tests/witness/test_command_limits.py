"""The independent judge of commands: it sees every HAL of a test, here and in other processes, and it finds what is wrong."""

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
    """The two command frames, enabled, without torque."""
    image = TransmitImage([NETWORK.message("COMMAND_LEFT_LEG"), NETWORK.message("COMMAND_RIGHT_LEG")])
    image.values[image.codec.slice("Controlword")] = Controlword.ENABLE_OPERATION
    image.values[image.codec.slice("MaxTorque")] = LIMIT
    return image


def judged(image: TransmitImage, *torques: Any) -> list[str]:
    judge = CommandLimits()
    for torque in torques:
        image.values[image.codec.slice("TargetTorque")] = torque
        judge.judge(image.seal().view(np.uint8).view(RECORD))
    assert judge.command_frames == 2 * len(torques)
    return judge.violations


def test_what_is_allowed_is_allowed(transmit: TransmitImage) -> None:
    step = ROBOT.torque_rate_max * 1e-3
    assert judged(transmit, np.zeros(12), step, 2 * step, step) == []
    assert judged(transmit, LIMIT, LIMIT - step, LIMIT) == []
    assert judged(transmit, -LIMIT) == []


@pytest.mark.parametrize("joint", range(12))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_torque_or_a_limit_beyond_the_joints_is_found(transmit: TransmitImage, joint: int, sign: float) -> None:
    torque = np.zeros(12)
    torque[joint] = sign * (LIMIT[joint] + 0.02)
    (told,) = judged(transmit, torque)
    assert f"allowed is {LIMIT[joint]} Nm" in told
    transmit.values[transmit.codec.slice("MaxTorque").start + joint] = LIMIT[joint] + 0.02
    (told,) = judged(transmit, np.zeros(12))
    assert f"with limit {LIMIT[joint] + 0.02:.2f}" in told.replace("00 Nm", " Nm")


@pytest.mark.parametrize("joint", range(12))
def test_a_step_above_the_rate_is_found_between_two_enabled_frames_only(transmit: TransmitImage, joint: int) -> None:
    torque = np.zeros(12)
    torque[joint] = ROBOT.torque_rate_max[joint] * 1e-3 + 0.03
    (told,) = judged(transmit, np.zeros(12), torque)
    assert "moves by 20.0250 Nm in a cycle" in told
    assert len(judged(transmit, -torque, 0.0 * torque, torque)) == 2
    words = transmit.values[transmit.codec.slice("Controlword")]
    words[joint] = Controlword.QUICK_STOP
    assert judged(transmit, np.zeros(12), torque) == []
    words[joint] = Controlword.ENABLE_OPERATION


def test_a_frame_of_somebody_else_or_of_another_shape_is_found(transmit: TransmitImage) -> None:
    frame = transmit.seal()[:1].view(np.uint8).view(RECORD).copy()
    for field, value, said in (
        ("id", NETWORK.message("LEFT_SK_STATE").frame_id, "0x184, which is none of its messages"),
        ("id", 0x100 | 1 << 31, "which is none of its messages"),
        ("length", 32, "COMMAND_LEFT_LEG with 32 bytes"),
        ("flags", 0, f"flags {0:#x}"),
    ):
        wrong = frame.copy()
        wrong[field] = value
        judge = CommandLimits()
        (told,) = judge.judge(wrong)
        assert said in told
    assert frame["flags"][0] & FD


def test_a_log_is_judged_on_the_command_line(
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


def test_the_witness_sees_what_a_hal_in_this_process_sends(make_rig: Callable[..., Any], witness: Any) -> None:
    witness.judge()
    hals, frames = witness.counts
    rig = make_rig()
    rig.run(40)
    assert witness.judge() == []
    assert witness.counts == (hals + 1, frames + 2 * 40)


def test_the_witness_finds_a_limiter_that_lets_everything_through(
    make_rig: Callable[..., Any], witness: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig()
    rig.until(SupervisorState.ACTIVE)

    def let_through(limiter: Limiter, torque: np.ndarray, *others: Any) -> Any:
        found = apply(limiter, np.zeros(12), *others)
        limiter.last[:] = torque
        return found

    apply = Limiter.apply
    monkeypatch.setattr(Limiter, "apply", let_through)
    assert witness.judge() == []
    rig.hal.read()
    rig.hal.write(Command(LIMIT + 1.0, np.zeros(8)))
    (told,) = witness.judge()
    assert "allowed is 350.0 Nm" in told
    assert "in a cycle" in told


@pytest.mark.parametrize("killed", [False, True])
def test_the_witness_sees_what_a_hal_in_another_process_sent(witness: Any, killed: bool) -> None:
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
    assert witness.judge() == []
    assert witness.counts == (hals + 1, frames + 2 * 25)
