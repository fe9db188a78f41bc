"""`atalante doctor --bus`: time from a SYNC to states and commands, with synthetic timestamps."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner, Result

from atalante_dbc import Network
from atalante_hal.bus import Bus, Stamps
from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import Frames, new_frames
from atalante_tools.cli import cli
from atalante_tools.commands import doctor
from atalante_tools.commands.bus_timing import COMMAND_BUDGET, STATE_BUDGET, BusTiming, Latency
from atalante_tools.console.options import Target
from atalante_tools.console.stop_request import StopRequest
from atalante_tools.session import rig as rig_module
from atalante_tools.session.rig import open_hal
from tests.tools.commands.recorder import Tap

EMBEDDED = Target("embedded", "", lockstep=True)
#: Synthetic time of the first SYNC [ns].
START = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def traffic() -> Frames:
    """Return all frames of 0.4 s of an embedded robot in lock-step."""
    tap = Tap()
    with open_hal(EMBEDDED, tap=tap) as rig:
        for _ in range(400):
            rig.hal.read()
            rig.hal.hold()
    return np.concatenate(tap.batches)


def stamped(network: Network, frames: Frames, state_us: float = 100.0, command_us: float = 600.0) -> Stamps:
    """Return a timestamp [ns] for each frame. A cycle takes 1 ms.

    The first state of a bus is `state_us` after its SYNC, and each further state of this bus is 10 us later. Commands are
    `command_us` after their SYNC.
    """
    first = network.message("SYNC_LEFT_LEG").frame_id
    messages = {m.frame_id: m for m in network.messages}
    cycle, states = -1, dict.fromkeys(network.buses, 0)
    stamps = np.zeros(len(frames), np.int64)
    for index, frame_id in enumerate(frames["can_id"].tolist()):
        message = messages[frame_id]
        if frame_id == first:
            cycle, states = cycle + 1, dict.fromkeys(network.buses, 0)
        after = 0.0
        if message.sender == "HAL" and not message.name.startswith("SYNC_"):
            after = command_us
        elif message.name.endswith("_STATE"):
            after = state_us + 10.0 * states[message.bus]
            states[message.bus] += 1
        stamps[index] = START + cycle * 1_000_000 + round(after * 1e3)
    return stamps


def timed(network: Network, frames: Frames, stamps: Stamps) -> BusTiming:
    timing = BusTiming(network)
    for begin in range(0, len(frames), 256):
        block = frames[begin : begin + 256]
        timing.accept(block, stamps[begin : begin + 256], len(block))
    return timing


def latency(timing: BusTiming, bus: str, kind: str) -> Latency:
    return next(x for x in timing.report() if (x.bus, x.kind) == (bus, kind))


def test_latencies_of_lockstep_traffic_equal_the_synthetic_delays(network: Network, traffic: Frames) -> None:
    timing = timed(network, traffic, stamped(network, traffic))
    assert {(x.bus, x.kind) for x in timing.report()} >= {
        (bus, "state") for bus in ("left_leg", "right_leg", "left_sense", "right_sense")
    } | {("left_leg", "command"), ("right_leg", "command")}
    states, commands = latency(timing, "left_leg", "state"), latency(timing, "left_leg", "command")
    assert states.samples > 6 * 300
    assert (states.min_us, states.median_us, states.max_us) == pytest.approx((100.0, 125.0, 150.0))
    assert states.p99_us == pytest.approx(150.0)
    assert (commands.min_us, commands.median_us, commands.max_us) == pytest.approx((600.0, 600.0, 600.0))
    assert (states.budget_us, commands.budget_us) == (STATE_BUDGET, COMMAND_BUDGET) == (500.0, 1000.0)
    assert states.fits
    assert commands.fits
    assert timing.skipped == 0


def test_wire_time_is_the_sum_of_the_frames_of_a_cycle(network: Network, traffic: Frames) -> None:
    timing = timed(network, traffic, stamped(network, traffic))
    assert latency(timing, "left_leg", "state").wire_us == pytest.approx(6 * 63.8)
    assert latency(timing, "left_leg", "command").wire_us == pytest.approx(136.8)


def frames_of(network: Network, *names: str) -> Frames:
    frames = new_frames(len(names))
    frames["can_id"] = [network.message(name).frame_id for name in names]
    return frames


def test_percentile_and_maximum_show_single_late_frames(network: Network) -> None:
    frames = frames_of(network, *(["SYNC_LEFT_LEG", "LEFT_SK_STATE"] * 1000))
    stamps = np.repeat(START + np.arange(1000) * 1_000_000, 2)
    stamps[1::2] += 200_000
    stamps[1] += 700_000
    (found,) = timed(network, frames, stamps).report()
    assert (found.samples, found.p99_us, found.max_us) == (1000, 200.0, 900.0)
    assert found.fits
    stamps[1:61:2] += 700_000
    assert not timed(network, frames, stamps).report()[0].fits


def test_latency_of_a_bus_is_measured_from_its_own_sync(network: Network) -> None:
    frames = frames_of(network, "SYNC_LEFT_LEG", "SYNC_RIGHT_LEG", "LEFT_SK_STATE", "RIGHT_SK_STATE")
    other_clock = 5_000_000_000
    stamps = np.array([0, other_clock, 90_000, other_clock + 110_000])
    timing = timed(network, frames, stamps)
    assert [(x.bus, x.median_us) for x in timing.report()] == [("left_leg", 90.0), ("right_leg", 110.0)]


def test_frames_without_an_earlier_sync_are_skipped_and_counted(network: Network) -> None:
    frames = frames_of(network, "LEFT_SK_STATE", "SYNC_LEFT_LEG", "LEFT_SK_STATE", "RIGHT_SK_STATE")
    timing = timed(network, frames, np.array([5, 10, 9, 20]))
    assert (timing.report(), timing.skipped) == ([], 3)


def test_status_and_pendant_frames_are_not_timed(network: Network) -> None:
    frames = frames_of(network, "SYNC_RIGHT_SENSE", "PENDANT_STATE", "SYNC_LEFT_LEG", "LEFT_SK_STATUS")
    assert timed(network, frames, np.arange(4)).report() == []


# -- the command -----------------------------------------------------------------------------------------------------


class StampedBus(WrappedBus):
    """Listening end of a lock-step pair with synthetic timestamps; rejects every `send`."""

    def __init__(self, bus: Bus, stamps: Stamps) -> None:
        super().__init__(bus)
        self._left, self._now = stamps, np.zeros(256, np.int64)

    @property
    def stamps(self) -> Stamps:
        return self._now

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        count = super().receive(frames, timeout)
        self._now[:count], self._left = self._left[:count], self._left[count:]
        return count

    def send(self, frames: Frames) -> None:
        raise AssertionError("doctor sends nothing")


def invoke(
    monkeypatch: pytest.MonkeyPatch, network: Network, frames: Frames, stamps: Stamps, *arguments: str
) -> Result:
    ours, theirs = lockstep_pair()
    deliver(theirs, frames)
    bus = StampedBus(ours, stamps)
    monkeypatch.setattr(rig_module, "open_buses", lambda network, target: dict.fromkeys(network.buses, bus))
    monkeypatch.setattr("atalante_tools.commands.machine.ThisMachine.open_channel", lambda *_: None)
    return CliRunner().invoke(cli, ["doctor", "-i", "pcan", "-c", "test", "--bus", "--for", "0.2", *arguments])


def deliver(bus: PairBus, frames: Frames) -> None:
    for begin in range(0, len(frames), 128):
        bus.send(np.ascontiguousarray(frames[begin : begin + 128]))


def test_the_table_names_clock_and_budget(monkeypatch: pytest.MonkeyPatch, network: Network, traffic: Frames) -> None:
    some = traffic[:1000]
    result = invoke(monkeypatch, network, some, stamped(network, some))
    assert result.exit_code == 0, result.output
    assert "time from the end of a SYNC to the end of the frame, hardware timestamps" in result.stdout
    header, first = result.stdout.split("hardware timestamps\n")[1].splitlines()[:2]
    assert header.split("  ")[0] == "bus"
    assert "budget us" in header
    assert first.split()[:2] == ["left_leg", "command"] or first.split()[:2] == ["left_leg", "state"]


def test_json_has_one_object_per_bus_and_kind(
    monkeypatch: pytest.MonkeyPatch, network: Network, traffic: Frames
) -> None:
    some = traffic[:1000]
    result = invoke(monkeypatch, network, some, stamped(network, some), "--json")
    found = [value for value in map(json.loads, result.stdout.splitlines()) if "median_us" in value]
    assert {value["stamps"] for value in found} == {"hardware"}
    state = next(value for value in found if (value["bus"], value["kind"]) == ("left_leg", "state"))
    assert (state["min_us"], state["max_us"], state["fits"]) == (100.0, 150.0, True)


def test_late_states_are_named_and_end_with_code_1(
    monkeypatch: pytest.MonkeyPatch, network: Network, traffic: Frames
) -> None:
    some = traffic[:1000]
    result = invoke(monkeypatch, network, some, stamped(network, some, state_us=480.0))
    assert result.exit_code == 1
    assert (
        "99 % of the frames must arrive within the time budget, got too many late frames: state on left_leg"
        in result.stderr
    )


def test_a_bus_without_sync_fails_with_code_1(monkeypatch: pytest.MonkeyPatch, network: Network) -> None:
    result = invoke(monkeypatch, network, new_frames(0), np.zeros(0, np.int64))
    assert result.exit_code == 1
    assert "no answer to a SYNC on pcan test" in result.stderr


def test_bus_timing_of_the_embedded_robot_is_a_usage_error() -> None:
    result = CliRunner().invoke(cli, ["doctor", "--bus"])
    assert result.exit_code == 2
    assert "--bus requires an interface and a channel" in result.stderr


class StoppingBus(WrappedBus):
    """Bus on which no frame arrives. The stop signal arrives in the third `receive`."""

    def __init__(self, bus: Bus, stop: StopRequest) -> None:
        super().__init__(bus)
        self.calls, self._stop = 0, stop

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        self.calls += 1
        if self.calls == 3:
            self._stop.ask(2)
        return 0


def test_a_stop_request_ends_the_measurement(network: Network) -> None:
    stop = StopRequest()
    bus = StoppingBus(lockstep_pair()[0], stop)
    doctor.listen(bus, BusTiming(network), 5.0, stop)
    assert bus.calls == 3


@pytest.mark.parametrize(
    ("interface", "clock"),
    [("socketcan", "kernel"), ("kvaser", "hardware"), ("slcan", "software"), ("candle", "unknown")],
)
def test_timestamp_clock_depends_on_the_interface(interface: str, clock: str) -> None:
    assert doctor.stamp_clock(interface) == clock
