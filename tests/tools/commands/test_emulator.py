"""`atalante emulator`: the emulated robot answers on a bus until Ctrl-C and prints a status line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from click.testing import CliRunner, Result

from atalante_control.dynamics.gait_network import DEFAULT_NETWORK
from atalante_control.gait.subject import patient_of
from atalante_control.gait.walk import DEFAULT_WALK, load_walk
from atalante_control.model import ExoskeletonParameters, Patient, urdf
from atalante_dbc import Network
from atalante_hal.bus import BusDown
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.cli import cli
from atalante_tools.commands import emulator as emulator_module
from atalante_tools.console.stop_request import StopRequest
from atalante_tools.session import body as body_module
from atalante_tools.session import rig as rig_module


class OtherProcess:
    """HAL at the other end of the bus: one cycle per poll of the emulator, and SIGINT after `cycles` cycles."""

    def __init__(self, network: Network, robot: Robot, cycles: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.hal_bus, self.bus = lockstep_pair()
        self.hal = Hal(network, robot, self.hal_bus)
        self.stop = StopRequest()
        self.tap: list[Frames] = []
        self._cycles = cycles
        self.bus.step = self.cycle
        self.active_at: int | None = None
        monkeypatch.setattr(rig_module, "open_buses", lambda network, target: dict.fromkeys(network.buses, self.bus))

        @contextmanager
        def stop_requested() -> Iterator[StopRequest]:
            yield self.stop

        monkeypatch.setattr(emulator_module, "stop_requested", stop_requested)
        monkeypatch.setattr(emulator_module, "LISTEN", 0.0)

    def cycle(self) -> None:
        if self.stop.wanted:
            return
        state = self.hal.read()
        self.hal.hold()
        if self.hal.state.supervisor is SupervisorState.ACTIVE and self.active_at is None:
            self.active_at = state.cycle
        if state.cycle >= self._cycles:
            self.stop.ask(2)

    def run(self, *arguments: str) -> Result:
        return CliRunner().invoke(cli, ["emulator", "-i", "pcan", "-c", "test", "--lockstep", *arguments])


def test_a_hal_on_the_bus_receives_every_node_and_becomes_active(
    network: Network, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = OtherProcess(network, robot, 400, monkeypatch)
    result = other.run("--xi", "0.3")
    assert result.exit_code == 130, result.stderr
    assert result.stdout == ""
    assert result.stderr.startswith(
        "the emulated robot is on pcan test; now type in another terminal: atalante airwalk -i pcan -c test\n"
    )
    assert other.active_at is not None
    assert other.hal.missing() == []
    assert other.hal.state.assistance_factor == pytest.approx(0.3, abs=1e-4)
    with pytest.raises(BusDown):
        other.bus.receive(new_frames(1))


def test_without_the_emulated_operator_the_hal_stays_ready(
    network: Network, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = OtherProcess(network, robot, 500, monkeypatch)
    result = other.run("--no-operator")
    assert "to operate it, type: atalante pendant start -i pcan -c test" in result.stderr
    assert other.active_at is None
    assert other.hal.state.supervisor is SupervisorState.READY


def test_the_legs_are_adjusted_to_the_given_patient(
    network: Network, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    bodies: list[str] = []
    opened = body_module.open_mechanics
    monkeypatch.setattr(
        body_module, "open_mechanics", lambda mechanics: (bodies.append(mechanics.urdf), opened(mechanics))[1]
    )
    for arguments in ((), ("--mass", "75", "--height", "175", "--shank", "0.42")):
        result = OtherProcess(network, robot, 5, monkeypatch).run(*arguments)
        assert result.exit_code == 130, result.stderr
    exoskeleton = ExoskeletonParameters()
    assert bodies == [urdf(exoskeleton, robot), urdf(exoskeleton.fitted(Patient(75.0, 1.75, None, 0.42)), robot)]
    assert "atalante airwalk -i pcan -c test --mass 75 --height 1.75 --shank 0.42\n" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "other_side"),
    [
        (("--gait", str(DEFAULT_WALK)), f"airwalk -i pcan -c test --gait {DEFAULT_WALK}"),
        (
            ("--network", str(DEFAULT_NETWORK), "--mass", "75", "--height", "175"),
            f"airwalk -i pcan -c test --mass 75 --height 1.75 --network {DEFAULT_NETWORK}",
        ),
        (
            ("--ground", "--engine", "mujoco", "--gait", str(DEFAULT_WALK)),
            f"walk -i pcan -c test --gait {DEFAULT_WALK}",
        ),
        (("--ground", "--engine", "mujoco"), "walk -i pcan -c test"),
    ],
    ids=["gait", "network", "ground", "ground, default patient"],
)
def test_the_legs_are_adjusted_to_the_patient_of_the_gait(
    arguments: tuple[str, ...], other_side: str, network: Network, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    bodies: list[str] = []
    opened = body_module.open_mechanics
    monkeypatch.setattr(
        body_module, "open_mechanics", lambda mechanics: (bodies.append(mechanics.urdf), opened(mechanics))[1]
    )
    result = OtherProcess(network, robot, 5, monkeypatch).run(*arguments)
    assert result.exit_code == 130, result.stderr
    patient = patient_of(load_walk(DEFAULT_WALK, robot).step.parameters)
    worn = patient if "--ground" in arguments else None
    assert bodies == [urdf(ExoskeletonParameters().fitted(patient), robot, worn)]
    assert f"now type in another terminal: atalante {other_side}\n" in result.stderr


def test_equal_seeds_give_equal_sensor_noise(network: Network, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(seed: str) -> bytes:
        other = OtherProcess(network, robot, 50, monkeypatch)
        assert other.run("--seed", seed).exit_code == 130
        return other.hal.state.imu_accel.tobytes()

    assert measured("1") == measured("1")
    assert measured("1") != measured("2")


def test_the_status_line_counts_cycles_frames_and_drives(
    network: Network, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(emulator_module, "STATUS_PERIOD", 1e-9)
    result = OtherProcess(network, robot, 20, monkeypatch).run()
    lines = [line for line in result.stderr.splitlines() if "cycles" in line]
    assert lines[0] == (
        "0 cycles, 0 frames in, 0 out; drives: 12 SWITCH_ON_DISABLED; no SYNC received: waiting for a HAL"
    )
    assert "no SYNC" not in lines[-1]
    # Every cycle the emulator receives 7 frames and sends 19, plus slower messages.
    cycles, frames_in, frames_out = (int(word) for word in lines[-1].split() if word.isdigit() and word != "12")
    assert frames_in == 7 * cycles
    assert 19 * cycles < frames_out < 21 * cycles


def test_emulator_does_not_start_while_another_robot_answers(
    network: Network, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = OtherProcess(network, robot, 400, monkeypatch)
    monkeypatch.setattr(emulator_module, "LISTEN", 5.0)
    other.bus.step = lambda: None
    other.hal_bus.send(TransmitImage([network.message("LEFT_SH_STATE")]).seal(7))
    result = other.run()
    assert result.exit_code == 1
    assert result.stderr == "atalante: another robot answers on pcan test (received LEFT_SH_STATE): stop it first\n"
    assert other.hal_bus.receive(new_frames(1)) == 0


def test_another_robot_that_starts_later_is_reported_once(
    network: Network, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(emulator_module, "STATUS_PERIOD", 1e-9)
    other = OtherProcess(network, robot, 40, monkeypatch)
    image, cycle = TransmitImage([network.message("IMU_TORSO_STATE")]), other.bus.step

    def with_another_robot() -> None:
        cycle()
        if other.hal.state.cycle > 20:
            other.hal_bus.send(image.seal(other.hal.state.cycle & 0xFF))

    other.bus.step = with_another_robot
    result = other.run()
    assert result.exit_code == 130, result.stderr
    printed = result.stderr.splitlines()
    notice = "another robot answers, too (received IMU_TORSO_STATE): stop one of them; the HAL refuses START"
    assert printed.count(notice) == 1
    after = [line for line in printed[printed.index(notice) :] if "cycles" in line]
    assert after[-1].endswith("drives: 12 SWITCH_ON_DISABLED; another robot answers, too")
    assert not any("another robot" in line for line in printed[: printed.index(notice)])


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["-i", "pcan", "-c", "x", "--no-operator", "--xi", "0.5"], "--xi requires the emulated operator"),
        (["-i", "pcan", "-c", "x", "--xi", "2"], "2.0 is not in the range"),
        (["-i", "pcan", "-c", "x", "--mass", "75"], "a patient requires both --mass and --height"),
        (["-i", "embedded"], "this command requires a CAN bus, got -i embedded"),
        ([], "socketcan requires a channel: -c vcan0"),
    ],
)
def test_invalid_command_line_prints_one_sentence_and_exits_with_2(arguments: list[str], sentence: str) -> None:
    result = CliRunner().invoke(cli, ["emulator", *arguments])
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1
