"""The pytest plugin as its users meet it: their tests in a folder of their own, run by a pytest of their own."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path

import can
import pytest

# pytester forgets what a run imported; what is here already stays.
import atalante_emulator.emulator  # noqa: F401
import atalante_tools.testing.frame_filter
import atalante_tools.testing.hil  # noqa: F401

pytest_plugins = ["pytester"]

#: The fault test of the documentation.
EXAMPLE = (Path(__file__).parents[3] / "examples" / "test_lost_frames.py").read_text()
VIRTUAL = ("--can-interface", "virtual", "--can-channel")


@pytest.fixture
def run(pytester: pytest.Pytester):
    """Run a test file with warnings as errors, without plugins that take longer than the run."""

    def run_(text: str, *arguments: str) -> pytest.RunResult:
        pytester.makepyfile(text)
        return pytester.runpytest_inprocess("-W", "error", "--strict-markers", "-p", "no:hypothesispytest", *arguments)

    return run_


def test_the_plugin_is_installed_with_the_project():
    (plugin,) = entry_points(group="pytest11", name="atalante")
    assert plugin.value == "atalante_tools.testing.pytest_plugin"


def test_a_pytest_that_does_not_use_it_does_not_pay_for_it():
    heavy = "numpy can cantools pybullet pinocchio atalante_hal atalante_dbc click"
    program = (
        f"import sys, atalante_tools.testing.pytest_plugin; print(sorted(set({heavy!r}.split()) & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


# -- on the embedded robot ---------------------------------------------------------------------------------------------


def test_the_example_passes(run):
    run(EXAMPLE).assert_outcomes(passed=1)


def test_each_test_gets_a_robot_of_its_own_and_all_fixtures_belong_to_it(run):
    run(
        """
        import pytest
        from atalante_hal.types import SupervisorState

        @pytest.mark.parametrize("again", range(2))
        def test_all(bus, emulator, hal, loop, faults, recorded_run, again):
            assert loop.state.cycle == 0 and hal.bus is bus is faults and loop.hal is hal
            loop.until(SupervisorState.READY)
            emulator.operator.release()
            loop.run(5)
            assert len(recorded_run.of("PENDANT_STATE")) == hal.state.cycle == emulator.cycle
            assert len(recorded_run.of("COMMAND_LEFT_LEG")) == hal.state.cycle
        """
    ).assert_outcomes(passed=2)


def test_a_test_that_fails_says_why_the_robot_is_not_where_it_should_be(run):
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

def test_of_something_else():
    assert True
"""


def logs(pytester: pytest.Pytester, folder: str = "runs/can-logs") -> list[Path]:
    return sorted((pytester.path / folder).glob("*"))


def test_a_failed_test_leaves_a_can_log_and_says_where(run, pytester: pytest.Pytester):
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
    # The robot's time: a millisecond a cycle, frames in order.
    assert [round(m.timestamp * 1e3) for m in syncs] == list(range(1, 31))
    stamps = [m.timestamp for m in messages]
    assert stamps == sorted(stamps)


def test_logs_of_all_tests_or_of_none(run, pytester: pytest.Pytester):
    run(FAILS_AND_PASSES, "--can-log", "never")
    assert logs(pytester) == []
    run(FAILS_AND_PASSES, "--can-log", "always", "--can-log-dir", "all")
    assert [log.name.rsplit(".py_")[1] for log in logs(pytester, "all")] == ["test_bad.log", "test_good.log"]


def test_a_log_that_cannot_be_written_does_not_hide_the_failure(run, pytester: pytest.Pytester):
    pytester.path.joinpath("taken").write_text("a file")
    result = run(FAILS_AND_PASSES, "--can-log-dir", "taken")
    result.assert_outcomes(passed=2, failed=1)
    result.stdout.fnmatch_lines(["*on purpose*", "*cannot be created*"])


# -- buses that are there, and that are not ----------------------------------------------------------------------------

HIL = """
import pytest

@pytest.mark.hil
def test_of_the_robot(bus):
    from atalante_hal.wire.frame import new_frames
    assert bus.receive(new_frames(1), 5.0) == 1
"""


def test_a_hil_test_without_a_robot_fails_with_what_to_type(run):
    result = run(HIL)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*--can-interface socketcan --can-channel can0*--can-missing=skip*"])
    assert result.ret == pytest.ExitCode.TESTS_FAILED


def test_it_is_skipped_only_when_that_was_asked_for(run):
    result = run(HIL, "--can-missing", "skip", "-rs")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["SKIPPED*--can-interface socketcan*"])


@pytest.mark.parametrize(("arguments", "outcome"), [((), "errors"), (("--can-missing=skip",), "skipped")])
def test_a_bus_that_is_not_there_is_named(run, arguments: tuple[str, ...], outcome: str):
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
def test_half_a_bus_is_a_usage_error(run, arguments: tuple[str, ...], hint: str):
    result = run(EXAMPLE, *arguments)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"*{hint}*"])


def test_the_same_test_passes_on_a_wire(run):
    """python-can's virtual bus: both ends packed and unpacked by it, the emulated robot polled at its end."""
    run(EXAMPLE, *VIRTUAL, "test-plugin-wire").assert_outcomes(passed=1)


@pytest.fixture
def heartbeat() -> Iterator[str]:
    """A robot's heartbeat on a virtual channel, ten times as often as a real one; gives the channel."""
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


def test_a_hil_test_meets_the_robot_that_is_there(run, heartbeat: str):
    run(HIL, *VIRTUAL, heartbeat).assert_outcomes(passed=1)


def test_no_emulated_robot_is_put_beside_a_real_one(run, heartbeat: str):
    result = run(EXAMPLE, *VIRTUAL, heartbeat, "--can-missing=skip")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*must be free*got frame 0x701*pytest.mark.hil*"])


def test_a_hil_test_has_no_emulator(run):
    result = run(
        """
        import pytest

        @pytest.mark.hil
        def test_confused(emulator):
            pass
        """,
        *VIRTUAL,
        "test-plugin-empty",
    )
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*test_confused is marked hil*"])


def test_the_marker_and_the_options_are_documented(pytester: pytest.Pytester):
    short = ("-p", "no:hypothesispytest")
    pytester.runpytest_inprocess("--markers", *short).stdout.fnmatch_lines(["@pytest.mark.hil: *"])
    listed = pytester.runpytest_inprocess("--help", *short).stdout
    listed.fnmatch_lines(["*--can-interface*", "*--can-missing*", "*--can-log*"])
