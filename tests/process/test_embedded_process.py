"""Tests of the embedded robot in a subprocess: it runs, ends with its HAL, and its failure is reported in one sentence."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.faults import Fault
from atalante_emulator.pendant import Operator
from atalante_hal.robot import Robot
from atalante_hal.types import SupervisorState
from atalante_tools.console.options import Target
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import StopRequest
from atalante_tools.session.embedded import EmbeddedRobot, cores_are_idle, halves
from atalante_tools.session.pose_hold import PoseHold
from atalante_tools.session.rig import Watch, open_hal
from atalante_tools.session.walk_observation import Observation

EMBEDDED = Target("embedded", "", lockstep=True)
LONG = 60.0


def wait_for_end(pid: int) -> bool:
    """Wait until a process has ended, reaped or not; return whether it did."""
    give_up = time.monotonic() + LONG
    while time.monotonic() < give_up:
        stat = Path(f"/proc/{pid}/stat")
        if not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.01)
    return False


def is_reaped(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


def test_robot_subprocess_becomes_active_and_ends_with_the_session(network: Network, robot: Robot) -> None:
    robot_process = EmbeddedRobot()
    fields = PoseHold.telemetry_fields
    with open_hal(EMBEDDED, network=network, robot=robot, controller_fields=fields, robot_process=robot_process) as rig:
        assert rig.emulator is None
        assert rig.operator is None
        assert not is_reaped(robot_process.pid)
        controller = PoseHold(robot)
        watch = Watch(rig, StopRequest(), lambda state: controller.elapsed >= 0.02, lambda state: "")
        rig.run(controller, until=watch)
        watch.conclude()
        assert rig.hal.state.supervisor is SupervisorState.HOLD
    assert is_reaped(robot_process.pid)


def test_robot_subprocess_and_hal_use_disjoint_cores_until_closed() -> None:
    before = os.sched_getaffinity(0)
    kept, given = halves(before)
    first = EmbeddedRobot()
    second = EmbeddedRobot()  # imports its modules while the first robot runs
    assert os.sched_getaffinity(0) == kept
    assert os.sched_getaffinity(first.pid) == os.sched_getaffinity(second.pid) == given
    first.close()
    first.close()  # a second close has no effect
    assert os.sched_getaffinity(0) == kept
    second.close()
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize(
    ("cores", "kept", "given"),
    [({3}, {3}, {3}), ({0, 1}, {0}, {1}), ({5, 1, 2}, {1, 2}, {5}), ({0, 1, 2, 3}, {0, 1}, {2, 3})],
)
def test_cores_are_split_into_halves(cores: set[int], kept: set[int], given: set[int]) -> None:
    assert halves(cores) == (kept, given)


def test_killed_robot_subprocess_fails_the_run_with_one_sentence(network: Network, robot: Robot) -> None:
    robot_process = EmbeddedRobot()
    fields = PoseHold.telemetry_fields
    with open_hal(EMBEDDED, network=network, robot=robot, controller_fields=fields, robot_process=robot_process) as rig:
        controller = PoseHold(robot)

        def kill(state: object) -> bool:
            if rig.hal.state.cycle == 400:
                os.kill(robot_process.pid, signal.SIGKILL)
            return False

        watch = Watch(rig, StopRequest(), kill, lambda state: "")
        rig.run(controller, until=watch)
        with pytest.raises(Failed, match="embedded: the other end is closed"):
            watch.conclude()


def test_failed_robot_subprocess_reports_its_exception(network: Network, robot: Robot) -> None:
    wrong = [0.0] * 11
    with (
        pytest.raises(Failed, match=r"^embedded: the robot's process failed with ValueError: "),
        open_hal(EMBEDDED, network=network, robot=robot, pose=wrong, robot_process=EmbeddedRobot()),
    ):
        raise AssertionError("made")


def test_operator_object_is_rejected_for_a_robot_subprocess(network: Network, robot: Robot) -> None:
    robot_process = EmbeddedRobot()
    with (
        pytest.raises(ValueError, match="operator must be None for a robot in a subprocess"),
        open_hal(EMBEDDED, network=network, robot=robot, operator=Operator(), robot_process=robot_process),
    ):
        raise AssertionError("made")
    assert is_reaped(robot_process.pid)


def test_faults_act_in_the_robot_subprocess(network: Network, robot: Robot) -> None:
    lost = Fault("drop", "LEFT_SK_STATE", start=150, cycles=3)
    with open_hal(EMBEDDED, network=network, robot=robot, faults=[lost], robot_process=EmbeddedRobot()) as rig:
        row = rig.hal.messages.index("LEFT_SK_STATE")
        ages = []
        for _ in range(160):
            rig.hal.read()
            rig.hal.hold()
            ages.append(int(rig.hal.state.age[row]))
    assert ages[149:156] == [0, 1, 2, 3, 0, 0, 0]


@pytest.mark.parametrize("connected", [True, False])
def test_robot_subprocess_ends_when_its_hal_is_killed(connected: bool) -> None:
    program = (
        "from atalante_tools.session.embedded import EmbeddedRobot\n"
        "from atalante_tools.console.options import Target\n"
        "from atalante_tools.session.rig import open_hal\n"
        "robot_process = EmbeddedRobot()\n"
        "print(robot_process.pid, flush=True)\n"
        f"if not {connected}: import time; time.sleep(3600)\n"
        "with open_hal(Target('embedded', '', lockstep=True), robot_process=robot_process) as rig:\n"
        "    rig.hal.read()\n"
        "    print('walking', flush=True)\n"
        "    while True: rig.hal.read(); rig.hal.hold()\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as hal:
        assert hal.stdout is not None
        pid = int(hal.stdout.readline())
        if connected:
            assert hal.stdout.readline() == "walking\n"
        hal.kill()
    assert wait_for_end(pid)


@pytest.mark.parametrize(
    ("cores", "running", "others", "idle"),
    [
        (2, 1, 0, True),  # only this thread
        (2, 2, 0, False),
        (2, 1, 1, False),
        (3, 1, 1, True),
        (3, 2, 1, False),
        (1, 1, 0, False),
        (2, 0, 0, True),  # this thread was not counted
    ],
)
def test_robot_needs_a_core_that_is_idle(
    cores: int, running: int, others: int, idle: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    load = tmp_path / "loadavg"
    load.write_text(f"0.50 0.40 0.30 {running}/196 4711\n")
    assert cores_are_idle(others, load) is idle


def test_cores_are_idle_if_the_load_is_not_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    assert cores_are_idle(0, tmp_path / "loadavg")


def test_observation_of_a_walk_survives_the_end_of_the_robot_subprocess(network: Network, robot: Robot) -> None:
    robot_process = EmbeddedRobot()
    with open_hal(EMBEDDED, network=network, robot=robot, robot_process=robot_process) as rig:
        controller = SimpleNamespace(walking=False, vertical=np.array([0.0, 0.0, 1.0]))
        observation = Observation(rig, controller, None)  # type: ignore[arg-type]
        rig.hal.read()
        rig.hal.hold()
        assert rig.access is not None
        assert abs(rig.access.attitude()[3]) > 0.99
        os.kill(robot_process.pid, signal.SIGKILL)
        rig.hal.state.cycle = 10
        assert not observation.check()
        assert observation.true_deviation() == {"true_lateral_m": None, "true_yaw_deg": None}
