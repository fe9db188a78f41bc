"""Tests of the requirements for the other nodes: each emulated node passes, each defect fails exactly its own requirement."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections import deque
from collections.abc import Callable

import numpy as np
import pytest

from atalante_dbc import Message
from atalante_emulator.emulator import EmulatorParameters
from atalante_emulator.haptics import WATCHDOG, Haptics, HapticsParameters
from atalante_emulator.pendant import Operator
from atalante_hal.wire.e2e import COUNTER_BYTE
from atalante_hal.wire.frame import FLAG_FDF, ID_ERROR, ID_EXTENDED, ID_REMOTE, Frames, joined, new_frames
from atalante_tools.conform.examination import requirements_of
from atalante_tools.conform.requirement import Verdict, examine

from . import wire
from .conftest import MakeSetup, NodeSetup, not_passed, receive_as

Patch = pytest.MonkeyPatch
Break = Callable[[MakeSetup, Patch], NodeSetup]

IMU = "IMU_TORSO"
KINDS = {IMU: 22, "IMU_LEFT_TIBIA": 22, "FOOT_LEFT": 19, "FOOT_RIGHT": 19, "HAPTICS": 23, "PENDANT": 22}


@pytest.mark.parametrize("node", KINDS)
def test_emulated_node_passes_every_requirement(node: str, make_setup: MakeSetup):
    results = make_setup(node).examine()
    assert not_passed(results) == {}
    assert len(results) == KINDS[node]


@pytest.mark.parametrize("node", ["LEFT_SH", *KINDS])
@pytest.mark.sample(3)
def test_no_requirement_passes_without_a_frame_of_the_node(node: str, make_setup: MakeSetup):
    setup = make_setup(node)
    setup.wire.from_node = lambda frame: wire.NO_FRAME
    results = setup.examine()
    assert {r.requirement.id: r.measured for r in results if r.verdict is Verdict.PASSED} == {}
    assert all(r.measured.startswith(f"no frame of {node} received; ") for r in results)


def test_silence_between_two_syncs_passes_only_if_syncs_are_answered(make_setup: MakeSetup):
    setup = make_setup(IMU)
    state = setup.message("STATE").frame_id
    setup.wire.from_node = lambda frame: wire.NO_FRAME if int(frame["can_id"][0]) == state else frame
    setup.tester.idle(200)  # the heartbeats are received
    (result,) = examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == "NODE-06"])
    assert result.verdict is Verdict.NOT_TESTED
    assert "NODE-04" in result.measured or "no frame" in result.measured


# -- frames sent -------------------------------------------------------------------------------------------------------


def _sends(kind: str, change: Callable[[Frames, Message, int], Frames | None], node: str = IMU) -> Break:
    """Return a node whose frames of one kind are replaced by `change(frame, message, number)`; None means unchanged."""

    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        del monkeypatch
        setup = make_setup(node)
        message, number = setup.message(kind), -1

        def from_node(frame: Frames) -> Frames:
            nonlocal number
            if int(frame["can_id"][0]) != message.frame_id:
                return frame
            number += 1
            changed = change(frame.copy(), message, number)
            return frame if changed is None else changed

        setup.wire.from_node = from_node
        return setup

    return broken


def _never_booting(frame: Frames, message: Message, _: int) -> Frames:
    wire.put(frame, message, "NodeState", 5)
    return wire.protect(frame, message)


def _stopped_later(frame: Frames, message: Message, number: int) -> Frames | None:
    """Report STOPPED from the fifth heartbeat on."""
    if number < 4:
        return None
    wire.put(frame, message, "NodeState", 4)
    return wire.protect(frame, message)


def _every_other(frame: Frames, message: Message, number: int) -> Frames:
    if number > 1 and number % 2:
        return wire.NO_FRAME
    return wire.protect(frame, message, counter=number if number < 2 else number // 2 + 1)


def _one_missing(frame: Frames, _message: Message, number: int) -> Frames:
    """Drop one answer, 0.7 s after the start."""
    return wire.NO_FRAME if number == 700 else frame


def _counter_slips(frame: Frames, message: Message, number: int) -> Frames | None:
    return wire.protect(frame, message, counter=0x55) if number == 300 else None


def _other_data_id(frame: Frames, message: Message, number: int) -> Frames | None:
    return wire.protect(frame, message, data_id=message.data_id ^ 1) if number % 1000 == 999 else None


def _no_bit_rate_switch(frame: Frames, _message: Message, _number: int) -> Frames:
    frame["flags"] = FLAG_FDF
    return frame


def _reserved_bits(frame: Frames, message: Message, _: int) -> Frames:
    frame["data"][0][5] = 0xAA
    return wire.protect(frame, message)


def other_network(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    del monkeypatch
    network = make_setup(IMU).tester.network
    return make_setup(IMU, their_network=dataclasses.replace(network, hash32=network.hash32 ^ 1))


def raises_an_emergency(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    del monkeypatch
    setup = make_setup(IMU)
    message, calls = setup.message("EMCY"), 0

    def once() -> Frames:
        nonlocal calls
        calls += 1
        if calls != 150:
            return wire.NO_FRAME
        frame = np.zeros(1, wire.NO_FRAME.dtype)
        frame["can_id"] = message.frame_id
        wire.put(frame, message, "ErrorCode", 0x5000)
        return wire.protect(frame, message)

    setup.wire.from_node = lambda frame: frame
    setup.wire.unsolicited = once
    return setup


def _sends_unexpected(flag: int) -> Break:
    """Return a node that sends a copy of its 300th state frame with a flag in the identifier."""

    def copy(frame: Frames, _message: Message, number: int) -> Frames | None:
        if number != 300:
            return None
        other = frame.copy()
        other["can_id"] |= flag
        return joined([frame, other])

    return _sends("STATE", copy)


def sends_without_sync(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    last = np.zeros(1, wire.NO_FRAME.dtype)

    def answer(frame: Frames, _message: Message, _number: int) -> None:
        last[:] = frame

    setup = _sends("STATE", answer)(make_setup, monkeypatch)
    message = setup.message("STATE")

    def without_sync() -> Frames:
        if setup.wire.sync_sent:
            return wire.NO_FRAME
        last[:] = wire.protect(last, message, counter=int(last["data"][0, COUNTER_BYTE]) + 1 & 0xFF)
        return last.copy()

    setup.wire.unsolicited = without_sync
    return setup


# -- frames received ---------------------------------------------------------------------------------------------------


def _receives(kind: str, change: wire.Reading, node: str = IMU) -> Break:
    """Return a node that receives a message of the HAL changed by `change`."""

    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        del monkeypatch
        setup = make_setup(node)
        sync = setup.tester.sync.message
        return receive_as(setup, sync if kind == "SYNC" else setup.tester.command.message, sync.data_id, change)

    return broken


def overflows_its_queue(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    """Return a node whose receive queue holds four frames."""
    del monkeypatch
    setup = make_setup(IMU)
    known = {m.frame_id for m in setup.tester.network.messages}
    foreign = 0

    def to_node(frame: Frames) -> Frames:
        nonlocal foreign
        if int(frame["can_id"][0]) not in known:
            foreign += 1
            return frame
        overflow, foreign = foreign > 4, 0
        return wire.NO_FRAME if overflow else frame

    setup.wire.to_node = to_node
    return setup


# -- measured values ---------------------------------------------------------------------------------------------------


def _measures(change: Callable[[Callable[[str], int], int, np.ndarray], None], node: str = IMU) -> Break:
    """Return a node whose values are changed before encoding: `change(index of a signal, cycle, values)`."""

    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        del monkeypatch
        setup = make_setup(node)
        codec, message = setup.emulator.signals, setup.message("STATE").name
        setup.emulator.before_send.append(
            lambda cycle, values: change(lambda signal: codec.index(message, signal), cycle, values)
        )
        return setup

    return broken


def _set(signal: str, value: float, node: str = IMU) -> Break:
    def change(at: Callable[[str], int], _cycle: int, values: np.ndarray) -> None:
        values[at(signal)] = value

    return _measures(change, node)


def _shrunk_quaternion(at: Callable[[str], int], _: int, values: np.ndarray) -> None:
    for axis in "WXYZ":
        values[at(f"Quaternion{axis}")] *= 0.99


def _scaled_accel(at: Callable[[str], int], _: int, values: np.ndarray) -> None:
    for axis in "XYZ":
        values[at(f"Accel{axis}")] *= 1.05


def _swapped_accel(at: Callable[[str], int], _: int, values: np.ndarray) -> None:
    x, z = at("AccelX"), at("AccelZ")
    values[[x, z]] = values[[z, x]]


def _biased_gyro(at: Callable[[str], int], _: int, values: np.ndarray) -> None:
    values[at("GyroY")] += 0.1


def _tare_lost(at: Callable[[str], int], _: int, values: np.ndarray) -> None:
    values[at("RL_ForceZ")] += 25.0


def _no_temperature_once(at: Callable[[str], int], cycle: int, values: np.ndarray) -> None:
    if cycle == 1000:
        values[at("Temperature")] = math.nan


# -- haptics and pendant -----------------------------------------------------------------------------------------------


def _with_motors(advance: Callable[[Haptics, np.ndarray, int, int], None]) -> Break:
    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        class Broken(Haptics):
            def advance(self, level: np.ndarray, silence: int, cycles: int) -> None:
                advance(self, level, silence, cycles)

        monkeypatch.setattr("atalante_emulator.emulator.Haptics", Broken)
        return make_setup("HAPTICS")

    return broken


def _ramp(motors: Haptics, level: np.ndarray, silence: int, cycles: int) -> None:
    wanted = level if silence < WATCHDOG else 0.0 * level
    motors.amplitude += np.clip(wanted - motors.amplitude, -0.01 * cycles, 0.01 * cycles)


def _never_stop(motors: Haptics, level: np.ndarray, _silence: int, cycles: int) -> None:
    Haptics.advance(motors, level, 0, cycles)


def _stop_late(motors: Haptics, level: np.ndarray, silence: int, cycles: int) -> None:
    """Stop 250 ms after the last command."""
    Haptics.advance(motors, level, 0 if silence < 250 else silence, cycles)


def _vibrate_at_rest(motors: Haptics, level: np.ndarray, silence: int, cycles: int) -> None:
    """Vibrate slightly until the first command."""
    if not hasattr(motors, "commanded"):
        motors.commanded = False
    motors.commanded |= level.any()
    Haptics.advance(motors, level if motors.commanded else level + 0.1, silence if motors.commanded else 0, cycles)


def _weak(motors: Haptics, level: np.ndarray, silence: int, cycles: int) -> None:
    """Limit the level to 0.96."""
    Haptics.advance(motors, np.minimum(level, 0.96), silence, cycles)


def _levels(read: Callable[[list[int]], list[int]]) -> wire.Reading:
    def change(frame: Frames, message: Message, _: dict) -> Frames | None:
        if not wire.is_good(frame, message):
            return None
        names = [s.name for s in message.signals if s.name.endswith("_Level")]
        codes = read([wire.raw(frame, message, name) for name in names])
        for name, code in zip(names, codes, strict=True):
            wire.put(frame, message, name, code)
        return wire.protect(frame, message)

    return change


def _pendant(operator: Callable[[], Operator]) -> Break:
    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        del monkeypatch
        return make_setup("PENDANT", operator=operator())

    return broken


class Bouncing(Operator):
    """Operator with a START button that bounces."""

    def start(self) -> None:
        super().start()
        super().start()


class Swapped(Operator):
    """Operator with the HOLD button wired to STOP."""

    def hold(self) -> None:
        self.stop()


class Unplugged(Operator):
    """Operator with a disconnected STOP button."""

    def stop(self) -> None:
        pass


class SpuriousPress(Operator):
    """Operator with a START button that triggers once without a press."""

    def __init__(self) -> None:
        super().__init__(starts=False)
        self._received = 0

    def receive(self, hal_state: int) -> None:
        self._received += 1
        if self._received == self.at:
            self.start()

    #: Cycle of the press, during the test of PENDANT-01.
    at = 300


BROKEN: dict[str, tuple[Break, str]] = {
    "no boot-up": (_sends("STATUS", _never_booting), "NODE-01"),
    "DBC hash of another network": (other_network, "NODE-02"),
    "heartbeat at half the rate": (_sends("STATUS", _every_other), "NODE-03"),
    "misses a SYNC": (_sends("STATE", _one_missing), "NODE-04"),
    "emergency at rest": (raises_an_emergency, "NODE-05"),
    "sends without SYNC": (sends_without_sync, "NODE-06"),
    "checks no CRC of SYNC": (_receives("SYNC", wire.no_crc), "NODE-07"),
    "answers a repeated SYNC": (_receives("SYNC", wire.no_repetition), "NODE-08"),
    "answers any length of SYNC": (_receives("SYNC", wire.no_length), "NODE-09"),
    "receive queue overflows": (overflows_its_queue, "NODE-10"),
    "counter slips": (_sends("STATE", _counter_slips), "NODE-11"),
    "wrong Data ID sometimes": (_sends("STATE", _other_data_id), "NODE-12"),
    "no bit rate switch": (_sends("STATUS", _no_bit_rate_switch), "NODE-13"),
    "29-bit copy of a frame": (_sends_unexpected(ID_EXTENDED), "NODE-13"),
    "remote frame": (_sends_unexpected(ID_REMOTE), "NODE-13"),
    "sends an invalid code": (_measures(_no_temperature_once), "NODE-14"),
    "sets reserved bits": (_sends("STATE", _reserved_bits), "NODE-15"),
    "stops later": (_sends("STATUS", _stopped_later), "NODE-16"),
    "quaternion not of unit length": (_measures(_shrunk_quaternion), "IMU-01"),
    "wrong accelerometer scale": (_measures(_scaled_accel), "IMU-02"),
    "accelerometer axes swapped": (_measures(_swapped_accel), "IMU-03"),
    "gyro bias": (_measures(_biased_gyro), "IMU-04"),
    "gyro axis stuck": (_set("GyroX", 0.01), "IMU-05"),
    "IMU error": (_set("ImuState", 1.0), "IMU-06"),
    "tare lost": (_measures(_tare_lost, "FOOT_LEFT"), "FOOT-01"),
    "load cell stuck": (_set("FR_ForceX", 0.0, "FOOT_RIGHT"), "FOOT-02"),
    "foot error": (_set("FootState", 1.0, "FOOT_LEFT"), "FOOT-03"),
    "vibrates without a command": (_with_motors(_vibrate_at_rest), "HAPTICS-01"),
    "level rises slowly": (_with_motors(_ramp), "HAPTICS-02"),
    "never full amplitude": (_with_motors(_weak), "HAPTICS-03"),
    "two motors swapped": (
        _receives("COMMAND", _levels(lambda codes: [codes[1], codes[0], *codes[2:]]), "HAPTICS"),
        "HAPTICS-04",
    ),
    "level above full wraps around": (
        _receives("COMMAND", _levels(lambda codes: [c - 201 if 200 < c < 255 else c for c in codes]), "HAPTICS"),
        "HAPTICS-05",
    ),
    "accepts the invalid level": (
        _receives("COMMAND", _levels(lambda codes: [200 if c == 255 else c for c in codes]), "HAPTICS"),
        "HAPTICS-06",
    ),
    "keeps the level without commands": (_with_motors(_never_stop), "HAPTICS-07"),
    "stops late without commands": (_with_motors(_stop_late), "HAPTICS-07"),
    "checks no CRC": (_receives("COMMAND", wire.no_crc, "HAPTICS"), "HAPTICS-08"),
    "checks no Data ID": (_receives("COMMAND", wire.no_data_id, "HAPTICS"), "HAPTICS-09"),
    "accepts repeated levels": (_receives("COMMAND", wire.no_repetition, "HAPTICS"), "HAPTICS-10"),
    "accepts any length": (_receives("COMMAND", wire.no_length, "HAPTICS"), "HAPTICS-11"),
    "request without a press": (_pendant(SpuriousPress), "PENDANT-01"),
    "dead-man stuck": (_set("DeadMan", 1.0, "PENDANT"), "PENDANT-02"),
    "START bounces": (_pendant(lambda: Bouncing(starts=False)), "PENDANT-03"),
    "STOP button disconnected": (_pendant(lambda: Unplugged(starts=False)), "PENDANT-04"),
    "HOLD button sends STOP": (_pendant(lambda: Swapped(starts=False)), "PENDANT-05"),
    "assistance dial without effect": (_set("AssistanceSet", 0.0, "PENDANT"), "PENDANT-06"),
}

#: Requirements at rest. Their tests take long, so they are skipped for nodes with another defect.
_REST = ("NODE-03", "NODE-04", "NODE-07", "NODE-08", "NODE-09", "NODE-10")


@pytest.mark.sample(12)
@pytest.mark.parametrize("name", BROKEN)
def test_defective_node_fails_only_its_requirement(name: str, make_setup: MakeSetup, monkeypatch: Patch):
    broken, expected = BROKEN[name]
    setup = broken(make_setup, monkeypatch)
    without = () if expected.startswith("NODE") else _REST
    assert not_passed(setup.examine(without)) == {expected: Verdict.FAILED}


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("vector", "axes", "wrong"), [("Quaternion", "WXYZ", "IMU-01"), ("Accel", "XYZ", "IMU-02")])
def test_attitude_of_a_zero_vector_does_not_pass(
    vector: str, axes: str, wrong: str, make_setup: MakeSetup, monkeypatch: Patch
):
    def clear(at: Callable[[str], int], _cycle: int, values: np.ndarray) -> None:
        for axis in axes:
            values[at(f"{vector}{axis}")] = 0.0

    setup = _measures(clear)(make_setup, monkeypatch)
    chosen = [r for r in requirements_of(setup.tester) if r.id in (wrong, "IMU-03")]
    results = {r.requirement.id: r for r in examine(setup.tester, chosen)}
    assert (results[wrong].verdict, results["IMU-03"].verdict) == (Verdict.FAILED, Verdict.NOT_TESTED)
    assert "must not be 0" in results["IMU-03"].measured


@pytest.mark.parametrize(
    ("requirement", "change", "expected"),
    [
        ("NODE-12", {"data": 1}, r"_STATE in cycle 1 \(0x[0-9a-f]{4}, expected 0x[0-9a-f]{4}\), "),
        ("NODE-13", {"len": 24}, r"_STATE in cycle 1 \(24 bytes, expected 32\), "),
        ("NODE-13", {"len": 8, "flags": 0}, r"_STATE in cycle 1 \(8 bytes, expected 32; classic CAN\), "),
        ("NODE-13", {"flags": FLAG_FDF}, r"_STATE in cycle 1 \(CAN FD without bit rate switch\), "),
        ("NODE-11", {"len": 2}, r"_STATE without counter in cycle 1, expected 1, "),
        ("NODE-12", {"len": 1}, r"_STATE in cycle 1 \(no CRC\), "),
    ],
)
def test_wrong_frame_is_named_with_its_values(
    requirement: str, change: dict[str, int], expected: str, make_setup: MakeSetup, monkeypatch: Patch
):
    def wrong(frame: Frames, _message: Message, _number: int) -> Frames:
        for field, value in change.items():
            if field == "data":
                frame["data"][0, 0] ^= value
            else:
                frame[field] = value
        return frame

    setup = _sends("STATE", wrong)(make_setup, monkeypatch)
    setup.tester.idle(5)
    (result,) = examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == requirement])
    assert result.verdict is Verdict.FAILED
    assert re.search(expected, result.measured), result.measured


def test_value_out_of_range_is_named_with_the_range(make_setup: MakeSetup, monkeypatch: Patch):
    def wrong(frame: Frames, message: Message, _number: int) -> Frames:
        frame["data"][0, message.signal("ImuState").start // 8] = 3
        return wire.protect(frame, message)

    setup = _sends("STATE", wrong)(make_setup, monkeypatch)
    setup.tester.idle(5)
    (result,) = examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == "NODE-14"])
    assert result.verdict is Verdict.FAILED
    assert f"{IMU}_STATE.ImuState in cycle 1 (3, range 0 to 2), " in result.measured


def test_emergency_is_named_with_its_code(make_setup: MakeSetup, monkeypatch: Patch):
    setup = raises_an_emergency(make_setup, monkeypatch)
    (result,) = examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == "NODE-05"])
    assert result.measured == "1 emergencies: 0x5000"


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_motor_without_lag_passes(make_setup: MakeSetup):
    setup = make_setup("HAPTICS", parameters=EmulatorParameters(haptics=HapticsParameters(rise_time=0.0005)))
    (result,) = examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == "HAPTICS-02"])
    assert result.verdict is Verdict.PASSED
    assert result.measured == "time constant 0 ms, largest deviation from a first-order lag 0.000"


def test_every_requirement_has_a_defective_node(make_setup: MakeSetup):
    ids = {r.id for node in KINDS for r in requirements_of(make_setup(node).tester)}
    assert {expected for _, expected in BROKEN.values()} == ids


@pytest.mark.parametrize(
    ("flag", "kind"),
    [(ID_EXTENDED, "29-bit frame"), (ID_REMOTE, "remote frame"), (ID_EXTENDED | ID_REMOTE, "29-bit remote frame")],
)
def test_unexpected_frame_is_named(flag: int, kind: str, make_setup: MakeSetup):
    setup = make_setup(IMU)
    can_id = setup.message("STATUS").frame_id
    extra = new_frames(1)
    setup.wire.from_node = lambda _: wire.NO_FRAME
    setup.wire.unsolicited = lambda: extra
    for number in (
        can_id | flag,
        can_id | flag | ID_ERROR,
        0x7FE | flag,
    ):  # an error frame, and the frame of another node
        extra["can_id"] = number
        setup.tester.silent_cycle()
    (result,) = examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == "NODE-13"])
    assert result.verdict is Verdict.FAILED
    assert f"1 of 1 frames: {kind} with the identifier of {IMU}_STATUS in cycle 1" in result.measured


def test_imu_that_changes_the_sign_of_its_quaternion_passes(make_setup: MakeSetup, monkeypatch: Patch):
    """A quaternion and its negative are the same attitude."""

    def change(at: Callable[[str], int], cycle: int, values: np.ndarray) -> None:
        values[[at(f"Quaternion{axis}") for axis in "WXYZ"]] *= (-1.0) ** cycle

    assert not_passed(_measures(change)(make_setup, monkeypatch).examine(_REST)) == {}


@pytest.mark.parametrize(("gyro", "verdict"), [(1.0, Verdict.PASSED), (1.1, Verdict.FAILED)])
def test_rate_of_a_turning_imu_is_compared_although_frames_are_lost(
    gyro: float, verdict: Verdict, make_setup: MakeSetup, monkeypatch: Patch
):
    def turn(at: Callable[[str], int], cycle: int, values: np.ndarray) -> None:
        half = 0.5 * 1e-3 * cycle  # 1 rad/s about y
        sign = (-1.0) ** cycle
        values[[at(f"Quaternion{axis}") for axis in "WXYZ"]] = sign * math.cos(half), 0.0, sign * math.sin(half), 0.0
        values[[at(f"Gyro{axis}") for axis in "XYZ"]] = 0.0, gyro, 0.0

    setup = _measures(turn)(make_setup, monkeypatch)
    state, count = setup.message("STATE").frame_id, itertools.count()
    setup.wire.from_node = lambda frame: (
        wire.NO_FRAME if int(frame["can_id"][0]) == state and next(count) % 3 else frame
    )
    (result,) = examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == "IMU-04"])
    assert result.verdict is verdict, result.measured


# -- bounds: the requirement passes at half of its bound and fails at twice its bound ------------------------------------


def _late_heartbeats(delay: Callable[[int], int]) -> Break:
    """Return a node whose n-th heartbeat is `delay(n)` cycles late."""

    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        del monkeypatch
        setup = make_setup(IMU)
        status, state = setup.message("STATUS").frame_id, setup.message("STATE").frame_id
        cycle, number, waiting = 0, 0, deque[tuple[int, Frames]]()

        def from_node(frame: Frames) -> Frames:
            nonlocal cycle, number
            can_id = int(frame["can_id"][0])
            if can_id == status:
                number += 1
                waiting.append((cycle + delay(number), frame.copy()))
                return wire.NO_FRAME
            if can_id != state:
                return frame
            cycle += 1
            return joined([frame, *([waiting.popleft()[1]] if waiting and waiting[0][0] <= cycle else [])])

        setup.wire.from_node = from_node
        return setup

    return broken


def _scaled(vector: str, axes: str, factor: float) -> Break:
    def change(at: Callable[[str], int], _: int, values: np.ndarray) -> None:
        for axis in axes:
            values[at(f"{vector}{axis}")] *= factor

    return _measures(change)


def _tilted(angle: float) -> Break:
    """Return an IMU with the acceleration turned about its y axis."""
    c, s = math.cos(angle), math.sin(angle)

    def change(at: Callable[[str], int], _: int, values: np.ndarray) -> None:
        x, z = at("AccelX"), at("AccelZ")
        values[[x, z]] = c * values[x] + s * values[z], c * values[z] - s * values[x]

    return _measures(change)


def _offset(signal: str, value: float, node: str = IMU) -> Break:
    def change(at: Callable[[str], int], _: int, values: np.ndarray) -> None:
        values[at(signal)] += value

    return _measures(change, node)


def _slow_motors(rise_time: float) -> Break:
    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        del monkeypatch
        return make_setup("HAPTICS", parameters=EmulatorParameters(haptics=HapticsParameters(rise_time)))

    return broken


#: (requirement, bounded quantity) -> function that returns a node whose defect is the given multiple of the bound.
BOUNDS: dict[tuple[str, str], Callable[[float], Break]] = {
    ("NODE-03", "mean period"): lambda share: _late_heartbeats(lambda number: round(10 * share) * number),
    ("NODE-03", "single period"): lambda share: _late_heartbeats(lambda number: round(50 * share) * (number == 3)),
    ("IMU-01", "norm"): lambda share: _scaled("Quaternion", "WXYZ", 1.0 - 1e-3 * share),
    ("IMU-02", "specific force"): lambda share: _scaled("Accel", "XYZ", 1.0 + 0.3 / 9.81 * share),
    ("IMU-03", "tilt"): lambda share: _tilted(math.radians(3.0) * share),
    ("IMU-04", "rate"): lambda share: _offset("GyroY", 0.05 * share),
    ("FOOT-01", "force"): lambda share: _offset("RL_ForceZ", 10.0 * share, "FOOT_LEFT"),
    ("HAPTICS-02", "time constant"): lambda share: _slow_motors(0.06 * share),
}


@pytest.mark.parametrize(("share", "verdict"), [(0.5, Verdict.PASSED), (2.0, Verdict.FAILED)])
@pytest.mark.parametrize(("requirement", "quantity"), BOUNDS)
def test_a_requirement_passes_at_half_and_fails_at_twice_its_bound(
    requirement: str, quantity: str, share: float, verdict: Verdict, make_setup: MakeSetup, monkeypatch: Patch
):
    tester = BOUNDS[requirement, quantity](share)(make_setup, monkeypatch).tester
    (result,) = examine(tester, [r for r in requirements_of(tester) if r.id == requirement])
    assert result.verdict is verdict, result.measured
