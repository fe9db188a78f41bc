"""The command line as a whole: help, version, exit codes, one sentence per error, only JSON on stdout, start-up."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import click
import pytest
from click.testing import CliRunner

from atalante_control.gait.gait import GaitError
from atalante_control.guide.shapes import SHAPES
from atalante_dbc import DbcError
from atalante_hal.bus import BusAbsent, BusDown, BusError, BusFull
from atalante_hal.bus.channel_map import ChannelMapError
from atalante_hal.bus.replay import LogUnreadable
from atalante_hal.robot import JOINTS, MOTORS, RobotError
from atalante_hal.telemetry.access import AccessError
from atalante_hal.telemetry.process import TelemetryError
from atalante_hal.telemetry.ring import RingError
from atalante_hal.telemetry.sink import SinkError
from atalante_tools import cli as cli_module
from atalante_tools.cli import COMMANDS, Commands, cli
from atalante_tools.console.outcome import KNOWN, Failed, FaultLatched

#: Modules that load slowly; `--help` must not import them.
SLOW = {"numpy", "can", "cantools", "pybullet", "pinocchio", "zenoh", "mcap", "matplotlib", "atalante_dbc"}


def atalante(*arguments: str) -> list[str]:
    return [sys.executable, "-c", "from atalante_tools.cli import main; main()", *arguments]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(atalante(*arguments), capture_output=True, text=True, timeout=120, check=False)


# -- help ------------------------------------------------------------------------------------------------------------


def help_texts(command: click.Command, path: list[str]) -> Iterator[str]:
    """Yield the help of a command and of all its subcommands."""
    result = CliRunner().invoke(cli, [*path, "--help"])
    assert (result.exit_code, result.stderr) == (0, "")
    yield result.stdout
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            child = command.get_command(context, name)
            assert child is not None
            yield from help_texts(child, [*path, name])


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(name: str) -> None:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    first, *others = help_texts(command, [name])
    assert "Example: atalante " in first
    assert all(len(text.split("Options:")[0].splitlines()) > 2 for text in others)


def test_the_list_of_commands_is_complete_and_in_order() -> None:
    result = CliRunner().invoke(cli, ["--help"])
    assert result.exit_code == 0
    listed = [line.split()[0] for line in result.stdout.split("Commands:\n")[1].splitlines() if line[2:3] != " "]
    assert listed == list(COMMANDS)
    text = " ".join(result.stdout.split())
    assert "0 ok, 1 failed, 2 usage error, 3 no device, 4 fault latched, 129 SIGHUP, 130 Ctrl-C, 143 SIGTERM." in text


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_output_of_the_group_to_a_full_device_fails_with_one_sentence(option: str) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            atalante(option), stdout=full, stderr=subprocess.PIPE, text=True, timeout=120, check=False
        )
    assert done.returncode == 1
    assert done.stderr == "atalante: the output file cannot be read or written: No space left on device\n"


def test_help_and_version_import_no_slow_module() -> None:
    program = """
import sys
from atalante_tools.cli import cli
cli(["--help"], standalone_mode=False)
cli(["jog", "--help"], standalone_mode=False)
cli(["--version"], standalone_mode=False)
print(sorted(sys.modules), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert not SLOW & set(eval(done.stderr))
    assert done.stdout.splitlines()[-1].startswith("atalante ")


def test_help_of_jog_contains_the_units() -> None:
    text = CliRunner().invoke(cli, ["jog", "--help"]).stdout
    assert "degrees" in text
    assert "deg/s" in text


@pytest.mark.parametrize("group", ["pendant", "dbc", "faults", "gait"])
def test_the_command_list_of_a_group_has_one_full_sentence_per_line(group: str) -> None:
    text = CliRunner().invoke(cli, [group, "--help"], terminal_width=80).stdout
    lines = text.split("Commands:\n")[1].splitlines()
    assert len(lines) >= 3
    assert all(line.startswith("  ") and line[2] != " " and line.endswith(".") for line in lines)
    assert "..." not in "".join(lines)


@pytest.mark.parametrize(
    ("command", "names"), [("jog", JOINTS), ("vibrate", MOTORS), ("demo", SHAPES), ("airwalk", SHAPES)]
)
def test_help_lists_all_valid_names(command: str, names: Sequence[str]) -> None:
    words = set(re.findall(r"\w+", CliRunner().invoke(cli, [command, "--help"]).stdout))
    for name in names:
        side, *rest = name.split("_")
        parts = [f"{side}_", *(f"{part}_" for part in rest[:-1]), rest[-1]] if rest else [name]
        assert words.issuperset(parts), (command, name)


# -- errors ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that runs the command `jog` with a given error."""

    def fail(error: BaseException) -> Any:
        @click.command()
        def command() -> None:
            raise error

        monkeypatch.setattr(Commands, "get_command", lambda *_: command)
        return CliRunner().invoke(cli, ["jog"])

    return fail


@pytest.mark.parametrize(
    ("arguments", "command"),
    [
        (["walk", "--then", "3", "0.18"], "atalante walk"),
        (["jog", "left_SK", "--to"], "atalante jog"),
        (["guide", "check", "--push", "3"], "atalante guide check"),
        (["dbc", "busload", "--nope"], "atalante dbc busload"),
        (["dbc", "nope"], "atalante dbc"),
        (["--nope"], "atalante"),
    ],
)
def test_usage_error_is_one_sentence_that_names_the_called_command(arguments: list[str], command: str) -> None:
    result = CliRunner().invoke(cli, arguments, prog_name="atalante")
    assert result.exit_code == 2
    assert result.stderr.startswith("atalante: ")
    assert result.stderr.endswith(f"; see `{command} --help`\n")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (BusAbsent("there is no interface can7"), 3),
        (BusDown("can0 is down"), 3),
        (BusFull("can0 took 1 of 4 frames", 1), 1),
        (BusError("can0 cannot send"), 1),
        (LogUnreadable("run.log is empty"), 1),
        (ChannelMapError("channel map 'a,b' is not one"), 2),
        (DbcError("atalante.dbc:14: no unit"), 1),
        (RobotError("robot.toml: joints.FH is missing"), 1),
        (GaitError("airwalk.json: duration is missing"), 1),
        (AccessError("telemetry.toml: listne is unknown"), 1),
        (TelemetryError("the recorder is gone"), 1),
        (RingError("no such ring"), 1),
        (SinkError("the disk is full", "RECORD_STOPPED"), 1),
        (Failed("it did not work"), 1),
        (FaultLatched("left_SK is in FAULT"), 4),
        (click.UsageError("no such thing"), 2),
        (KeyboardInterrupt(), 130),
        (SystemExit(143), 143),
    ],
)
def test_known_error_prints_one_sentence_and_sets_its_exit_code(failing: Any, error: BaseException, code: int) -> None:
    result = failing(error)
    assert result.exit_code == code
    assert result.stdout == ""
    if str(error) and not isinstance(error, SystemExit):
        diagnostic = getattr(error, "code", "")
        assert result.stderr.startswith(f"atalante: {diagnostic}: {error}" if diagnostic else f"atalante: {error}")
        assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.stderr


def test_an_error_of_several_lines_is_printed_as_one_line(failing: Any) -> None:
    assert failing(BusError("first\n  second\tthird")).stderr == "atalante: first second third\n"


def test_a_list_of_problems_is_shortened_to_the_first_and_a_count(failing: Any) -> None:
    problems = "\n".join(f"a.dbc:{line}: no unit" for line in range(1, 25))
    assert failing(DbcError(problems)).stderr == "atalante: DBC_INVALID: a.dbc:1: no unit, and 23 more\n"


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (
            PermissionError(13, "Permission denied", "/root/run"),
            "/root/run cannot be read or written: Permission denied",
        ),
        (OSError(28, "No space left on device"), "the output file cannot be read or written: No space left on device"),
    ],
)
def test_operating_system_error_of_a_file_prints_one_sentence(failing: Any, error: OSError, sentence: str) -> None:
    result = failing(error)
    assert (result.exit_code, result.stderr) == (1, f"atalante: {sentence}\n")


def test_an_operating_system_error_without_a_file_keeps_its_traceback(failing: Any) -> None:
    error = OSError(9, "Bad file descriptor")
    assert failing(error).exception is error


@pytest.mark.parametrize("group", ["pendant", "dbc", "faults", "gait"])
def test_a_group_without_subcommand_prints_its_help(group: str) -> None:
    alone, asked = CliRunner().invoke(cli, [group]), CliRunner().invoke(cli, [group, "--help"])
    assert (alone.exit_code, alone.stdout, alone.stderr) == (2, "", asked.stdout)


def test_unexpected_error_keeps_its_traceback(failing: Any) -> None:
    error = ZeroDivisionError("a defect")
    assert failing(error).exception is error


def test_every_known_error_is_an_exception_class() -> None:
    import importlib

    for module, name, _ in KNOWN:
        kind = getattr(importlib.import_module(module), name)
        assert issubclass(kind, Exception)


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["nonsense"], 2, "No such command 'nonsense'"),
        (["jog", "left_SK", "--to", "5", "--fast"], 2, "No such option '--fast'"),
        (
            ["jog", "left_SK", "--to", "5", "-i", "pigeon", "-c", "x"],
            3,
            "there is no CAN interface 'pigeon'; use one of",
        ),
        (
            ["jog", "left_SK", "--to", "5", "-i", "socketcan", "-c", "a,b"],
            2,
            "must name the bus of each channel",
        ),
        (["jog", "left_SK", "--to", "5", "-i", "socketcan"], 2, "socketcan requires a channel: -c vcan0"),
        (["status", "-i", "socketcan", "-c", "nocan7"], 3, "atalante doctor"),
        (["emulator", "-i", "socketcan", "-c", "nocan7"], 3, "atalante doctor"),
        (["pendant", "stop", "-i", "socketcan", "-c", "nocan7"], 3, "atalante doctor"),
    ],
)
def test_invalid_input_prints_one_sentence_and_sets_its_exit_code(
    arguments: list[str], code: int, sentence: str
) -> None:
    result = CliRunner().invoke(cli, arguments)
    assert (result.exit_code, result.stdout) == (code, "")
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1


# -- processes -------------------------------------------------------------------------------------------------------


def test_process_prints_the_version_and_returns_the_exit_code() -> None:
    version, unknown = run("--version"), run("status", "-i", "pigeon", "-c", "x")
    assert (version.returncode, version.stdout.split()[0]) == (0, "atalante")
    assert unknown.returncode == 3
    assert unknown.stderr.startswith("atalante: there is no CAN interface 'pigeon'")


def test_stdout_contains_only_json_when_libraries_print() -> None:
    done = run("jog", "left_SK", "--to", "2", "--speed", "60", "--json")
    assert done.returncode == 0
    (line,) = done.stdout.splitlines()
    assert json.loads(line)["joint"] == "left_SK"
    assert "pybullet" not in done.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_ends_a_running_command_in_hold(number: signal.Signals, code: int) -> None:
    process = subprocess.Popen(
        atalante("jog", "left_SK", "--to", "100", "--speed", "1", "--json"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    assert process.stderr.readline() == "ACTIVE on embedded; Ctrl-C ends in HOLD\n"
    process.send_signal(number)
    out, rest = process.communicate(timeout=60)
    assert process.returncode == code
    assert out == ""
    assert rest.endswith("stopped, the robot is in HOLD\n")


def main_with(command: str) -> subprocess.CompletedProcess[str]:
    """Run `atalante` with Python code as its command; the code may call `send(number)`."""
    program = f"""
import atexit, ctypes, os, signal, sys
from atalante_tools import cli, entry
def send(number):
    os.kill(os.getpid(), number)
def command(**_):
    {command}
cli.cli = command
entry.main()
"""
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize(
    "command",
    [
        "send({0}); print('not ended')",
        "ctypes.CFUNCTYPE(None)(lambda: send({0}))()",  # the callback discards the exception
        "ctypes.CFUNCTYPE(None)(lambda: send({0}))(); sys.exit(1)",
        "ctypes.CFUNCTYPE(None)(lambda: send({0}))(); send(signal.SIGTERM)",  # the first signal sets the code
    ],
)
def test_signal_outside_a_run_sets_the_exit_code(number: signal.Signals, code: int, command: str) -> None:
    done = main_with(command.format(int(number)))
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


def test_a_library_error_caused_by_a_signal_is_not_reported() -> None:
    lines = ("try: send(2)", "except BaseException as error: raise ImportError('half imported') from error")
    done = main_with("\n    ".join(lines))
    assert (done.returncode, done.stderr) == (130, "")


def test_error_after_a_signal_prints_one_sentence() -> None:
    done = main_with("ctypes.CFUNCTYPE(None)(lambda: send(2))(); 1 / 0")
    assert done.returncode == 130
    assert done.stderr == "atalante: stopped by a signal, then ZeroDivisionError: division by zero\n"


def test_unexpected_error_without_a_signal_prints_every_traceback() -> None:
    done = main_with("ctypes.CFUNCTYPE(None)(lambda: [][1])(); 1 / 0")
    assert done.returncode == 1
    assert "IndexError" in done.stderr
    assert done.stderr.endswith("ZeroDivisionError: division by zero\n")


def test_a_signal_after_the_command_ends_the_process_without_a_traceback() -> None:
    done = main_with("atexit.register(send, signal.SIGINT)")
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


def test_signal_handlers_are_installed_before_the_imports() -> None:
    program = """
import signal, sys
there = set(sys.modules)
from atalante_tools.entry import main
print(*sorted(name for name in set(sys.modules) - there if not name.startswith("_")))
class Finder:
    def find_spec(self, name, path=None, target=None):
        print(name, signal.getsignal(signal.SIGINT) is not signal.default_int_handler,
              signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL)
        sys.stdout.flush()
        import os
        os._exit(0)
sys.meta_path.insert(0, Finder())
main()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    imported, first = done.stdout.splitlines()
    assert {"atalante_tools", "atalante_tools.entry", "atalante_tools.console.stop_request"} <= set(imported.split())
    assert not set(imported.split()) & {"click", "typing", "threading", "numpy"}
    assert first == "atalante_tools.cli True True"


def test_command_with_closed_stdout_ends_without_a_traceback() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        atalante("doctor"), stdout=writing, stderr=subprocess.PIPE, text=True, timeout=60, check=False
    )
    os.close(writing)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr


def test_main_is_the_installed_command() -> None:
    from importlib.metadata import entry_points

    (entry,) = [e for e in entry_points(group="console_scripts") if e.name == "atalante"]
    assert entry.load() is cli_module.main
