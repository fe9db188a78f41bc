"""Tests of the pytest plugin: pytest runs test files of a user in a temporary folder."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path

import can
import pytest

# pytester removes the modules that a run imported; modules imported here stay loaded.
import atalante_emulator.emulator  # noqa: F401
import atalante_tools.testing.frame_filter
import atalante_tools.testing.hil  # noqa: F401

pytest_plugins = ["pytester"]

#: The fault test of the documentation.
EXAMPLE = (Path(__file__).parents[3] / "examples" / "test_lost_frames.py").read_text()
VIRTUAL = ("--can-interface", "virtual", "--can-channel")


@pytest.fixture
def run(pytester: pytest.Pytester):
    """Return a function that runs a test file with warnings as errors and without slow plugins."""

    def run_(text: str, *arguments: str) -> pytest.RunResult:
        pytester.makepyfile(text)
        return pytester.runpytest_inprocess("-W", "error", "--strict-markers", "-p", "no:hypothesispytest", *arguments)

    return run_


def test_the_plugin_is_installed_with_the_project():
    (plugin,) = entry_points(group="pytest11", name="atalante")
    assert plugin.value == "atalante_tools.testing.pytest_plugin"


def test_plugin_import_loads_no_heavy_module():
    heavy = "numpy can cantools pybullet pinocchio atalante_hal atalante_dbc click"
    program = (
        f"import sys, atalante_tools.testing.pytest_plugin; print(sorted(set({heavy!r}.split()) & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


# -- on the embedded robot ---------------------------------------------------------------------------------------------


def test_example_of_the_documentation_passes(run):
    run(EXAMPLE).assert_outcomes(passed=1)


def test_each_test_has_a_new_robot_shared_by_all_its_fixtures(run):
    run(
        """
        import pytest
        from atalante_hal.types import SupervisorState

        @pytest.mark.parametrize("repetition", range(2))
        def test_fixtures(bus, emulator, hal, loop, faults, recorded_run, repetition):
            assert loop.state.cycle == 0 and hal.bus is bus is faults and loop.hal is hal
            loop.until(SupervisorState.READY)
            emulator.operator.release()
            loop.run(5)
            assert len(recorded_run.of("PENDANT_STATE")) == hal.state.cycle == emulator.cycle
            assert len(recorded_run.of("COMMAND_LEFT_LEG")) == hal.state.cycle
        """
    ).assert_outcomes(passed=2)


def test_missed_state_error_names_the_missing_node(run):
    result = run(
        """
        from atalante_hal.types import SupervisorState

        def test_waits(loop, faults):
            faults.drop("IMU_TORSO")
            loop.until(SupervisorState.ACTIVE, cycles=300)
        """
    )
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*must be ACTIVE within 300 cycles, got OFF*missing nodes: IMU_TORSO*"])


# -- CAN logs ----------------------------------------------------------------------------------------------------------

FAILS_AND_PASSES = """
def test_bad(loop):
    loop.run(30)
    assert False, "on purpose"

def test_good(loop):
    loop.run(30)

def test_without_robot():
    assert True
"""


def logs(pytester: pytest.Pytester, folder: str = "runs/can-logs") -> list[Path]:
    return sorted((pytester.path / folder).glob("*"))


def test_failed_test_writes_a_can_log_and_prints_its_path(run, pytester: pytest.Pytester):
    result = run(FAILS_AND_PASSES)
    result.assert_outcomes(passed=2, failed=1)
    (log,) = logs(pytester)
    assert log.name.endswith("test_bad.log")
    result.stdout.fnmatch_lines(["*CAN log*", f"* frames in {log}"])
    messages = list(can.LogReader(log))
    syncs = [m for m in messages if m.arbitration_id == 0x10]
    states = [m for m in messages if m.arbitration_id == 0x184]
    assert (len(syncs), len(states)) == (30, 30)
    assert {m.channel for m in syncs} == {"left_leg"}
    assert [(m.is_rx, m.is_fd, m.dlc) for m in (syncs[0], states[0])] == [(False, True, 8), (True, True, 12)]
    # Time of the robot: 1 ms per cycle, frames in order of time.
    assert [round(m.timestamp * 1e3) for m in syncs] == list(range(1, 31))
    stamps = [m.timestamp for m in messages]
    assert stamps == sorted(stamps)


def test_can_log_option_selects_no_log_or_every_log(run, pytester: pytest.Pytester):
    run(FAILS_AND_PASSES, "--can-log", "never")
    assert logs(pytester) == []
    run(FAILS_AND_PASSES, "--can-log", "always", "--can-log-dir", "all")
    assert [log.name.rsplit(".py_")[1] for log in logs(pytester, "all")] == ["test_bad.log", "test_good.log"]


def test_unwritable_can_log_does_not_hide_the_test_failure(run, pytester: pytest.Pytester):
    pytester.path.joinpath("taken").write_text("a file")
    result = run(FAILS_AND_PASSES, "--can-log-dir", "taken")
    result.assert_outcomes(passed=2, failed=1)
    result.stdout.fnmatch_lines(["*on purpose*", "*CAN log not written*", "*cannot be created*"])


def test_unwritable_can_log_of_a_passed_test_is_reported(run, pytester: pytest.Pytester):
    pytester.path.joinpath("taken").write_text("a file")
    result = run(FAILS_AND_PASSES, "--can-log", "always", "--can-log-dir", "taken")
    result.stdout.fnmatch_lines(["*test_good: CAN log not written: *cannot be created*"])
    result.stdout.no_fnmatch_line("*test_without_robot: CAN log*")


# -- present and missing buses -----------------------------------------------------------------------------------------

HIL = """
import pytest

@pytest.mark.hil
def test_bus_receives(bus):
    from atalante_hal.wire.frame import new_frames
    assert bus.receive(new_frames(1), 5.0) == 1
"""


def test_hil_test_without_a_bus_fails_with_the_options_to_type(run):
    result = run(HIL)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*--can-interface socketcan --can-channel can0*--can-missing=skip*"])
    assert result.ret == pytest.ExitCode.TESTS_FAILED


def test_hil_test_without_a_bus_is_skipped_with_can_missing_skip(run):
    result = run(HIL, "--can-missing", "skip", "-rs")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["SKIPPED*--can-interface socketcan*"])


@pytest.mark.parametrize(("arguments", "outcome"), [((), "errors"), (("--can-missing=skip",), "skipped")])
def test_unknown_can_interface_is_named_with_the_valid_ones(run, arguments: tuple[str, ...], outcome: str):
    result = run(EXAMPLE, "--can-interface", "no-such", "--can-channel", "can7", "-rs", *arguments)
    result.assert_outcomes(**{outcome: 1})
    result.stdout.fnmatch_lines(["*no-such*socketcan*"])


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (("--can-interface", "socketcan"), "--can-channel vcan0"),
        (("--can-channel", "can0"), "--can-interface socketcan"),
    ],
)
def test_interface_or_channel_alone_is_a_usage_error(run, arguments: tuple[str, ...], hint: str):
    result = run(EXAMPLE, *arguments)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"*{hint}*"])


def test_example_passes_on_a_virtual_can_bus(run):
    """Python-can packs and unpacks the frames at both ends of its virtual bus; the emulated robot is polled at its end."""
    run(EXAMPLE, *VIRTUAL, "test-plugin-wire").assert_outcomes(passed=1)


@pytest.fixture
def heartbeat() -> Iterator[str]:
    """Send the heartbeat of a robot on a virtual channel, at ten times the real rate; yield the channel."""
    channel, done = "test-plugin-robot", threading.Event()
    bus = can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD)
    message = can.Message(arbitration_id=0x701, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(16))

    def beat() -> None:
        while not done.wait(0.01):
            bus.send(message)

    thread = threading.Thread(target=beat)
    thread.start()
    yield channel
    done.set()
    thread.join()
    bus.shutdown()


def test_hil_test_receives_the_frames_of_the_robot(run, heartbeat: str):
    run(HIL, *VIRTUAL, heartbeat).assert_outcomes(passed=1)


def test_emulated_robot_is_rejected_on_the_bus_of_a_real_one(run, heartbeat: str):
    result = run(EXAMPLE, *VIRTUAL, heartbeat, "--can-missing=skip")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*must carry no frames*got frame 0x701*pytest.mark.hil*"])


def test_emulator_fixture_in_a_hil_test_is_an_error(run):
    result = run(
        """
        import pytest

        @pytest.mark.hil
        def test_uses_emulator(emulator):
            pass
        """,
        *VIRTUAL,
        "test-plugin-empty",
    )
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*test_uses_emulator is marked hil*"])


def test_help_lists_the_marker_and_the_options(pytester: pytest.Pytester):
    short = ("-p", "no:hypothesispytest")
    pytester.runpytest_inprocess("--markers", *short).stdout.fnmatch_lines(["@pytest.mark.hil: *"])
    listed = pytester.runpytest_inprocess("--help", *short).stdout
    listed.fnmatch_lines(["*--can-interface*", "*--can-missing*", "*--can-log*"])
