"""`atalante doctor`: all checks on simulated machines and on this machine."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import can
import pytest
from click.testing import CliRunner

from atalante_hal.bus.adapters import ADAPTERS
from atalante_tools.cli import cli
from atalante_tools.commands import machine as machine_module
from atalante_tools.commands.doctor import CheckResult, examine
from atalante_tools.commands.machine import Interface, ThisMachine

GOOD = Interface("vcan0", virtual=True, up=True, mtu=72, queue=1000)


@dataclass
class AnyMachine:
    """Simulated machine that passes all checks unless a field is changed."""

    refusal: str | None = None
    has_vcan: bool = True
    present: list[Interface] = field(default_factory=lambda: [GOOD])
    priority: int = 99
    memory: int | None = None
    lacks: tuple[str, ...] = ()
    opening: str | None = None

    def can_socket(self) -> str | None:
        return self.refusal

    def vcan(self) -> bool:
        return self.has_vcan

    def interfaces(self) -> list[Interface]:
        return self.present

    def open_channel(self, interface: str, channel: str) -> str | None:
        return self.opening

    def realtime_priority(self) -> int:
        return self.priority

    def locked_memory(self) -> int | None:
        return self.memory

    def package(self, name: str) -> bool:
        return name not in self.lacks

    def program(self, name: str) -> bool:
        return name not in self.lacks


def missing(machine: AnyMachine, interface: str, *channels: str) -> dict[str, CheckResult]:
    return {check.name: check for check in examine(machine, interface, channels) if not check.ok}


def needed(machine: AnyMachine, interface: str, *channels: str) -> list[str]:
    return [name for name, check in missing(machine, interface, *channels).items() if check.needed]


@pytest.mark.parametrize(("interface", "channels"), [("embedded", ()), ("socketcan", ("vcan0",)), ("pcan", ("x",))])
def test_all_checks_pass_on_a_complete_machine(interface: str, channels: tuple[str, ...]) -> None:
    assert missing(AnyMachine(), interface, *channels) == {}


def test_an_absent_adapter_is_not_replaced_by_a_virtual_interface() -> None:
    check = missing(AnyMachine(), "socketcan", "can0")["can0"]
    assert check.text.startswith("this interface does not exist: plug the adapter in and load its driver")
    assert check.fix == "ip -br link show type can"


def test_a_kernel_without_can_fails_only_for_socketcan() -> None:
    bare = AnyMachine(refusal="Address family not supported by protocol", present=[])
    assert needed(bare, "embedded") == []
    assert needed(bare, "pcan", "x") == []
    assert needed(bare, "socketcan", "vcan0") == ["AF_CAN", "vcan", "vcan0"]
    assert needed(bare, "socketcan", "can0") == ["AF_CAN", "can0"]
    assert "modprobe can-raw" in missing(bare, "socketcan", "can0")["AF_CAN"].fix


@pytest.mark.parametrize(
    ("interface", "fix"),
    [
        (Interface("vcan0", True, True, 16, 1000), "ip link set vcan0 down; ip link set vcan0 mtu 72 up"),
        (
            Interface("can0", False, True, 16, 1000),
            "ip link set can0 down; ip link set can0 up type can bitrate 1000000 dbitrate 5000000 fd on",
        ),
        (Interface("vcan0", True, False, 72, 1000), "ip link set vcan0 up"),
    ],
)
def test_an_unusable_interface_fails_with_the_command_that_repairs_it(interface: Interface, fix: str) -> None:
    found = missing(AnyMachine(present=[interface]), "socketcan", interface.name)
    assert list(found) == [interface.name]
    assert found[interface.name].needed
    assert found[interface.name].fix == fix


def test_a_short_transmit_queue_is_reported_but_not_required() -> None:
    found = missing(AnyMachine(present=[Interface("can0", False, True, 72, 10)]), "socketcan", "can0")
    assert not found["can0"].needed
    assert found["can0"].fix == "ip link set can0 txqueuelen 1000"


def test_a_missing_channel_fails_with_the_command_that_creates_it() -> None:
    found = missing(AnyMachine(), "socketcan", "vcan0", "vcan1")
    assert list(found) == ["vcan1"]
    assert found["vcan1"].fix == "ip link add vcan1 type vcan && ip link set vcan1 mtu 72 txqueuelen 1000 up"


def test_without_a_channel_all_interfaces_are_listed_and_none_is_required() -> None:
    machine = AnyMachine(present=[GOOD, Interface("can7", False, False, 72, 1000)])
    assert needed(machine, "socketcan") == []
    assert list(missing(machine, "socketcan")) == ["can7"]


def test_pybullet_is_required_for_embedded_and_pinocchio_always() -> None:
    machine = AnyMachine(lacks=("pybullet", "mujoco", "pinocchio", "zenoh", "mcap", "matplotlib", "gcc", "candump"))
    assert needed(machine, "embedded") == ["pinocchio", "pybullet"]
    assert needed(AnyMachine(lacks=("pybullet",)), "embedded") == []
    assert needed(machine, "socketcan", "vcan0") == ["pinocchio"]
    assert set(missing(machine, "embedded")) == set(machine.lacks)
    assert missing(machine, "embedded")["zenoh"].fix == "pip install 'atalante-hal[telemetry]'"


def test_an_unknown_interface_fails_with_the_list_of_usable_interfaces() -> None:
    found = missing(AnyMachine(), "pigeon", "x")
    assert found["python-can"].needed
    assert "there is no CAN interface 'pigeon'" in found["python-can"].text
    assert "socketcan" in found["python-can"].fix
    assert "virtual" not in found["python-can"].fix


@pytest.mark.parametrize("interface", ["pcan", "socketcan"])
def test_a_channel_that_cannot_be_opened_fails_with_the_error_of_the_bus(interface: str) -> None:
    found = missing(AnyMachine(opening="no such device"), interface, "vcan0")
    assert list(found) == ["vcan0"]
    assert found["vcan0"].needed
    assert found["vcan0"].text == "no such device"


def test_missing_realtime_limits_are_reported_but_not_required() -> None:
    machine = AnyMachine(priority=0, memory=8 << 20)
    assert needed(machine, "socketcan", "vcan0") == []
    found = missing(machine, "socketcan", "vcan0")
    assert "no SCHED_FIFO" in found["real-time priority"].text
    assert "8192 KiB" in found["locked memory"].text


def test_every_failed_check_has_a_command_that_repairs_it() -> None:
    worst = AnyMachine(
        "no such family",
        False,
        [],
        0,
        0,
        ("pybullet", "mujoco", "pinocchio", "zenoh", "mcap", "matplotlib", "gcc", "candump"),
    )
    for interface in ("embedded", "socketcan", "pigeon"):
        for check in missing(worst, interface).values():
            assert check.fix, check


# -- this machine ----------------------------------------------------------------------------------------------------


def sys_tree(root: Path, **interfaces: tuple[int, str, int, int, bool]) -> ThisMachine:
    for name, (kind, flags, mtu, queue, hardware) in interfaces.items():
        folder = root / "class/net" / name
        folder.mkdir(parents=True)
        for file, value in (("type", kind), ("flags", flags), ("mtu", mtu), ("tx_queue_len", queue)):
            (folder / file).write_text(f"{value}\n")
        if hardware:
            (folder / "device").mkdir()
    return ThisMachine(root)


def test_can_interfaces_are_read_from_sys(tmp_path: Path) -> None:
    machine = sys_tree(
        tmp_path,
        eth0=(1, "0x1003", 1500, 1000, True),
        can0=(280, "0x40080", 72, 10, True),
        vcan0=(280, "0xc1", 16, 1000, False),
    )
    assert machine.interfaces() == [
        Interface("can0", virtual=False, up=False, mtu=72, queue=10),
        Interface("vcan0", virtual=True, up=True, mtu=16, queue=1000),
    ]
    assert machine.vcan()


def test_vcan_is_found_as_a_module_without_interfaces(tmp_path: Path) -> None:
    assert not ThisMachine(tmp_path).vcan()
    (tmp_path / "module/vcan").mkdir(parents=True)
    assert ThisMachine(tmp_path).vcan()


def test_this_machine_returns_a_value_for_every_query() -> None:
    machine = ThisMachine()
    assert machine.package("numpy")
    assert not machine.package("no_such_package_at_all")
    assert machine.program("sh")
    assert not machine.program("no-such-program-at-all")
    assert machine.realtime_priority() >= 0
    assert (machine.locked_memory() or 0) >= 0
    assert machine.can_socket() is None or isinstance(machine.can_socket(), str)


# -- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> AnyMachine:
    machine = AnyMachine(refusal="Address family not supported by protocol", present=[])
    monkeypatch.setattr(machine_module, "ThisMachine", lambda: machine)
    return machine


def test_the_exit_code_is_0_when_all_required_checks_pass(bare: AnyMachine) -> None:
    result = CliRunner().invoke(cli, ["doctor"])
    assert result.exit_code == 0
    assert (
        "no    AF_CAN: no SocketCAN (Address family not supported by protocol)\n       type: modprobe" in result.stdout
    )


def test_the_exit_code_is_1_and_the_error_lists_failed_checks(bare: AnyMachine) -> None:
    result = CliRunner().invoke(
        cli, ["doctor", "-i", "socketcan", "-c", "left_leg=can0,right_leg=can1,left_sense=can0,right_sense=can1"]
    )
    assert result.exit_code == 1
    assert (
        result.stderr
        == "atalante: socketcan left_leg=can0,right_leg=can1,left_sense=can0,right_sense=can1 is not ready: AF_CAN, can0, can1\n"
    )


def test_the_error_gives_the_reason_if_only_the_channel_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        machine_module, "ThisMachine", lambda: AnyMachine(opening="the channel must be a URL, got WRONG")
    )
    result = CliRunner().invoke(cli, ["doctor", "-i", "remote", "-c", "WRONG"])
    assert result.exit_code == 1
    assert result.stderr == "atalante: remote WRONG is not ready: the channel must be a URL, got WRONG\n"


def test_json_prints_one_check_per_line(bare: AnyMachine) -> None:
    result = CliRunner().invoke(cli, ["doctor", "-i", "socketcan", "-c", "vcan0", "--json"])
    *checks, last = [json.loads(line) for line in result.stdout.splitlines()]
    assert last["known"]["can_fd"]
    assert {tuple(check) for check in checks} == {("name", "ok", "needed", "text", "fix")}
    assert [c["name"] for c in checks if c["needed"] and not c["ok"]] == ["AF_CAN", "vcan", "vcan0"]
    assert all(bool(c["fix"]) is not c["ok"] for c in checks)


def test_channel_of_the_embedded_robot_is_a_usage_error() -> None:
    result = CliRunner().invoke(cli, ["doctor", "-c", "vcan0"])
    assert result.exit_code == 2
    assert "the embedded robot has no channel; to check vcan0, type -i socketcan -c vcan0" in result.stderr


def opens(arguments: list[str]) -> bool:
    """Return whether `atalante status` opens the bus. Without frames it then fails with code 1."""
    result = CliRunner().invoke(cli, ["status", *arguments, "--for", "0.05"])
    assert result.exit_code in (1, 2, 3), result.output
    return result.exit_code == 1


@pytest.mark.parametrize("interface", [*ADAPTERS, "pigeon"])
def test_doctor_and_the_commands_agree_on_every_interface(interface: str) -> None:
    """This machine has no adapters; the next test checks a channel that opens."""
    arguments = ["-i", interface, "-c", "0"]
    result = CliRunner().invoke(cli, ["doctor", *arguments, "--json"])
    *checks, last = map(json.loads, result.stdout.splitlines())
    assert last["interface"] == interface
    bus = [check["ok"] for check in checks if check["needed"] and check["name"] in ("python-can", "AF_CAN", "0")]
    assert bus
    assert all(bus) == opens(arguments)


@pytest.mark.parametrize("reason", ["", "the driver is missing"])
def test_doctor_and_the_commands_agree_whether_a_channel_opens(reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def bus(**options: object) -> object:
        if reason:
            raise can.CanInitializationError(reason)
        return SimpleNamespace(protocol=can.CanProtocol.CAN_FD, recv=lambda timeout: None, shutdown=lambda: None)

    monkeypatch.setattr(can, "Bus", bus)
    arguments = ["-i", "kvaser", "-c", "0"]
    result = CliRunner().invoke(cli, ["doctor", *arguments])
    assert (result.exit_code == 0) == opens(arguments) == (not reason)
    assert reason in result.stdout


@pytest.mark.parametrize("interface", ADAPTERS)
def test_properties_of_an_interface_are_printed(interface: str) -> None:
    adapter, result = ADAPTERS[interface], CliRunner().invoke(cli, ["doctor", "-i", interface])
    assert f"interface {interface}\n  CAN FD:     {'yes' if adapter.can_fd else 'no'}" in result.stdout
    for text in (adapter.channel, adapter.install, adapter.note, adapter.tried, adapter.source):
        assert text in result.stdout
    for key, value in adapter.options:
        assert f"    {key} = {value}\n" in result.stdout + "\n"
