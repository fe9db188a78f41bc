"""`atalante demo` and `airwalk`: output for scripts, and the results of the paper's first experiment."""

from __future__ import annotations

import functools
import json
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.dynamics import gait_network
from atalante_control.dynamics.gait_network import load_network, save_network
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.safety import fault_memory
from atalante_hal.safety.events import Event
from atalante_hal.telemetry.process import Recording, TelemetryProcess, TelemetrySummary
from atalante_hal.telemetry.schema import message_class
from atalante_hal.types import State, SupervisorState
from atalante_hal.wire.frame import Frames
from atalante_tools.cli import cli
from atalante_tools.session import airwalk as trial
from atalante_tools.session.run_folder import Result, results_table
from tests.process.test_telemetry_faults import cycles_without_index

ATALANTE = str(Path(sys.executable).with_name("atalante"))
KEYS = [
    "shape", "certified", "promise_hip_nm", "promise_knee_nm", "steps", "max_ratio", "inside", "filter_active", "cycles",
    "real_time_factor", "frames", "crc_errors", "hand_overs", "hand_overs_exceeded",
]  # fmt: skip


def atalante(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([ATALANTE, *arguments], capture_output=True, text=True, timeout=300)


def test_the_table_shows_no_tracking_error_for_a_single_step() -> None:
    walked = Result("pinched", True, 1.97, 1.18, 2, 0.934, 0.99876, 0.5, 4697, 6.25, 90000, 0, 2, 0)
    head, two, one = results_table(
        [walked, replace(walked, steps=1, max_ratio=None, inside=None, filter_active=None)]
    ).splitlines()
    assert head.split("  ")[0].strip() == "shape"
    assert two.split() == [
        "pinched",
        "yes",
        "1.97",
        "1.18",
        "2",
        "0.93",
        "99.9",
        "50.0",
        "4697",
        "6.2",
        "90000",
        "0",
        "0",
    ]
    assert one.split() == ["pinched", "yes", "1.97", "1.18", "1", "-", "-", "-", "4697", "6.2", "90000", "0", "0"]


def test_the_table_shows_no_hand_overs_of_a_guide_without_a_certificate() -> None:
    walked = Result("snap", False, None, None, 2, 0.934, 0.99876, 0.5, 4697, 6.25, 90000, 0, 0, 0)
    head, row = results_table([walked]).splitlines()
    assert head.split("  ")[-1].strip() == "steps outside box"
    assert row.split()[1::11] == ["NO", "-"]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess[str], Path]:
    out = tmp_path_factory.mktemp("demo")
    done = atalante(
        "demo", "--steps", "2", "--shape", "pinched", "--shape", "snap", "--out", str(out), "--json",
        "--can-log", str(out / "frames.log"), "--seed", "3", "--feedforward", "0.5",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done, out


def test_stdout_has_one_object_per_shape_and_one_of_the_recording(demo):
    *results, recording = [json.loads(line) for line in demo[0].stdout.splitlines()]
    assert recording == {"recording": {"files": ["recording.mcap"], "complete": True, "missing_cycles": 0}}
    assert [list(result) for result in results] == [KEYS, KEYS]
    pinched, snap = results
    assert (pinched["shape"], pinched["certified"], snap["shape"], snap["certified"]) == (
        "pinched",
        True,
        "snap",
        False,
    )
    for result in results:
        assert result["steps"] == 2
        assert result["crc_errors"] == 0
        assert result["frames"] > 19 * result["cycles"]
        assert 0 <= result["inside"] <= 1
        assert 0 <= result["filter_active"] <= 1
    bound = (
        AirwalkController(load_robot(), load_gait(AIRWALK_GAIT, load_robot()), SHAPES["pinched"])
        .certificate(0.5)
        .promise
    )
    assert bound is not None
    assert (pinched["promise_hip_nm"], pinched["promise_knee_nm"]) == (bound.hip, bound.knee)
    assert (snap["promise_hip_nm"], snap["promise_knee_nm"]) == (None, None)
    assert pinched["max_ratio"] <= 1.0
    assert pinched["inside"] == 1.0


def test_certificates_are_printed_before_the_run(demo):
    stderr = demo[0].stderr
    announced = stderr.index("snap: NOT CERTIFIED")
    assert announced < stderr.index("ACTIVE on")
    (promise,) = (line for line in stderr.splitlines() if line.startswith("pinched: "))
    pinched = json.loads(demo[0].stdout.splitlines()[0])
    hip, knee = pinched["promise_hip_nm"], pinched["promise_knee_nm"]
    assert promise.startswith(
        f"pinched: promise at Xi 0.5: both joints stay in the guide while disturbances of up to {hip:.2f} Nm at the hip and "
        f"{knee:.2f} Nm at the knee act at the same time; "
    )
    assert "the promise includes joint torque and rate limits, delay" in stderr


def test_the_run_folder_contains_recording_summary_and_figure(demo):
    _, out = demo
    assert {"recording.mcap", "summary.json", "guide_shapes.png"} <= {path.name for path in out.iterdir()}
    summary = json.loads((out / "summary.json").read_text())
    assert [list(shape) for shape in summary["shapes"]] == [KEYS, KEYS]
    assert (summary["steps"], summary["xi"], summary["seed"]) == (2, 0.5, 3)
    assert (summary["idealization"], summary["feedforward"]) == (1.0, 0.5)
    assert summary["recording"] == {"files": ["recording.mcap"], "complete": True, "missing_cycles": 0}
    assert (out / "guide_shapes.png").read_bytes().startswith(b"\x89PNG")
    cycles = sum(shape["cycles"] for shape in summary["shapes"])
    # 30 steps of six shapes are 300,000 cycles; the default folder stays under 30 MB.
    assert (out / "recording.mcap").stat().st_size / cycles * 300_000 < 30e6


def test_the_recording_holds_every_joint_at_its_rate(demo):
    _, out = demo
    summary = json.loads((out / "summary.json").read_text())
    with (out / "recording.mcap").open("rb") as file:
        joints = [
            message_class("JointStates").FromString(message.data)
            for _, _, message in make_reader(file).iter_messages(topics=["/joint_states"])
        ]
    assert [*joints[0].name] == list(JOINTS)
    assert len(joints) == pytest.approx(sum(shape["cycles"] for shape in summary["shapes"]) / 10, abs=20)
    knee = [joint.position[3] for joint in joints]
    assert max(knee) - min(knee) > 0.5


@pytest.mark.long
def test_equal_seeds_give_equal_can_logs_and_other_seeds_give_other_logs(demo, tmp_path: Path):
    _, out = demo
    again, other = tmp_path / "again.log", tmp_path / "other.log"
    for log, seed, *walk in (
        (again, "3", "2", "--shape", "pinched", "--shape", "snap", "--feedforward", "0.5"),
        (other, "4", "1", "--shape", "pinched"),
    ):
        done = atalante(
            "demo", "--steps", *walk, "--out", str(tmp_path), "--json", "--can-log", str(log), "--seed", seed
        )
        assert done.returncode == 0, done.stderr
    first = (out / "frames.log").read_bytes()
    assert again.read_bytes() == first
    # A run of one step with another seed begins with other frames than the first run.
    begun = other.read_bytes()[:4_000_000]
    assert len(begun) == 4_000_000
    assert not first.startswith(begun)
    assert first.count(b"\n") > 200_000


class CommandFrames:
    """Recorder of the bytes of every command frame."""

    def __init__(self) -> None:
        self.data = bytearray()

    def sent(self, frames: Frames) -> None:
        for frame in frames:
            if frame["can_id"] in (0x100, 0x101):
                self.data += frame["data"][:48].tobytes()

    def received(self, frames: Frames, count: int) -> None:
        pass


class Baseline(AirwalkController):
    """The same controller without assistance; its guide parameters are NaN, so that any use of them is detected."""

    def _change_step(self, state: State, stance: int) -> None:
        super()._change_step(state, stance)
        self._step.assisted, self.guide.tables.guards["gains"] = False, np.nan


@pytest.mark.parametrize(("xi", "equal"), [(1.0, True), (0.99, False)])
def test_command_frames_at_full_assistance_are_equal_to_those_without_assistance(network, robot, urdf_text, xi, equal):
    sent = []
    for kind in (AirwalkController, Baseline):
        ours, theirs = lockstep_pair()
        body = PyBulletBody(urdf_text)
        ours.step = Emulator(network, robot, body, theirs, operator=Operator(xi)).poll
        controller = kind(robot, load_gait(AIRWALK_GAIT, robot), SHAPES["constant"], AirwalkConfig(startup=0.3))
        tap = CommandFrames()
        hal = Hal(network, robot, ours, controller_fields=controller.telemetry_fields, tap=tap)
        run(hal, controller, LockStep(), until=lambda state: state.cycle >= 2300)
        assert np.ptp(hal.state.position) > 0.3
        sent.append(bytes(tap.data))
        body.close()
    assert (sent[0] == sent[1]) is equal


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--shape", "round"], 2, "constant"),
        (["--steps", "0"], 2, "steps"),
        (["--xi", "1.5"], 2, "xi"),
        (
            ["--record-rate", "333"],
            2,
            "must be a divisor of 1000, such as 1, 10, 50, 100, 200, 250, 500 or 1000, got '333'",
        ),
        (["--record-rate", "0"], 2, "got '0'"),
        (["--can-log", "frames.xyz"], 2, "end its name in one of .log"),
        (["-i", "pigeon", "-c", "x"], 3, "there is no CAN interface 'pigeon'"),
        (["--telemetry", "nofile.toml"], 1, "nofile.toml cannot be read"),
    ],
)
def test_bad_input_gets_one_sentence_that_says_what_is_valid(arguments, code, message, tmp_path: Path):
    out = tmp_path / "run"
    done = CliRunner().invoke(cli, ["airwalk", "--out", str(out), *arguments])
    assert done.exit_code == code, done.stderr
    # No certificate is printed before the error, because no robot runs.
    assert done.stderr.startswith("atalante: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert not out.exists()


RECORDING = Recording(("recording.mcap",), False, 70)


class Child:
    """Telemetry process with a given summary at its end."""

    notices = ("nothing is published: no port",)

    def __init__(self, *summary: str, complete: bool) -> None:
        self._summary = TelemetrySummary(complete=complete, notices=summary, recording=RECORDING)

    def close(self) -> TelemetrySummary:
        return self._summary


@pytest.mark.parametrize(
    ("notices", "complete", "printed"),
    [
        ((*Child.notices, "the recording stopped: disk full"), True, "the recording stopped: disk full\n"),
        (("telemetry hangs; it is restarted",), False, "telemetry hangs; it is restarted\n"),
        ((), False, "the telemetry process ended unexpectedly: the recording may be truncated\n"),
        ((), True, ""),
    ],
)
def test_notices_about_lost_records_are_printed_once(notices, complete, printed, capsys):
    walked = trial.Walked()
    trial._close(Child(*notices, complete=complete), walked)
    assert walked.recording is RECORDING
    assert capsys.readouterr().err == printed


def kill_and_take_the_port(telemetry: TelemetryProcess) -> socket.socket:
    """Kill the telemetry process after it has processed all records, and occupy its port."""
    child, squatter = telemetry._child, socket.socket()
    assert child is not None
    while telemetry.records.taken != telemetry.records.written:
        time.sleep(0.001)
    telemetry.event(Event(0, "MARK", "it is taken when the records before it are handled"))
    while telemetry.events.taken != telemetry.events.written:
        time.sleep(0.001)
    child.kill()
    child.wait()
    host, port = telemetry.endpoint.partition("/")[2].split(":")
    squatter.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    squatter.bind((host, int(port)))
    squatter.listen()
    return squatter


@pytest.mark.long
def test_a_recording_with_a_gap_fails_the_run_and_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    tend, calls, endpoints = TelemetryProcess.tend, [0], []

    with ExitStack() as stack:

        def kill_once(telemetry: TelemetryProcess) -> None:
            calls[0] += 1
            if calls[0] == 5:
                endpoints.append(telemetry.endpoint)
                stack.enter_context(kill_and_take_the_port(telemetry))
            tend(telemetry)
            if calls[0] == 5:
                telemetry._restarting.join()
                endpoints.append(telemetry.endpoint)

        monkeypatch.setattr(TelemetryProcess, "tend", kill_once)
        command = ["airwalk", "--steps", "2", "--record-rate", "1000", "--json", "--out", str(tmp_path)]
        done = CliRunner().invoke(cli, command)
    assert done.exit_code == 1, done.stderr
    walked, recording = (json.loads(line) for line in done.stdout.splitlines())
    first, second = (cycles_without_index(tmp_path / name) for name in ("recording.mcap", "recording-1.mcap"))
    assert first == list(range(1, 1 + len(first)))
    assert second == list(range(walked["cycles"] + 1 - len(second), walked["cycles"] + 1))
    missing = walked["cycles"] - len(first) - len(second)
    assert missing > 0
    files = ["recording.mcap", "recording-1.mcap"]
    assert recording == {"recording": {"files": files, "complete": False, "missing_cycles": missing}}
    assert json.loads((tmp_path / "summary.json").read_text())["recording"] == recording["recording"]
    old, new = endpoints
    assert old != new
    assert done.stderr.index(f"telemetry on Zenoh at {old}") < done.stderr.index(f"telemetry on Zenoh at {new}")
    problem = f"the recording is incomplete: {missing} cycles are missing in recording.mcap, recording-1.mcap"
    assert done.stderr.splitlines()[-1] == f"atalante: {problem}"


def test_a_run_of_one_step_reports_no_tracking_error(tmp_path: Path):
    done = CliRunner().invoke(cli, ["airwalk", "--steps", "1", "--json", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.stderr
    walked = json.loads(done.stdout.splitlines()[0])
    assert (walked["steps"], walked["max_ratio"], walked["inside"], walked["filter_active"]) == (1, None, None, None)


def test_a_can_log_on_a_full_disk_fails_the_run(tmp_path: Path):
    log = tmp_path / "frames.log"
    log.symlink_to("/dev/full")
    done = CliRunner().invoke(cli, ["airwalk", "--steps", "1", "--out", str(tmp_path), "--can-log", str(log)])
    assert done.exit_code == 1
    assert f"the CAN log {log} stopped: No space left on device" in done.stderr
    problem = f"atalante: the CAN log {log} must contain every frame, but frames are missing"
    assert done.stderr.splitlines()[-1] == problem


def test_a_run_starts_without_the_telemetry_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "sitecustomize.py").write_text("import time\ntime.sleep(1.0)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    start = TelemetryProcess.start

    def start_as_on_the_wall_clock(telemetry: TelemetryProcess, timeout: float = 60.0) -> None:
        telemetry.config = replace(telemetry.config, lock_step=False)
        start(telemetry, 0.0)

    monkeypatch.setattr(TelemetryProcess, "start", start_as_on_the_wall_clock)
    done = CliRunner().invoke(cli, ["airwalk", "--steps", "1", "--json", "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.stderr
    late = "the telemetry process is not ready yet: the run starts now, and telemetry begins when the process is ready"
    assert done.stderr.index(late) < done.stderr.index("ACTIVE on")
    recording = json.loads(done.stdout.splitlines()[-1])
    assert recording == {"recording": {"files": ["recording.mcap"], "complete": True, "missing_cycles": 0}}


@pytest.mark.long
def test_every_event_is_recorded_when_the_event_log_holds_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fault_memory, "EventLog", functools.partial(fault_memory.EventLog, 1))
    done = CliRunner().invoke(cli, ["airwalk", "--steps", "1", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.stderr
    with (tmp_path / "recording.mcap").open("rb") as file:
        events = [
            message_class("Event").FromString(message.data).code
            for _, _, message in make_reader(file).iter_messages(topics=["/events"])
        ]
    assert [code for code in events if code in SupervisorState.__members__] == ["READY", "ACTIVE", "HOLD"]


@pytest.mark.sample(2)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_in_hold_and_keeps_recording_and_summary(number, code, tmp_path: Path):
    command = [ATALANTE, "airwalk", "--steps", "1000", "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as airwalk:
        assert airwalk.stderr is not None
        for line in airwalk.stderr:
            if "ACTIVE" in line:
                break
        airwalk.send_signal(number)
        _, errors = airwalk.communicate(timeout=60)
    assert airwalk.returncode == code, errors
    assert "HOLD" in errors
    with (tmp_path / "recording.mcap").open("rb") as file:
        states = [
            message_class("Event").FromString(message.data).code
            for _, _, message in make_reader(file).iter_messages(topics=["/events"])
        ]
    assert states[-1] == "HOLD"
    assert json.loads((tmp_path / "summary.json").read_text())["shapes"][0]["shape"] == "constant"


@pytest.mark.long
def test_a_patient_s_gait_of_the_network_is_walked_inside_a_certified_guide(tmp_path: Path):
    done = atalante("demo", "--shape", "pinched", "--steps", "2", "--mass", "75", "--height", "175", "--step-length", "0.16",
                    "--step-duration", "0.8", "--thigh", "0.44", "--shank", "0.42", "--out", str(tmp_path), "--json")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "gait of the network: 75 kg, 1.75 m, thigh 0.440 m, shank 0.420 m, step 0.16 m in 0.8 s" in done.stderr
    result = json.loads(done.stdout.splitlines()[0])
    assert result["certified"]
    assert result["max_ratio"] < 1.0
    assert result["inside"] == 1.0
    assert json.loads((tmp_path / "summary.json").read_text())["subject"]["step_length"] == 0.16


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--mass", "110", "--height", "175"], 1, "mass for the gait network must be 58 to 91 kg, got 110 kg"),
        (
            ["--mass", "75", "--height", "175", "--step-length", "0.35"],
            1,
            "step length for the gait network must be 0.1 to 0.2 m",
        ),
        (
            ["--mass", "75", "--height", "175", "--thigh", "50"],
            1,
            "thigh length for the gait network must be 0.403 to 0.454 m at a height of 1.75 m, got 0.500 m",
        ),
        (["--mass", "75"], 2, "a patient requires both --mass and --height"),
        (["--step-length", "0.15"], 2, "require a patient"),
        (["--mass", "75", "--height", "175", "--step-duration", "0.85123"], 2, "a whole number of milliseconds"),
    ],
)
def test_a_subject_out_of_range_is_rejected_with_the_range(arguments, code, message, tmp_path: Path):
    done = CliRunner().invoke(cli, ["airwalk", "--out", str(tmp_path), *arguments])
    assert done.exit_code == code, done.stderr
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("command", ["airwalk", "demo"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda points: points + 2.84,
            r"GAIT_INVALID: gait '75 kg, 1.75 m, step 0.15 m in 0.9 s': angle of joints\.\w+_SK must be 0 to 110\.01 deg, "
            r"got \d+\.\d+ deg at phase \d\.\d+ of the \w+-stance step, 8\d deg beyond",
        ),
        (lambda points: points + 1e200, "control points of a gait must be at most 6.28 rad, got 1e\\+200 rad"),
    ],
    ids=["86 degrees", "no angle"],
)
def test_a_network_of_wrong_weights_is_not_walked(
    command: str, change: Any, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    network = load_network()
    bias = network.layers[-1].bias.copy().reshape(len(JOINTS), -1)
    knees = [JOINTS.index("left_SK"), JOINTS.index("right_SK")]
    bias[knees] = change(bias[knees])
    last = network.layers[-1]._replace(bias=bias.ravel())
    path, out = tmp_path / "network.npz", tmp_path / "run"
    save_network(replace(network, layers=(*network.layers[:-1], last)), path)
    monkeypatch.setattr(gait_network, "DEFAULT_NETWORK", path)
    subject = ["--mass", "75", "--height", "1.75", "--step-length", "0.15", "--step-duration", "0.9"]
    done = CliRunner().invoke(cli, [command, "--steps", "1", "--out", str(out), *subject])
    assert done.exit_code == 1, done.stderr
    assert re.fullmatch(f"atalante: {message}.*\n", done.stderr)
    assert not out.exists()
