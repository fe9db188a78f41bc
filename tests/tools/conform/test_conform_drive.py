"""A drive passes the examination, and each way of being broken is named by its own requirement and no other."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from atalante_dbc import Message
from atalante_emulator import drive as emulated
from atalante_emulator.drive import DriveParameters, Drives
from atalante_emulator.emulator import EmulatorParameters
from atalante_hal.robot import Robot
from atalante_hal.wire.cia402 import Controlword, DriveState, next_state
from atalante_hal.wire.frame import Frames
from atalante_tools.conform.axis import LEGAL, ROUTES
from atalante_tools.conform.requirement import Verdict

from .conftest import (
    NO_FRAME,
    Desk,
    MakeDesk,
    Reading,
    hear_as,
    is_good,
    no_crc,
    no_data_id,
    no_length,
    no_repetition,
    not_passed,
    protect,
    put,
    raw,
)

S, C = DriveState, Controlword
Patch = pytest.MonkeyPatch

NODE = "LEFT_SK"
SK = 3  # its joint


@pytest.mark.parametrize("node", ["LEFT_FH", NODE, "RIGHT_HA"])
def test_an_emulated_drive_passes(node: str, make_desk: MakeDesk):
    results = make_desk(node).examine()
    assert not_passed(results) == {}
    assert len(results) == 38


def test_the_expected_transitions_cover_every_state_and_command_once():
    assert {number for number, _ in LEGAL.values()} == {2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 16}
    assert {goal for _, goal in LEGAL.values()} == set(ROUTES)


# -- what the firmware does with CiA 402 -------------------------------------------------------------------------------


def starts_ready(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
    class Eager(Drives):
        def _states_changed(self) -> None:
            if not hasattr(self, "_begun"):
                self._begun = True
                self.state = [S.READY_TO_SWITCH_ON] * 12
            super()._states_changed()

    monkeypatch.setattr("atalante_emulator.emulator.Drives", Eager)
    return make_desk(NODE)


def _with_rule(rule: Callable[[DriveState, int, bool], DriveState]) -> Callable[[MakeDesk, Patch], Desk]:
    """A drive with another state machine."""

    def broken(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
        monkeypatch.setattr(emulated, "next_state", lambda state, word, *, latched: rule(state, word, latched))
        return make_desk(NODE)

    return broken


def _misses_transition_8(state: DriveState, word: int, latched: bool) -> DriveState:
    if (state, word) == (S.OPERATION_ENABLED, C.SHUTDOWN):
        return state
    return next_state(state, word, latched=latched)


def _switches_on_at_once(state: DriveState, word: int, latched: bool) -> DriveState:
    if (state, word) == (S.SWITCH_ON_DISABLED, C.SWITCH_ON):
        return S.SWITCHED_ON
    return next_state(state, word, latched=latched)


def _enables_a_latched_hold(state: DriveState, word: int, latched: bool) -> DriveState:
    return next_state(state, word, latched=False)


def _switches_a_fault_off(state: DriveState, word: int, latched: bool) -> DriveState:
    if (state, word) == (S.FAULT, C.DISABLE_VOLTAGE):
        return S.SWITCH_ON_DISABLED
    return next_state(state, word, latched=latched)


def stops_late(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
    waited = 0

    def rule(state: DriveState, word: int, latched: bool) -> DriveState:
        nonlocal waited
        if (state, word) == (S.OPERATION_ENABLED, C.QUICK_STOP):
            waited += 1
            if waited % 20:
                return state
        return next_state(state, word, latched=latched)

    return _with_rule(rule)(make_desk, monkeypatch)


# -- torque ------------------------------------------------------------------------------------------------------------


def holds_with_the_wrong_sign(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
    del monkeypatch
    robot = make_desk(NODE).bench.robot
    return make_desk("RIGHT_HA", their_robot=_replace(robot, hold_kp=-1.5 * robot.hold_kp))


def makes_torque_when_switched_on(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
    class Live(Drives):
        def _states_changed(self) -> None:
            super()._states_changed()
            self._is_enabled = self._is_enabled | (self.signals.state == S.SWITCHED_ON)

    monkeypatch.setattr("atalante_emulator.emulator.Drives", Live)
    return make_desk(NODE)


def _replace(robot: Robot, **arrays: np.ndarray) -> Robot:
    return dataclasses.replace(robot, **arrays)


def _on_command(change: Reading) -> Callable[[MakeDesk, Patch], Desk]:
    """A drive that reads its command as if it were another."""

    def broken(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
        del monkeypatch
        desk = make_desk(NODE)
        other = desk.bench.network.message("COMMAND_RIGHT_LEG").data_id
        return hear_as(desk, desk.bench.command.message, other, change)

    return broken


def _reads(signal: str, read: Callable[[int], int]) -> Reading:
    """Take another code of a signal of the knee."""

    def change(frame: Frames, message: Message, _: dict) -> Frames | None:
        if not is_good(frame, message):
            return None
        code = raw(frame, message, f"SK_{signal}")
        put(frame, message, f"SK_{signal}", read(code))
        return protect(frame, message)

    return change


def _negated(code: int) -> int:
    return code if code == 0x8000 else -code & 0xFFFF


# -- E2E ---------------------------------------------------------------------------------------------------------------


def _no_sequence(frame: Frames, message: Message, memory: dict) -> Frames | None:
    if not is_good(frame, message):
        return None
    counter = int(frame["data"][0][2])
    said = counter + memory.get("shift", 0) & 0xFF
    if (said - memory.get("said", said - 1)) & 0xFF > 5:
        memory["shift"] = (memory["said"] + 1 - counter) & 0xFF
        said = memory["said"] + 1 & 0xFF
    memory["said"] = said
    return protect(frame, message, counter=said)


# -- watchdogs and emergencies -----------------------------------------------------------------------------------------


def _with_watchdog(cycles: int) -> Callable[[MakeDesk, Patch], Desk]:
    def broken(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
        monkeypatch.setattr(emulated, "WATCHDOG", cycles)
        return make_desk(NODE)

    return broken


def _without_emergency(code: int) -> Callable[[MakeDesk, Patch], Desk]:
    def broken(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
        del monkeypatch
        desk = make_desk(NODE)
        message, kept_back = desk.message("EMCY"), 0

        def from_node(frame: Frames) -> Frames:
            nonlocal kept_back
            if int(frame["can_id"][0]) != message.frame_id:
                return frame
            if raw(frame, message, "ErrorCode") == code:
                kept_back += 1
                return NO_FRAME
            return protect(frame, message, counter=int(frame["data"][0][2]) - kept_back)

        desk.wire.from_node = from_node
        return desk

    return broken


def ignores_the_loss_of_sync(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
    desk = make_desk(NODE)
    monkeypatch.setattr(desk.emulator, "idle", lambda: None)
    return desk


def never_trips(make_desk: MakeDesk, monkeypatch: Patch) -> Desk:
    del monkeypatch
    return make_desk(NODE, parameters=EmulatorParameters(drive=DriveParameters(trip_temperature=1000.0)))


F, N = Verdict.FAILED, Verdict.NOT_TESTED

BROKEN: dict[str, tuple[Callable[[MakeDesk, Patch], Desk], dict[str, Verdict]]] = {
    "starts READY TO SWITCH ON": (starts_ready, {"DRIVE-01": F}),
    "misses transition 8": (_with_rule(_misses_transition_8), {"DRIVE-02": F}),
    "switches on from SWITCH ON DISABLED": (_with_rule(_switches_on_at_once), {"DRIVE-03": F}),
    "needs 20 cycles to stop": (stops_late, {"DRIVE-04": F}),
    "holds with the wrong sign": (holds_with_the_wrong_sign, {"DRIVE-05": F}),
    "makes torque when SWITCHED ON": (makes_torque_when_switched_on, {"DRIVE-06": F}),
    "makes torque with the wrong sign": (_on_command(_reads("TargetTorque", _negated)), {"DRIVE-07": F}),
    "takes MaxTorque for twice as much": (
        _on_command(_reads("MaxTorque", lambda code: code if code == 0xFFFF else min(2 * code, 0xFFFE))),
        {"DRIVE-08": F},
    ),
    "takes MaxTorque for a signed number": (
        _on_command(_reads("MaxTorque", lambda code: 0 if 0x7FFF < code < 0xFFFF else code)),
        {"DRIVE-09": F},
    ),
    "masks the controlword": (
        _on_command(_reads("Controlword", lambda code: code & 0x7F if 0x80 < code < 0xFF else code)),
        {"DRIVE-10": F},
    ),
    "takes the invalid torque for a number": (
        _on_command(_reads("TargetTorque", lambda code: 0x8001 if code == 0x8000 else code)),
        {"DRIVE-11": F},
    ),
    "gives up after 4 commands": (_with_watchdog(4), {"DRIVE-12": F}),
    "waits for 6 commands": (_with_watchdog(6), {"DRIVE-13": F}),
    "enables a latched hold": (_with_rule(_enables_a_latched_hold), {"DRIVE-14": F}),
    "does not tell the latch": (_without_emergency(0x8250), {"DRIVE-15": F}),
    "ignores the loss of SYNC": (ignores_the_loss_of_sync, {"DRIVE-16": F}),
    "checks no CRC": (_on_command(no_crc), {"DRIVE-17": F}),
    "checks no Data ID": (_on_command(no_data_id), {"DRIVE-18": F}),
    "takes repeated commands": (_on_command(no_repetition), {"DRIVE-19": F}),
    "takes commands out of sequence": (_on_command(_no_sequence), {"DRIVE-20": F}),
    "takes any length": (_on_command(no_length), {"DRIVE-21": F}),
    "does not tell the trip": (_without_emergency(0x4310), {"DRIVE-22": F}),
    "never trips": (never_trips, {"DRIVE-22": F, "DRIVE-23": N}),
    "switches a fault off without reset": (_with_rule(_switches_a_fault_off), {"DRIVE-23": F}),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_drive_fails_for_its_own_reason(name: str, make_desk: MakeDesk, monkeypatch: Patch):
    broken, expected = BROKEN[name]
    # What a node owes at rest takes long and has tests of its own.
    desk = broken(make_desk, monkeypatch)
    assert (
        not_passed(desk.examine(without=("NODE-03", "NODE-04", "NODE-07", "NODE-08", "NODE-09", "NODE-10"))) == expected
    )


def test_every_requirement_of_a_drive_has_a_drive_that_breaks_it(make_desk: MakeDesk):
    from atalante_tools.conform.examination import requirements_of

    ids = {r.id for r in requirements_of(make_desk(NODE).bench) if r.id.startswith("DRIVE-")}
    assert {id for _, expected in BROKEN.values() for id, verdict in expected.items() if verdict is F} == ids
