"""Tests of the telemetry process, running, stopped or killed: the loop is not affected and the recorded data is kept."""

from __future__ import annotations

import os
import resource
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import atalante_dbc
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.record_layout import Layout
from atalante_hal.robot import Robot
from atalante_hal.safety.events import Event
from atalante_hal.telemetry import process as process_module
from atalante_hal.telemetry.child import FRAMES, RECORDS, TelemetryChild
from atalante_hal.telemetry.process import Recording, TelemetryConfig, TelemetryError, TelemetryProcess
from atalante_hal.telemetry.ring import RingReader
from atalante_hal.telemetry.schema import DESCRIPTORS
from atalante_hal.wire.frame import new_frames

FOREVER = 3600.0  # patience [s]: a writer that waits blocks the test
TRIES = 600  # number of waits of 50 ms each, for an action of another process


@pytest.fixture(scope="module")
def layout(network: atalante_dbc.Network, robot: Robot) -> Layout:
    return Hal(network, robot, lockstep_pair()[0]).layout


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def write(telemetry: TelemetryProcess, cycles: range) -> None:
    record, layout = np.zeros(telemetry.layout.size), telemetry.layout
    for cycle in cycles:
        record[layout["cycle"]], record[layout["time"]] = cycle, cycle * 1e-3
        record[layout["position"]] = cycle / 8
        telemetry.write(record)


def recorded(path: Path, topic: str = "/joint_states") -> list[Any]:
    """Return the decoded messages of a finished recording. Only a finished recording has the required index."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_summary() is not None
        return [message for _, _, _, message in reader.iter_decoded_messages(topics=[topic])]


def pid_of(telemetry: TelemetryProcess) -> int:
    assert telemetry._child is not None
    return telemetry._child.pid


def until(wanted: Callable[[], Any]) -> Any:
    for _ in range(TRIES):
        if found := wanted():
            return found
        time.sleep(0.05)
    raise AssertionError("the expected condition did not occur")


class TestSession:
    def test_every_cycle_of_every_run_is_recorded(self, layout: Layout, tmp_path: Path) -> None:
        path = tmp_path / "recording.mcap"
        config = TelemetryConfig(recording=path, record_rate=1000, lock_step=True, publish=False, slots=64)
        with TelemetryProcess(config, layout, about={"seed": 3}, diagnostics=["NODES_WELL"]) as telemetry:
            for number, shape in enumerate(("constant", "pinched")):
                telemetry.begin_run(shape, {"xi": 0.5})
                telemetry.event(Event(0, "READY", "OFF -> READY", node="HAL"))
                write(telemetry, range(1, 501))
                assert telemetry.alive
                assert telemetry.records.lossless, number
            summary = telemetry.close()
        assert (summary.complete, summary.lost, summary.published, summary.notices) == (True, 0, 0, ())
        assert summary.recording == Recording(("recording.mcap",), True, 0)
        states, system = recorded(path), recorded(path, "/system")
        assert [message.cycle for message in states] == [*range(1, 501)] * 2
        assert [message.position[3] for message in states[:500]] == [cycle / 8 for cycle in range(1, 501)]
        assert [message.run for message in system] == [0] * 500 + [1] * 500
        assert [message.run_name for message in system] == ["constant"] * 500 + ["pinched"] * 500
        times = [message.timestamp.ToNanoseconds() for message in states]
        assert times[:500] == [cycle * 1_000_000 for cycle in range(1, 501)]
        assert times[500] == times[499] + 1_001_000_000  # a gap of 1 s, then cycle 1
        assert [message.code for message in recorded(path, "/events")] == ["READY"] * 2
        assert summary.recorded == 1000 * 5 + 10 + 2
        with path.open("rb") as file:
            about = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
        assert about["session"] == {"seed": "3", "record_rate_hz": "1000"}
        assert about["run/1"] == {"name": "pinched", "start_ns": "1500000000", "xi": "0.5"}

    @pytest.mark.parametrize("cycles", [5, 1999])
    def test_lock_step_recording_loses_no_cycle(self, layout: Layout, tmp_path: Path, cycles: int) -> None:
        config = TelemetryConfig(
            recording=tmp_path / "r.mcap", record_rate=100, lock_step=True, publish=False, slots=16, patience=FOREVER
        )
        with TelemetryProcess(config, layout) as telemetry:
            write(telemetry, range(1, cycles + 1))
            summary = telemetry.close()
        assert summary.recording == Recording(("r.mcap",), True, 0)
        assert [message.cycle for message in recorded(tmp_path / "r.mcap")] == list(range(10, cycles + 1, 10))

    def test_two_lock_step_sessions_make_identical_recordings(self, layout: Layout, tmp_path: Path) -> None:
        for name in ("one", "two"):
            path = tmp_path / f"{name}.mcap"
            config = TelemetryConfig(recording=path, record_rate=1000, lock_step=True, publish=False)
            with TelemetryProcess(config, layout) as telemetry:
                telemetry.begin_run("constant")
                write(telemetry, range(1, 301))
        one, two = (
            [message.SerializeToString() for message in recorded(tmp_path / f"{name}.mcap")] for name in ("one", "two")
        )
        assert one == two
        assert len(one) == 300

    def test_wall_clock_recording_has_the_time_of_day(self, layout: Layout, tmp_path: Path) -> None:
        path = tmp_path / "recording.mcap"
        before = time.time_ns()
        with TelemetryProcess(TelemetryConfig(recording=path, publish=False), layout) as telemetry:
            telemetry.begin_run("constant")
            write(telemetry, range(10, 11))
        assert before + 10_000_000 <= recorded(path)[0].timestamp.ToNanoseconds() <= time.time_ns() + 10_000_000

    def test_timestamps_have_the_time_of_day_after_a_late_cycle(
        self, layout: Layout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The robot time stands still while the loop is late, but the time of day does not."""
        path, late = tmp_path / "recording.mcap", 3600 * 10**9
        now = [time.time_ns()]
        monkeypatch.setattr(time, "time_ns", lambda: now[0])
        with TelemetryProcess(TelemetryConfig(recording=path, publish=False), layout) as telemetry:
            telemetry.begin_run("constant")
            now[0] += 10_000_000
            write(telemetry, range(10, 11))
            now[0] += late
            write(telemetry, range(20, 21))
            telemetry.event(Event(20, "CYCLE_GAP", "a cycle began late"))
        stamps = [message.timestamp.ToNanoseconds() for message in (*recorded(path), *recorded(path, "/events"))]
        assert stamps == [now[0] - late, now[0], now[0]]

    def test_close_without_start_or_twice_reports_an_incomplete_session(self, layout: Layout) -> None:
        telemetry = TelemetryProcess(TelemetryConfig(publish=False), layout)
        assert not telemetry.close().complete
        assert not telemetry.close().complete


SUBSCRIBER = """
import sys, zenoh
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
pool = descriptor_pool.DescriptorPool()
for file in descriptor_pb2.FileDescriptorSet.FromString(open(sys.argv[2], "rb").read()).file:
    pool.Add(file)
config = zenoh.Config.from_json5('{mode: "client", connect: {endpoints: ["%s"]}}' % sys.argv[1])
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("transport/shared_memory/enabled", "false")  # the process will be killed
with zenoh.open(config) as session, session.declare_subscriber("atalante/*/*") as subscriber:
    for sample in subscriber:
        name = str(sample.encoding).split(";")[1]
        message = message_factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString(sample.payload.to_bytes())
        print(str(sample.key_expr).split("/")[2], message.cycle, flush=True)
"""


def subscribe(telemetry: TelemetryProcess) -> subprocess.Popen[str]:
    assert telemetry.endpoint is not None
    return subprocess.Popen(
        [sys.executable, "-c", SUBSCRIBER, telemetry.endpoint, str(DESCRIPTORS)], stdout=subprocess.PIPE, text=True
    )


def read_sample(child: subprocess.Popen[str]) -> tuple[str, int]:
    assert child.stdout is not None
    key, cycle = child.stdout.readline().split()
    return key, int(cycle)


class TestSubscriber:
    def test_subscriber_receives_typed_messages_at_the_documented_rates(self, layout: Layout) -> None:
        """Rates are counted in robot cycles: 100 Hz is every tenth, 10 Hz every hundredth."""
        with (
            TelemetryProcess(TelemetryConfig(listen=free_endpoint()), layout) as telemetry,
            subscribe(telemetry) as child,
        ):
            try:
                cycle = write_until_received(telemetry, child, 0)
                samples: list[tuple[str, int]] = []
                for _ in range(200):
                    write(telemetry, range(cycle, cycle + 10))
                    cycle += 10
                    time.sleep(0.005)  # at most 2 ms per cycle: about as fast as a lock-step run
                last = cycle
                while not samples or samples[-1][1] < last:
                    cycle = write_until_received(telemetry, child, cycle)
                    samples.append(read_sample(child))
            finally:
                child.kill()
        first = last - 2000
        for key, every in {
            "joint_states": 10,
            "imu": 10,
            "foot_forces": 10,
            "haptics": 10,
            "system": 10,
            "loop": 100,
        }.items():
            cycles = [at for sample_key, at in samples if sample_key == key and first <= at < last]
            assert all(at % every == 0 for at in cycles), key
            assert 0.5 * 2000 / every <= len(cycles) <= 2000 / every, key

    def test_stopped_subscriber_does_not_affect_loop_or_recording(self, layout: Layout, tmp_path: Path) -> None:
        path = tmp_path / "recording.mcap"
        config = TelemetryConfig(
            recording=path,
            record_rate=1000,
            stream_rate=1000,
            lock_step=True,
            listen=free_endpoint(),
            patience=FOREVER,
            slots=256,
        )
        with TelemetryProcess(config, layout) as telemetry, subscribe(telemetry) as child:
            try:
                cycle = write_until_received(telemetry, child, 0)
                child.send_signal(signal.SIGSTOP)
                write(telemetry, range(cycle, cycle + 4000))
                summary = telemetry.close()
            finally:
                child.kill()
        assert summary.complete
        assert summary.lost == 0
        assert [message.cycle for message in recorded(path)] == list(range(cycle + 4000))


def write_until_received(telemetry: TelemetryProcess, child: subprocess.Popen[str], cycle: int) -> int:
    """Write from `cycle` on until the subscriber prints a message; return the next cycle."""
    for _ in range(TRIES):
        if select.select([child.stdout], [], [], 0.02)[0]:
            return cycle
        write(telemetry, range(cycle, cycle + 10))
        cycle += 10
    raise AssertionError("the subscriber received nothing")


class BusyChild:
    """Replacement for `TelemetryChild` that runs in the test process and reads one record whenever the test wants it."""

    alive, pid = True, 0

    def __init__(self) -> None:
        self.reports: list[Callable[[], dict[str, Any] | None]] = [lambda: {"endpoint": None, "notices": []}]
        self.readers: dict[str, RingReader] = {}

    def take_files(self) -> dict[str, int]:
        return {}

    def configure(self, arguments: dict[str, Any]) -> None:
        self.readers = {name: RingReader(os.dup(fd)) for name, fd in arguments["rings"].items()}

    def report(self, timeout: float) -> dict[str, Any] | None:
        return self.reports.pop(0)() if self.reports else None

    def close(self, patience: float = 0.0) -> None:
        while self.readers:
            self.readers.popitem()[1].close()


class TestBusyTelemetry:
    def test_telemetry_that_reads_only_frames_is_not_restarted(
        self, layout: Layout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(process_module, "HANGS_AFTER", 0.0)
        child: Any = BusyChild()
        config = TelemetryConfig(publish=False, can_log=tmp_path / "run.log")
        with TelemetryProcess(config, layout, child=child) as telemetry:
            write(telemetry, range(5))
            telemetry.tap().received(new_frames(64 * 5), 64 * 5)
            for _ in range(4):
                telemetry.tend()
                child.readers[FRAMES].read(1)
            assert telemetry.close().restarts == 0

    def test_telemetry_that_reads_nothing_is_restarted(
        self, layout: Layout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(process_module, "HANGS_AFTER", 0.0)
        monkeypatch.setattr(process_module, "TelemetryChild", lambda _: BusyChild())
        child: Any = BusyChild()
        config = TelemetryConfig(publish=False, can_log=tmp_path / "run.log")
        with TelemetryProcess(config, layout, child=child) as telemetry:
            telemetry.tap().received(new_frames(64 * 5), 64 * 5)
            telemetry.tend()
            telemetry.tend()
            assert telemetry.close().restarts == 1

    def test_restart_keeps_existing_files_with_numbered_names(
        self, layout: Layout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        configured: list[dict[str, Any]] = []

        class Restarted(BusyChild):
            def configure(self, arguments: dict[str, Any]) -> None:
                super().configure(arguments)
                configured.append(arguments["config"])

        monkeypatch.setattr(process_module, "TelemetryChild", lambda _: Restarted())
        (tmp_path / "run-1.log").touch()
        (tmp_path / "run-2.log").touch()
        (tmp_path / "run-1.mcap").touch()
        child: Any = BusyChild()
        config = TelemetryConfig(publish=False, can_log=tmp_path / "run.log", recording=tmp_path / "run.mcap")
        with TelemetryProcess(config, layout, child=child) as telemetry:
            child.alive = False
            telemetry.tend()
            recording = telemetry.close().recording
        assert [Path(configured[0][name]).name for name in ("can_log", "recording")] == ["run-3.log", "run-2.mcap"]
        assert recording is not None
        assert recording.files == ("run.mcap", "run-2.mcap")

    def test_close_waits_while_telemetry_reads_records(self, layout: Layout) -> None:
        child: Any = BusyChild()
        with TelemetryProcess(TelemetryConfig(publish=False), layout, child=child) as telemetry:
            write(telemetry, range(5))

            def read_without_a_report() -> None:
                child.readers[RECORDS].read(1)

            child.reports = [read_without_a_report] * 5 + [lambda: {"published": 5, "notices": []}]
            summary = telemetry.close(timeout=0.0)
        assert summary.complete
        assert summary.published == 5

    def test_close_ends_telemetry_without_progress(self, layout: Layout) -> None:
        child: Any = BusyChild()
        with TelemetryProcess(TelemetryConfig(publish=False), layout, child=child) as telemetry:
            write(telemetry, range(5))
            child.reports = [lambda: None, lambda: {"published": 5, "notices": []}]
            assert not telemetry.close(timeout=0.0).complete
        assert child.readers == {}


class TestEndOfTelemetry:
    def test_killed_telemetry_does_not_affect_the_writer(self, layout: Layout, tmp_path: Path) -> None:
        config = TelemetryConfig(
            recording=tmp_path / "r.mcap", record_rate=1000, lock_step=True, publish=False, slots=64, patience=FOREVER
        )
        with TelemetryProcess(config, layout) as telemetry:
            write(telemetry, range(200))
            os.kill(pid_of(telemetry), signal.SIGKILL)
            write(telemetry, range(200, 2000))
            until(lambda: not telemetry.alive)
            telemetry.event(Event(2000, "READY", "still no exception"))
            assert not telemetry.records.lossless
            assert not telemetry.close().complete

    def test_writer_overwrites_records_while_telemetry_is_stopped(self, layout: Layout, tmp_path: Path) -> None:
        path = tmp_path / "recording.mcap"
        config = TelemetryConfig(recording=path, record_rate=1000, publish=False, slots=64, patience=FOREVER)
        with TelemetryProcess(config, layout) as telemetry:
            os.kill(pid_of(telemetry), signal.SIGSTOP)
            write(telemetry, range(2000))
            assert telemetry.alive
            os.kill(pid_of(telemetry), signal.SIGCONT)
            summary = telemetry.close()
        cycles = [message.cycle for message in recorded(path)]
        assert cycles[-1] == 1999
        assert len(cycles) + summary.lost == 2000
        assert summary.recording == Recording(("recording.mcap",), False, summary.lost)
        assert summary.lost >= 2000 - 2 * 64
        assert [event.code for event in recorded(path, "/events")] == ["TELEMETRY_DROPPED"]

    def test_close_kills_telemetry_that_stays_stopped(self, layout: Layout) -> None:
        with TelemetryProcess(TelemetryConfig(publish=False), layout) as telemetry:
            pid = pid_of(telemetry)
            os.kill(pid, signal.SIGSTOP)
            write(telemetry, range(10))
            assert not telemetry.close(timeout=0.1).complete
        assert not Path(f"/proc/{pid}").exists()

    def test_sigterm_finishes_the_recording_and_releases_a_waiting_writer(self, layout: Layout, tmp_path: Path) -> None:
        path = tmp_path / "recording.mcap"
        config = TelemetryConfig(
            recording=path, record_rate=1000, lock_step=True, listen=free_endpoint(), slots=64, patience=FOREVER
        )
        with TelemetryProcess(config, layout) as telemetry:
            write(telemetry, range(500))
            os.kill(pid_of(telemetry), signal.SIGTERM)
            write(telemetry, range(500, 3000))
            until(lambda: not telemetry.alive)
        cycles = [message.cycle for message in recorded(path)]
        assert cycles == list(range(len(cycles)))
        assert len(cycles) >= 500 - 64

    def test_sigint_does_not_end_telemetry(self, layout: Layout, tmp_path: Path) -> None:
        path = tmp_path / "recording.mcap"
        config = TelemetryConfig(recording=path, record_rate=1000, lock_step=True, publish=False, slots=64)
        with TelemetryProcess(config, layout) as telemetry:
            assert os.getpgid(pid_of(telemetry)) != os.getpgid(0)
            os.kill(pid_of(telemetry), signal.SIGINT)
            write(telemetry, range(500))
            assert telemetry.close().complete
        assert len(recorded(path)) == 500

    def test_recording_is_finished_when_the_loop_is_killed(self, layout: Layout, tmp_path: Path) -> None:
        path = tmp_path / "recording.mcap"
        program = (
            "import json, os, signal, sys\n"
            "import numpy as np\n"
            "from pathlib import Path\n"
            "from atalante_hal.record_layout import Layout\n"
            "from atalante_hal.telemetry.process import TelemetryConfig, TelemetryProcess\n"
            "layout = Layout.from_json(sys.argv[1])\n"
            "config = TelemetryConfig(recording=Path(sys.argv[2]), record_rate=1000, listen=sys.argv[3])\n"
            "telemetry = TelemetryProcess(config, layout)\n"
            "telemetry.start()\n"
            "record = np.zeros(layout.size)\n"
            "for cycle in range(300):\n"
            "    record[0] = cycle\n"
            "    telemetry.write(record)\n"
            "print(telemetry._child.pid, flush=True)\n"
            "os.kill(os.getpid(), signal.SIGKILL)\n"
        )
        done = subprocess.run(
            [sys.executable, "-c", program, layout.to_json(), str(path), free_endpoint()],
            stdout=subprocess.PIPE,
            check=False,
        )
        assert done.returncode == -signal.SIGKILL
        pid = int(done.stdout)
        until(lambda: not Path(f"/proc/{pid}/exe").exists())
        assert [message.cycle for message in recorded(path)] == list(range(300))


def test_full_disk_stops_only_the_recording(layout: Layout, tmp_path: Path) -> None:
    config = TelemetryConfig(
        recording=tmp_path / "r.mcap", record_rate=1000, lock_step=True, publish=False, slots=64, patience=FOREVER
    )
    telemetry = TelemetryProcess(config, layout)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))  # the child inherits it
    try:
        telemetry.start()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    record = np.zeros(layout.size)
    rng = np.random.default_rng(1)
    for cycle in range(2000):
        record[:] = rng.random(layout.size)
        record[layout["cycle"]] = cycle
        telemetry.write(record)
    assert telemetry.alive
    assert telemetry.records.lossless
    summary = telemetry.close()
    assert summary.complete
    assert summary.lost == 0
    assert summary.notices == (f"the recording {tmp_path / 'r.mcap'} stopped: File too large",)
    assert summary.recording is not None
    assert not summary.recording.complete
    assert 0 < summary.recording.missing_cycles <= 2000


class TestRejectedConfigurations:
    @pytest.mark.parametrize("rate", [0, -1, 3, 300, 2000])
    def test_rate_that_is_no_divisor_of_the_loop_rate_is_rejected(self, rate: int) -> None:
        with pytest.raises(TelemetryError, match="must be a divisor of 1000 Hz"):
            TelemetryConfig(record_rate=rate)

    @pytest.mark.parametrize("robot", ["", "a/b", "**", "a b", "@x"])
    def test_robot_name_that_is_no_key_chunk_is_rejected(self, robot: str) -> None:
        with pytest.raises(TelemetryError, match="must be a name of letters, digits"):
            TelemetryConfig(robot=robot)

    def test_log_format_that_loses_frames_is_rejected(self, layout: Layout, tmp_path: Path) -> None:
        with (
            pytest.raises(TelemetryError, match=r"\.log, \.asc, \.blf"),
            TelemetryProcess(TelemetryConfig(can_log=tmp_path / "run.db", publish=False), layout),
        ):
            pass

    def test_recording_path_that_cannot_be_created_is_rejected(self, layout: Layout, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        config = TelemetryConfig(recording=tmp_path / "file" / "r.mcap", publish=False)
        with pytest.raises(TelemetryError, match="cannot be created"), TelemetryProcess(config, layout):
            pass

    def test_configured_endpoint_with_a_taken_port_is_rejected(self, layout: Layout) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            config = TelemetryConfig(listen=f"tcp/127.0.0.1:{taken.getsockname()[1]}")
            with pytest.raises(TelemetryError, match="the port is taken"), TelemetryProcess(config, layout):
                pass

    def test_tap_without_a_can_log_is_rejected(self, layout: Layout) -> None:
        telemetry = TelemetryProcess(TelemetryConfig(publish=False), layout)
        with pytest.raises(TelemetryError, match="set can_log"):
            telemetry.tap()
        telemetry.close()


class TestLateStart:
    """Start of a telemetry process that is slower than the patience of a run on the wall clock."""

    @pytest.fixture
    def late(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[float], TelemetryConfig]:
        def config(delay: float) -> TelemetryConfig:
            (tmp_path / "sitecustomize.py").write_text(f"import time\ntime.sleep({delay})\n")
            monkeypatch.setenv("PYTHONPATH", str(tmp_path))
            return TelemetryConfig(recording=tmp_path / "r.mcap", record_rate=1000, publish=False, slots=64)

        return config

    def test_recording_starts_when_the_process_is_ready_and_counts_the_gap(
        self, layout: Layout, late: Callable[[float], TelemetryConfig], tmp_path: Path
    ) -> None:
        telemetry = TelemetryProcess(late(1.0), layout)
        telemetry.start(0.0)
        assert telemetry.notices[0].startswith("the telemetry process is not ready yet")
        telemetry.begin_run("constant")
        write(telemetry, range(1, 501))
        until(lambda: telemetry.records.taken == 500)
        write(telemetry, range(501, 521))
        summary = telemetry.close()
        assert (summary.complete, summary.lost, summary.restarts) == (True, 437, 0)
        assert summary.recording == Recording(("r.mcap",), False, 437)
        assert [message.cycle for message in recorded(tmp_path / "r.mcap")] == list(range(438, 521))

    def test_run_that_ends_before_the_process_is_ready_is_recorded(
        self, layout: Layout, late: Callable[[float], TelemetryConfig], tmp_path: Path
    ) -> None:
        telemetry = TelemetryProcess(late(1.0), layout)
        telemetry.start(0.0)
        write(telemetry, range(1, 51))
        telemetry.tend()
        assert telemetry.close(60.0).recording == Recording(("r.mcap",), True, 0)
        assert [message.cycle for message in recorded(tmp_path / "r.mcap")] == list(range(1, 51))

    def test_process_that_is_never_ready_is_killed_at_the_end(
        self, layout: Layout, late: Callable[[float], TelemetryConfig]
    ) -> None:
        telemetry = TelemetryProcess(late(3600.0), layout)
        telemetry.start(0.0)
        write(telemetry, range(1, 51))
        summary = telemetry.close(0.1)
        assert not telemetry.alive
        assert not summary.complete
        assert summary.notices == ("the telemetry process was not ready at the end of the run",)
        assert summary.recording == Recording((), False, 50)

    def test_lock_step_start_fails_when_the_process_is_not_ready_in_time(
        self, layout: Layout, late: Callable[[float], TelemetryConfig]
    ) -> None:
        telemetry = TelemetryProcess(replace(late(3600.0), lock_step=True), layout)
        with pytest.raises(TelemetryError, match="was not ready within 1 s"):
            telemetry.start(1.0)


class TestEarlyChild:
    """A telemetry process that is started before its session is known."""

    def test_session_uses_the_process_that_was_started_early(self, layout: Layout, tmp_path: Path) -> None:
        config = TelemetryConfig(recording=tmp_path / "r.mcap", record_rate=1000, publish=False, lock_step=True)
        with TelemetryChild() as child:
            telemetry = TelemetryProcess(config, layout, child=child)
            telemetry.start()
            assert pid_of(telemetry) == child.pid
            write(telemetry, range(1, 51))
            assert telemetry.close().recording == Recording(("r.mcap",), True, 0)
            assert not child.alive

    def test_process_without_a_session_ends_with_its_block(self) -> None:
        with TelemetryChild() as child:
            assert child.alive
        assert not child.alive

    def test_session_that_does_not_start_ends_its_process(self, layout: Layout) -> None:
        child = TelemetryChild()
        TelemetryProcess(TelemetryConfig(publish=False), layout, child=child).close()
        assert not child.alive

    def test_process_without_a_session_ends_when_its_parent_is_killed(self) -> None:
        program = (
            "import os, signal\n"
            "from atalante_hal.telemetry.child import TelemetryChild\n"
            "print(TelemetryChild().pid, flush=True)\n"
            "os.kill(os.getpid(), signal.SIGKILL)\n"
        )
        done = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=False)
        assert done.returncode == -signal.SIGKILL
        pid = int(done.stdout)
        until(lambda: not Path(f"/proc/{pid}/exe").exists())

    def test_process_that_ended_before_its_session_is_an_error(self, layout: Layout) -> None:
        child = TelemetryChild()
        child.kill()
        child.wait()
        telemetry = TelemetryProcess(TelemetryConfig(publish=False, lock_step=True), layout, child=child)
        with pytest.raises(TelemetryError, match="was not ready"):
            telemetry.start()


def test_recording_is_complete_without_zenoh(layout: Layout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "zenoh.py").write_text("raise ImportError('no zenoh here', name='zenoh')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    path = tmp_path / "recording.mcap"
    with TelemetryProcess(TelemetryConfig(recording=path, record_rate=1000, lock_step=True), layout) as telemetry:
        assert telemetry.endpoint is None
        assert "zenoh is missing" in telemetry.notices[0]
        write(telemetry, range(100))
        assert telemetry.close().complete
    assert len(recorded(path)) == 100


class TestCanLog:
    """The whole closed loop on the embedded bus, every frame logged."""

    CYCLES = 60

    def log(self, make_rig: Callable[..., Any], path: Path, seed: int) -> Path:
        rig = make_rig(seed=seed)
        network = rig.hal.network
        config = TelemetryConfig(can_log=path, lock_step=True, publish=False, slots=64)
        bus_of = {message.frame_id: message.bus for message in network.messages}
        with TelemetryProcess(config, rig.hal.layout, bus_of=bus_of, buses=network.buses) as telemetry:
            for shape in ("constant", "pinched"):
                telemetry.begin_run(shape)
                start = rig.hal.state.cycle
                rig.hal.tap = telemetry.tap(lambda start=start: (rig.hal.state.cycle - start) * 1_000_000)
                for _ in range(self.CYCLES):
                    rig.cycle()
                    telemetry.write(rig.hal.record)
            summary = telemetry.close()
        assert summary.complete
        assert summary.frames_lost == 0
        assert summary.frames_logged == len(path.read_text().splitlines())
        return path

    def test_can_log_is_identical_for_one_seed_and_differs_for_another(
        self, make_rig: Callable[..., Any], tmp_path: Path
    ) -> None:
        one, again, other = (
            self.log(make_rig, tmp_path / f"{name}.log", seed).read_bytes()
            for name, seed in (("one", 1), ("again", 1), ("other", 2))
        )
        assert one == again
        assert one != other

    def test_can_log_has_one_channel_per_bus_and_monotonic_time(
        self, make_rig: Callable[..., Any], tmp_path: Path
    ) -> None:
        messages = list(can.LogReader(self.log(make_rig, tmp_path / "run.log", 1)))
        assert {message.channel for message in messages} == {"left_leg", "right_leg", "left_sense", "right_sense"}
        times = [message.timestamp for message in messages]
        assert times == sorted(times)
        assert max(np.diff(times)) > 1.0
        syncs = [message for message in messages if message.arbitration_id == 0x010]
        assert len(syncs) == 2 * self.CYCLES
        assert not any(message.is_rx for message in syncs)
        states = [message for message in messages if message.arbitration_id == 0x181]
        assert len(states) == 2 * self.CYCLES
        assert all(message.is_rx for message in states)
