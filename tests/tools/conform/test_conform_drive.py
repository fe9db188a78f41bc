"""Tests of the drive requirements: an emulated drive passes, and each defect fails exactly its own requirement."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
import pytest

from atalante_dbc import Message
from atalante_emulator import drive as emulated
from atalante_emulator.drive import DriveParameters, Drives
from atalante_emulator.emulator import Emulator, EmulatorParameters
from atalante_hal.robot import Robot
from atalante_hal.wire.cia402 import Controlword, DriveState, next_state
from atalante_hal.wire.frame import Frames
from atalante_tools.conform.axis import LEGAL, ROUTES
from atalante_tools.conform.examination import requirements_of
from atalante_tools.conform.node_tester import Limits
from atalante_tools.conform.requirement import Verdict, examine
from atalante_tools.conform.technician import Action

from . import wire
from .conftest import MakeSetup, NodeSetup, not_passed, receive_as

S, C = DriveState, Controlword
Patch = pytest.MonkeyPatch

NODE = "LEFT_SK"
SK = 3  # index of its joint


@pytest.mark.sample(3)
@pytest.mark.parametrize("node", ["LEFT_FH", NODE, "RIGHT_HA"])
def test_emulated_drive_passes_every_requirement(node: str, make_setup: MakeSetup):
    results = make_setup(node).examine()
    assert not_passed(results) == {}
    assert len(results) == 41


def test_expected_transitions_cover_the_standard():
    assert {number for number, _ in LEGAL.values()} == {2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 16}
    assert {goal for _, goal in LEGAL.values()} == set(ROUTES)


# -- defects of the CiA 402 state machine -----------------------------------------------------------------------------


def starts_ready(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    class Eager(Drives):
        def _states_changed(self) -> None:
            if not hasattr(self, "_begun"):
                self._begun = True
                self.state = [S.READY_TO_SWITCH_ON] * 12
            super()._states_changed()

    monkeypatch.setattr("atalante_emulator.emulator.Drives", Eager)
    return make_setup(NODE)


def _with_rule(rule: Callable[[DriveState, int, bool], DriveState]) -> Callable[[MakeSetup, Patch], NodeSetup]:
    """Return a function that creates a drive whose state machine is replaced by `rule`."""

    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        monkeypatch.setattr(emulated, "next_state", lambda state, word, *, latched: rule(state, word, latched))
        return make_setup(NODE)

    return broken


def _misses_transition_8(state: DriveState, word: int, latched: bool) -> DriveState:
    if (state, word) == (S.OPERATION_ENABLED, C.SHUTDOWN):
        return state
    return next_state(state, word, latched=latched)


def _skips_ready_to_switch_on(state: DriveState, word: int, latched: bool) -> DriveState:
    if (state, word) == (S.SWITCH_ON_DISABLED, C.SWITCH_ON):
        return S.SWITCHED_ON
    return next_state(state, word, latched=latched)


def _enables_a_latched_hold(state: DriveState, word: int, latched: bool) -> DriveState:
    return next_state(state, word, latched=False)


def _switches_a_fault_off(state: DriveState, word: int, latched: bool) -> DriveState:
    if (state, word) == (S.FAULT, C.DISABLE_VOLTAGE):
        return S.SWITCH_ON_DISABLED
    return next_state(state, word, latched=latched)


def stops_late(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    waited = 0

    def rule(state: DriveState, word: int, latched: bool) -> DriveState:
        nonlocal waited
        if (state, word) == (S.OPERATION_ENABLED, C.QUICK_STOP):
            waited += 1
            if waited % 8:
                return state
        return next_state(state, word, latched=latched)

    return _with_rule(rule)(make_setup, monkeypatch)


# -- torque ------------------------------------------------------------------------------------------------------------


def holds_with_the_wrong_sign(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    del monkeypatch
    robot = make_setup(NODE).tester.robot
    return make_setup("RIGHT_HA", their_robot=_replace(robot, hold_kp=-1.5 * robot.hold_kp))


def makes_torque_when_switched_on(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    class Live(Drives):
        def _states_changed(self) -> None:
            super()._states_changed()
            self._is_enabled = self._is_enabled | (self.signals.state == S.SWITCHED_ON)

    monkeypatch.setattr("atalante_emulator.emulator.Drives", Live)
    return make_setup(NODE)


def _replace(robot: Robot, **arrays: np.ndarray) -> Robot:
    return dataclasses.replace(robot, **arrays)


def _on_command(change: wire.Reading) -> Callable[[MakeSetup, Patch], NodeSetup]:
    """Return a drive that receives its command changed by `change`."""

    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        del monkeypatch
        setup = make_setup(NODE)
        other = setup.tester.network.message("COMMAND_RIGHT_LEG").data_id
        return receive_as(setup, setup.tester.command.message, other, change)

    return broken


def _reads(signal: str, read: Callable[[int], int]) -> wire.Reading:
    """Return a change of the raw code of a knee signal."""

    def change(frame: Frames, message: Message, _: dict) -> Frames | None:
        if not wire.is_good(frame, message):
            return None
        code = wire.raw(frame, message, f"SK_{signal}")
        wire.put(frame, message, f"SK_{signal}", read(code))
        return wire.protect(frame, message)

    return change


def _negated(code: int) -> int:
    return code if code == 0x8000 else -code & 0xFFFF


def _overflowing(code: int) -> int:
    """Invert the sign of a torque above 200 Nm."""
    signed = code - 0x10000 if code & 0x8000 else code
    return _negated(code) if abs(signed) > 16_000 else code


# -- E2E ---------------------------------------------------------------------------------------------------------------


def _no_sequence(frame: Frames, message: Message, memory: dict) -> Frames | None:
    if not wire.is_good(frame, message):
        return None
    counter = int(frame["data"][0][2])
    if (counter - memory.get("reported", counter)) & 0xFF == 100:  # the jump of DRIVE-20
        counter = memory["reported"] + 1 & 0xFF
    memory["reported"] = counter
    return wire.protect(frame, message, counter=counter)


# -- watchdogs and emergencies -----------------------------------------------------------------------------------------


def _with_watchdog(cycles: int) -> Callable[[MakeSetup, Patch], NodeSetup]:
    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        monkeypatch.setattr(emulated, "WATCHDOG", cycles)
        return make_setup(NODE)

    return broken


def follows_late_commands(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    monkeypatch.setattr(Emulator, "_check_delays", lambda self: None)
    monkeypatch.setattr(Emulator, "_commands_in_step", lambda self: True)
    return make_setup(NODE)


def _without_emergency(code: int) -> Callable[[MakeSetup, Patch], NodeSetup]:
    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        del monkeypatch
        setup = make_setup(NODE)
        message, suppressed = setup.message("EMCY"), 0

        def from_node(frame: Frames) -> Frames:
            nonlocal suppressed
            if int(frame["can_id"][0]) != message.frame_id:
                return frame
            if wire.raw(frame, message, "ErrorCode") == code:
                suppressed += 1
                return wire.NO_FRAME
            return wire.protect(frame, message, counter=int(frame["data"][0][2]) - suppressed)

        setup.wire.from_node = from_node
        return setup

    return broken


def ignores_the_loss_of_sync(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    setup = make_setup(NODE)
    monkeypatch.setattr(setup.emulator, "idle", lambda: None)
    return setup


def never_trips(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
    del monkeypatch
    return make_setup(NODE, parameters=EmulatorParameters(drive=DriveParameters(trip_temperature=1000.0)))


def _measures(signal: str, factor: float) -> Callable[[MakeSetup, Patch], NodeSetup]:
    """Return a drive that multiplies a measured signal by `factor` before it encodes the signal."""

    def broken(make_setup: MakeSetup, monkeypatch: Patch) -> NodeSetup:
        del monkeypatch
        setup = make_setup(NODE)
        index = setup.emulator.signals.index(setup.message("STATE").name, signal)

        def scale(_cycle: int, values: np.ndarray) -> None:
            values[index] *= factor

        setup.emulator.before_send.append(scale)
        return setup

    return broken


F, N = Verdict.FAILED, Verdict.NOT_TESTED

BROKEN: dict[str, tuple[Callable[[MakeSetup, Patch], NodeSetup], dict[str, Verdict]]] = {
    "starts READY TO SWITCH ON": (starts_ready, {"DRIVE-01": F}),
    "misses transition 8": (_with_rule(_misses_transition_8), {"DRIVE-02": F}),
    "switches on from SWITCH ON DISABLED": (_with_rule(_skips_ready_to_switch_on), {"DRIVE-03": F}),
    "needs 8 cycles to stop": (stops_late, {"DRIVE-04": F}),
    "holds with the wrong sign": (holds_with_the_wrong_sign, {"DRIVE-05": F}),
    "makes torque when SWITCHED ON": (makes_torque_when_switched_on, {"DRIVE-06": F}),
    "makes torque with the wrong sign": (_on_command(_reads("TargetTorque", _negated)), {"DRIVE-07": F, "DRIVE-08": F}),
    "doubles MaxTorque": (
        _on_command(_reads("MaxTorque", lambda code: code if code == 0xFFFF else min(2 * code, 0xFFFE))),
        {"DRIVE-08": F},
    ),
    "inverts a torque above 200 Nm": (_on_command(_reads("TargetTorque", _overflowing)), {"DRIVE-08": F}),
    "reads MaxTorque as signed": (
        _on_command(_reads("MaxTorque", lambda code: 0 if 0x7FFF < code < 0xFFFF else code)),
        {"DRIVE-09": F},
    ),
    "masks the controlword": (
        _on_command(_reads("Controlword", lambda code: code & 0x7F if 0x80 < code < 0xFF else code)),
        {"DRIVE-10": F},
    ),
    "accepts the invalid torque": (
        _on_command(_reads("TargetTorque", lambda code: 0x8001 if code == 0x8000 else code)),
        {"DRIVE-11": F},
    ),
    "latches after 4 lost commands": (_with_watchdog(4), {"DRIVE-12": F}),
    "latches after 6 lost commands": (_with_watchdog(6), {"DRIVE-13": F}),
    "enables a latched hold": (_with_rule(_enables_a_latched_hold), {"DRIVE-14": F}),
    "does not report the latch": (_without_emergency(0x8250), {"DRIVE-15": F}),
    "ignores the loss of SYNC": (ignores_the_loss_of_sync, {"DRIVE-16": F}),
    "checks no CRC": (_on_command(wire.no_crc), {"DRIVE-17": F}),
    "checks no Data ID": (_on_command(wire.no_data_id), {"DRIVE-18": F}),
    "accepts repeated commands": (_on_command(wire.no_repetition), {"DRIVE-19": F}),
    "accepts commands out of sequence": (_on_command(_no_sequence), {"DRIVE-20": F}),
    "accepts any length": (_on_command(wire.no_length), {"DRIVE-21": F}),
    "does not report the trip": (_without_emergency(0x4310), {"DRIVE-22": F}),
    "never trips": (never_trips, {"DRIVE-22": F, "DRIVE-23": N}),
    "follows late commands": (follows_late_commands, {"DRIVE-24": F}),
    "switches a fault off without reset": (_with_rule(_switches_a_fault_off), {"DRIVE-23": F}),
    "negates the velocity": (_measures("Velocity", -1.0), {"DRIVE-25": F}),
    "negates the position": (_measures("Position", -1.0), {"DRIVE-25": F}),
    "measures the position at the joint": (_measures("Position", 0.01), {"DRIVE-25": F}),
    "measures no velocity": (_measures("Velocity", 0.0), {"DRIVE-25": F}),
}


@pytest.mark.sample(12)
@pytest.mark.parametrize("name", BROKEN)
def test_defective_drive_fails_only_its_requirement(name: str, make_setup: MakeSetup, monkeypatch: Patch):
    broken, expected = BROKEN[name]
    # The requirements at rest take long, and other tests cover them.
    setup = broken(make_setup, monkeypatch)
    assert (
        not_passed(setup.examine(without=("NODE-03", "NODE-04", "NODE-07", "NODE-08", "NODE-09", "NODE-10")))
        == expected
    )


def test_every_drive_requirement_has_a_defective_drive(make_setup: MakeSetup):
    ids = {r.id for r in requirements_of(make_setup(NODE).tester) if r.id.startswith("DRIVE-")}
    assert {id for _, expected in BROKEN.values() for id, verdict in expected.items() if verdict is F} == ids


@pytest.mark.parametrize("missing", [(2, S.SWITCH_ON_DISABLED, C.SHUTDOWN), (4, S.SWITCHED_ON, C.ENABLE_OPERATION)])
def test_missing_transition_on_a_route_fails(
    missing: tuple[int, DriveState, Controlword], make_setup: MakeSetup, monkeypatch: Patch
):
    number, state, controlword = missing

    def rule(present: DriveState, word: int, latched: bool) -> DriveState:
        return present if (present, word) == (state, controlword) else next_state(present, word, latched=latched)

    tester = _with_rule(rule)(make_setup, monkeypatch).tester
    (result,) = examine(tester, [r for r in requirements_of(tester) if r.id == "DRIVE-02"])
    assert result.verdict is Verdict.FAILED
    assert f"{number} ({state.name}, {controlword.name}): {state.name}" in result.measured
    assert result.measured.count("OPERATION_ENABLED not reached") == 1


@pytest.mark.parametrize(("cycles", "verdict"), [(8, Verdict.PASSED), (12, Verdict.FAILED)])
def test_transition_passes_within_ten_cycles_and_fails_above(
    cycles: int, verdict: Verdict, make_setup: MakeSetup, monkeypatch: Patch
):
    received = 0

    def rule(state: DriveState, word: int, latched: bool) -> DriveState:
        nonlocal received
        # No route to another tested state uses transition 8, so its delay does not affect the tests of other transitions.
        if (state, word) == (S.OPERATION_ENABLED, C.SHUTDOWN):
            received += 1
            if received % cycles:
                return state
        return next_state(state, word, latched=latched)

    tester = _with_rule(rule)(make_setup, monkeypatch).tester
    (result,) = examine(tester, [r for r in requirements_of(tester) if r.id == "DRIVE-02"])
    assert result.verdict is verdict, result.measured


@pytest.mark.parametrize(("delay", "verdict"), [(100, Verdict.FAILED), (None, Verdict.NOT_TESTED)])
def test_fault_is_examined_only_after_the_drive_has_cooled(
    delay: int | None, verdict: Verdict, make_setup: MakeSetup, monkeypatch: Patch
):
    """A hot drive stays in FAULT. This drive leaves FAULT without a reset as soon as it is cool."""
    setup = _with_rule(_switches_a_fault_off)(make_setup, monkeypatch)
    tester = setup.tester
    carry_out, cycles = tester.technician.request, itertools.count()

    def carry_out_late(action: Action, node: str) -> None:
        if action is not Action.COOL:
            carry_out(action, node)
            return
        setup.emulator.before_send.append(lambda *_: carry_out(action, node) if next(cycles) == delay else None)

    monkeypatch.setattr(tester.technician, "request", carry_out_late)
    results = examine(tester, [r for r in requirements_of(tester) if r.id in ("DRIVE-22", "DRIVE-23")])
    assert [result.verdict for result in results] == [Verdict.PASSED, verdict]


@pytest.mark.parametrize(
    ("torque", "verdict"), [(0.5, Verdict.NOT_TESTED), (0.6, Verdict.FAILED), (3.0, Verdict.FAILED)]
)
def test_obeyed_invalid_controlword_does_not_pass_at_a_low_torque(
    torque: float, verdict: Verdict, make_setup: MakeSetup
):
    quiet = EmulatorParameters(drive=DriveParameters(torque_noise=0.0))
    setup = make_setup(NODE, limits=Limits(torque), parameters=quiet)
    message = setup.tester.command.message
    obeys = _reads("Controlword", lambda code: C.ENABLE_OPERATION if code == 0xFF else code)
    receive_as(setup, message, message.data_id ^ 1, obeys)
    (result,) = examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == "DRIVE-11"])
    assert result.verdict is verdict, result.measured


@pytest.mark.parametrize(
    ("factor", "verdict"), [(0.9, Verdict.PASSED), (1.1, Verdict.PASSED), (0.7, Verdict.FAILED), (1.3, Verdict.FAILED)]
)
def test_velocity_must_be_the_change_of_the_position(
    factor: float, verdict: Verdict, make_setup: MakeSetup, monkeypatch: Patch
):
    setup = _measures("Velocity", factor)(make_setup, monkeypatch)
    chosen = [r for r in requirements_of(setup.tester) if r.id in ("DRIVE-07", "DRIVE-25")]
    assert [r.verdict for r in examine(setup.tester, chosen)] == [Verdict.PASSED, verdict]


def test_velocity_of_a_drive_that_does_not_move_is_not_tested(make_setup: MakeSetup, monkeypatch: Patch):
    setup = _measures("Velocity", 0.0)(make_setup, monkeypatch)
    index = setup.emulator.signals.index(setup.message("STATE").name, "Position")
    setup.emulator.before_send.append(lambda _, values: values.__setitem__(index, 0.25))
    (result,) = examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == "DRIVE-25"])
    assert result.verdict is Verdict.NOT_TESTED
    assert "the motor must move by 0.01 rad" in result.measured
