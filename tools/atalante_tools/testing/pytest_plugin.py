"""Pytest fixtures for tests with a robot: an emulated robot in this process, or a real robot on `--can-interface`.

`loop` uses `hal`, `hal` uses `bus`, and `bus` uses `emulator` and `recorded_run`. `faults` and `bus` are the same object.

- `emulator`: emulated robot; `emulator.operator` is its emulated operator.
- `bus`, `hal`: bus of the HAL, and the HAL.
- `loop`: runs cycles of the HAL: `loop.until(ACTIVE)`, `loop.run(20)`, `loop.state`, `loop.codes`.
- `faults`: injects communication faults: `faults.drop("LEFT_SK_STATE", frames=5)`, `delay`, `corrupt`.
- `recorded_run`: all frames of the test, written to a CAN log if the test fails.

A test marked `hil` runs with the robot on the bus, without emulator. If the bus is missing, the test fails and prints the options
to use. With `--can-missing=skip` the test is skipped. Every pytest run loads this module, so the module imports no slow package.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING, NoReturn

import pytest

if TYPE_CHECKING:
    from atalante_dbc import Network
    from atalante_emulator.emulator import Emulator
    from atalante_hal.bus import Bus
    from atalante_hal.hal import Hal
    from atalante_hal.robot import Robot
    from atalante_tools.testing.frame_filter import FrameFilter
    from atalante_tools.testing.hil import Recording, Stepper

_EMBEDDED = "embedded"
_NO_LOG = "CAN log not written"
_recording_key = pytest.StashKey["Recording"]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the command line options of the plugin.

    Args:
        parser: pytest's parser.
    """
    group = parser.getgroup("atalante", "Atalante HAL")
    group.addoption(
        "--can-interface",
        default=_EMBEDDED,
        metavar="NAME",
        help="CAN interface (socketcan, virtual, pcan, ...), or embedded for an emulated robot in this process (default)",
    )
    group.addoption(
        "--can-channel",
        default="",
        metavar="CHANNEL",
        help="one channel for all four buses (vcan0), or a channel for each bus: "
        "left_leg=can0,right_leg=can1,left_sense=can2,right_sense=can3",
    )
    group.addoption(
        "--engine",
        choices=("pybullet", "mujoco"),
        default="pybullet",
        help="physics engine of the emulated robot (default: %(default)s)",
    )
    group.addoption(
        "--can-missing",
        choices=("fail", "skip"),
        default="fail",
        help="result of a test if its bus is missing (default: fail)",
    )
    group.addoption(
        "--can-log",
        choices=("failed", "always", "never"),
        default="failed",
        help="which tests write their frames to a CAN log (default: failed)",
    )
    group.addoption(
        "--can-log-dir",
        default="runs/can-logs",
        metavar="DIR",
        help="folder of the CAN logs, relative to the root directory of pytest (default: %(default)s)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker `hil` and check the options.

    Args:
        config: pytest's configuration.
    """
    config.addinivalue_line("markers", "hil: run with the robot on the bus of --can-interface, without the emulator")
    interface, channel = config.getoption("--can-interface"), config.getoption("--can-channel")
    if interface == _EMBEDDED and channel:
        raise pytest.UsageError(f"--can-channel {channel} needs an interface: add --can-interface socketcan")
    if interface != _EMBEDDED and not channel:
        raise pytest.UsageError(f"--can-interface {interface} needs a channel: add --can-channel vcan0")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Write the recorded frames of a test to a CAN log, and add the path of the log to the test report.

    Args:
        item: test item.
    """
    report = yield
    recording = item.stash.get(_recording_key, None)
    wanted = item.config.getoption("--can-log")
    if recording is None or report.when != "call" or not len(recording) or wanted == "never":
        return report
    if report.failed or wanted == "always":
        _write_log(item, report, recording)
    return report


def _write_log(item: pytest.Item, report: pytest.TestReport, recording: Recording) -> None:
    from atalante_hal.telemetry.sink import SinkError

    folder = item.config.rootpath / item.config.getoption("--can-log-dir")
    path = folder / f"{re.sub(r'[^A-Za-z0-9.-]+', '_', item.nodeid).strip('_')}.log"
    try:
        recording.save(path)
    except SinkError as error:
        report.sections.append((_NO_LOG, str(error)))
    else:
        report.sections.append(("CAN log", f"{len(recording)} frames in {path}"))
        report.user_properties.append(("can_log", str(path)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print why the CAN log of a passed test was not written. Pytest itself prints this reason only for failed tests.

    Args:
        terminalreporter: reports of all tests.
    """
    for report in terminalreporter.stats.get("passed", ()):
        for name, text in report.sections:
            if name == _NO_LOG:
                terminalreporter.write_line(f"{report.nodeid}: {_NO_LOG}: {text}")


def _missing(request: pytest.FixtureRequest, reason: str) -> NoReturn:
    if request.config.getoption("--can-missing") == "skip":
        pytest.skip(reason)
    pytest.fail(f"{reason}; use --can-missing=skip to skip such tests", pytrace=False)


def _is_hil(request: pytest.FixtureRequest) -> bool:
    return request.node.get_closest_marker("hil") is not None


@pytest.fixture(scope="session")
def _atalante_network() -> Network:
    import atalante_dbc

    return atalante_dbc.load()


@pytest.fixture(scope="session")
def _atalante_robot() -> Robot:
    from atalante_hal.robot import load_robot

    return load_robot()


@pytest.fixture
def _atalante_buses(request: pytest.FixtureRequest, _atalante_network: Network) -> Iterator[tuple[Bus, Bus | None]]:
    """Open the bus for the HAL and for the emulated robot."""
    from atalante_hal.bus import BusAbsent
    from atalante_tools.console.options import Target
    from atalante_tools.testing.hil import BusInUse, open_bus

    interface, channel = request.config.getoption("--can-interface"), request.config.getoption("--can-channel")
    target = Target(interface, channel, lockstep=True)
    if target.embedded and _is_hil(request):
        _missing(request, "a hil test needs the robot: use --can-interface socketcan --can-channel can0")
    try:
        hal_bus, robot_bus = open_bus(_atalante_network, target, emulated=not _is_hil(request))
    except BusAbsent as error:
        _missing(request, str(error))
    except BusInUse as error:
        pytest.fail(str(error), pytrace=False)
    yield hal_bus, robot_bus
    for end in (hal_bus, robot_bus):
        if end is not None:
            end.close()


@pytest.fixture
def emulator(
    request: pytest.FixtureRequest,
    _atalante_buses: tuple[Bus, Bus | None],
    _atalante_network: Network,
    _atalante_robot: Robot,
) -> Iterator[Emulator]:
    """Return the emulated robot, with an operator who presses START when the HAL is READY."""
    from atalante_tools.testing.hil import emulated_robot

    robot_bus = _atalante_buses[1]
    if robot_bus is None:
        pytest.fail(
            f"{request.node.name} is marked hil and has no emulator: remove the marker or the fixture `emulator`",
            pytrace=False,
        )
    engine = request.config.getoption("--engine")
    with emulated_robot(_atalante_network, _atalante_robot, robot_bus, engine) as robot:
        yield robot


@pytest.fixture
def recorded_run(request: pytest.FixtureRequest, _atalante_network: Network) -> Recording:
    """Return the recording of all frames between HAL and nodes; `--can-log` writes it to a file."""
    from atalante_tools.testing.hil import Recording

    recording = Recording(_atalante_network)
    request.node.stash[_recording_key] = recording
    return recording


@pytest.fixture
def bus(
    request: pytest.FixtureRequest,
    _atalante_buses: tuple[Bus, Bus | None],
    _atalante_network: Network,
    recorded_run: Recording,
) -> FrameFilter:
    """Return the bus of the HAL, into which faults can be injected."""
    from atalante_tools.testing.frame_filter import FrameFilter
    from atalante_tools.testing.hil import connect

    hal_bus = _atalante_buses[0]
    step = None if _is_hil(request) else connect(hal_bus, request.getfixturevalue("emulator"))
    return FrameFilter(hal_bus, _atalante_network, tap=recorded_run, step=step)


@pytest.fixture
def faults(bus: FrameFilter) -> FrameFilter:
    """Return the injector of communication faults, with the methods `drop`, `delay` and `corrupt`."""
    return bus


@pytest.fixture
def hal(
    request: pytest.FixtureRequest,
    bus: FrameFilter,
    _atalante_network: Network,
    _atalante_robot: Robot,
    recorded_run: Recording,
) -> Iterator[Hal]:
    """Return a HAL on the bus. After the test, the HAL sends HOLD for some cycles and is stopped."""
    from atalante_hal.hal import Hal
    from atalante_tools.session.rig import LOCKSTEP_PATIENCE, PATIENCE

    patience = PATIENCE if _is_hil(request) else LOCKSTEP_PATIENCE
    made = Hal(_atalante_network, _atalante_robot, bus, patience=patience)
    recorded_run.cycle = lambda: made.state.cycle
    yield made
    bus.clear()
    made.stop()


@pytest.fixture
def loop(request: pytest.FixtureRequest, hal: Hal) -> Stepper:
    """Return the HAL loop with a controller that holds the pose. With a real robot, a cycle takes 1 ms."""
    from atalante_hal.loop import LockStep, WallClock
    from atalante_tools.testing.hil import Stepper

    return Stepper(hal, WallClock() if _is_hil(request) else LockStep())
