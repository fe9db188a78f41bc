"""Refused starts: implausible drive torques, joints outside their range, and encoders that jumped."""

from __future__ import annotations

import re

import numpy as np
import pytest

from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.start import (
    AT_REST,
    REFUSED,
    Refusal,
    StartRequest,
    entry_text,
    implausible_torque,
    powered,
    refusal,
)
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState

ROBOT = load_robot()
IDLE = ROBOT.thresholds.idle_torque
S, D = SupervisorState, DriveState
joints = pytest.mark.parametrize("joint", range(12), ids=JOINTS)


@pytest.mark.parametrize("state", DriveState)
@joints
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_permitted_torque_depends_on_the_drive_state(state: DriveState, joint: int, sign: float):
    on = state in (D.OPERATION_ENABLED, D.QUICK_STOP_ACTIVE)
    states = np.full(12, float(D.SWITCH_ON_DISABLED))
    states[joint] = state
    assert powered(states).tolist() == [on and j == joint for j in range(12)]
    most = (ROBOT.torque_max[joint] if on else 0.0) + IDLE
    torque = np.zeros(12)
    torque[joint] = sign * most
    assert implausible_torque(ROBOT, states, torque) == ""
    torque[joint] = sign * np.nextafter(most, np.inf)
    why = implausible_torque(ROBOT, states, torque)
    limit = f"its limit of {ROBOT.torque_max[joint]:.0f} Nm" if on else "2 Nm, because it is not enabled"
    assert why == f"the drive of {JOINTS[joint]} reports {sign * most:.0f} Nm in {state.name}; must be within {limit}"


@pytest.mark.parametrize("torque", [np.nan, np.inf, -np.inf])
def test_torque_of_nan_or_infinity_is_implausible(torque: float):
    why = implausible_torque(ROBOT, np.full(12, float(D.OPERATION_ENABLED)), np.full(12, torque))
    assert "left_FH" in why


def test_torque_in_an_unknown_drive_state_is_implausible():
    why = implausible_torque(ROBOT, np.full(12, 99.0), np.full(12, 3.0))
    assert why == "the drive of left_FH reports 3 Nm in state 99; must be within 2 Nm, because it is not enabled"


OFF_TORQUE = np.full(12, 3.0)  # Nm, more than a disabled drive may report
ENABLING = StartRequest(
    supervisor=S.READY,
    pressed=False,
    cycles_left=100,
    stalled=0,
    ending=False,
    stop_requested=False,
    dead_man=True,
    diagnostic="",
    nodes_ready=True,
    missing=(),
    drive_state=np.full(12, float(D.SWITCH_ON_DISABLED)),
    torque=np.zeros(12),
    velocity=np.zeros(12),
)
PRESSED = ENABLING._replace(pressed=True, cycles_left=200)
ILL = {"diagnostic": "an encoder is stuck"}
UNWELL = {"nodes_ready": False, "missing": {"LEFT_SK", "IMU_TORSO"}}
ENABLED = np.full(12, float(D.OPERATION_ENABLED))
STOP, RELEASED = "the operator asked to stop", "the dead-man switch was released or the pendant is lost"
OFF = ", ".join(f"{joint} is in SWITCH_ON_DISABLED" for joint in JOINTS)
FAILED = f"the drives were not enabled within 200 cycles: {OFF}"
UNTESTED = "the direction test of the joints did not end within 200 cycles"
STALLED = "the drives were not enabled and no drive changed its state for 10 cycles: "
TORQUE = "the drive of left_FH reports 3 Nm in SWITCH_ON_DISABLED; must be within 2 Nm, because it is not enabled"


def test_entry_text_of_off_names_the_missing_nodes():
    assert (
        entry_text(S.OFF, {"LEFT_SK", "IMU_TORSO"}, stop_requested=False)
        == "no answer or not trusted yet: IMU_TORSO, LEFT_SK"
    )


@pytest.mark.parametrize(
    ("request_", "changes", "reason"),
    [
        # In the cycles after the press, while the drives are being enabled. The first matching reason has precedence.
        (ENABLING, {}, None),
        (ENABLING, {"ending": True, "stop_requested": True}, "the program is ending"),
        (ENABLING, {"stop_requested": True, "dead_man": False, **ILL}, STOP),
        (ENABLING, {"dead_man": False, **ILL}, RELEASED),
        (ENABLING, {**ILL, **UNWELL}, ILL["diagnostic"]),
        (ENABLING, {**UNWELL, "cycles_left": 0}, "no answer or not trusted yet: IMU_TORSO, LEFT_SK"),
        (ENABLING, {"cycles_left": 0, "torque": OFF_TORQUE}, FAILED),
        (ENABLING, {"cycles_left": 0, "drive_state": ENABLED}, UNTESTED),
        (ENABLING, {"stalled": 9}, None),
        (ENABLING, {"stalled": 10, "stop_requested": True}, STOP),
        (ENABLING, {"torque": OFF_TORQUE}, TORQUE),
        (ENABLING, {"supervisor": S.HOLD, "torque": OFF_TORQUE}, TORQUE),
        (ENABLING, {"supervisor": S.HOLD, **ILL}, ILL["diagnostic"]),
        (ENABLING, {"supervisor": S.FULL_ASSIST, "torque": OFF_TORQUE}, None),
        (ENABLING, {"supervisor": S.FULL_ASSIST, **ILL}, ILL["diagnostic"]),
        # In LOWER and FAULT, START acknowledges a fault that may take some cycles to clear.
        *(
            (ENABLING, {"supervisor": state, **changes}, reason)
            for state in (S.LOWER, S.FAULT)
            for changes, reason in (
                ({**ILL, **UNWELL, "torque": OFF_TORQUE}, None),
                ({"cycles_left": 0, **ILL}, FAILED),
                ({"stalled": 10}, None),
                ({"dead_man": False}, RELEASED),
                ({"stop_requested": True}, STOP),
                ({"ending": True}, "the program is ending"),
            )
        ),
        # In the cycle in which START is pressed.
        (PRESSED, {}, None),
        (PRESSED, {"torque": OFF_TORQUE}, TORQUE),
        (PRESSED, {"supervisor": S.HOLD, "torque": OFF_TORQUE, **ILL}, TORQUE),
        (PRESSED, {**ILL, **UNWELL}, None),
        (PRESSED, {"ending": True, "stop_requested": True}, "the program is ending"),
        (PRESSED, {"stop_requested": True, "dead_man": False, "torque": OFF_TORQUE}, STOP),
        (PRESSED, {"dead_man": False}, RELEASED),
        (PRESSED, {"supervisor": S.OFF, "dead_man": False, **ILL}, RELEASED),
        (PRESSED, {"supervisor": S.OFF, "cycles_left": 0, "torque": OFF_TORQUE, **UNWELL}, None),
        (PRESSED, {"supervisor": S.OFF, "cycles_left": 0, **ILL}, ILL["diagnostic"]),
        (PRESSED, {"supervisor": S.FINISH_STEP, "cycles_left": 0, "torque": OFF_TORQUE, **ILL}, None),
    ],
)
def test_first_matching_reason_refuses_the_start(request_: StartRequest, changes: dict, reason: str | None):
    ended = refusal(ROBOT, request_._replace(**changes))
    if reason is None:
        assert ended is None
    elif reason in (FAILED, UNTESTED):
        assert ended == ("START_FAILED", "error", reason)
    else:
        assert ended == ("START_REFUSED", "warning", REFUSED + reason)


@pytest.mark.parametrize("supervisor", [S.READY, S.HOLD])
@pytest.mark.parametrize(
    ("others", "knee", "named"),
    [
        (D.QUICK_STOP_ACTIVE, D.FAULT, "left_SK is in FAULT"),
        (D.SWITCHED_ON, D.READY_TO_SWITCH_ON, "left_SK is in READY_TO_SWITCH_ON"),
        (D.OPERATION_ENABLED, D.SWITCHED_ON, "left_SK is in SWITCHED_ON"),
        (D.OPERATION_ENABLED, 99, "left_SK is in state 99"),
        (D.OPERATION_ENABLED, D.QUICK_STOP_ACTIVE, "left_SK is in QUICK_STOP_ACTIVE"),
    ],
)
def test_failed_start_names_the_drives_that_were_not_enabled(supervisor: S, others: D, knee: float, named: str):
    drive_state = np.full(12, float(others))
    drive_state[JOINTS.index("left_SK")] = knee
    request = ENABLING._replace(supervisor=supervisor, drive_state=drive_state, stalled=10)
    assert refusal(ROBOT, request) == ("START_FAILED", "error", STALLED + named)


def test_failed_start_from_fault_with_enabled_drives_names_all():
    drive_state = np.full(12, float(D.OPERATION_ENABLED))
    ended = refusal(ROBOT, ENABLING._replace(supervisor=S.FAULT, drive_state=drive_state, cycles_left=0))
    assert ended is not None
    assert ended.text.count("is in OPERATION_ENABLED") == 12


class FalseSignal:
    """A falsified signal in the state message of a joint: `value` replaces the signal, or `more` is added to it."""

    def __init__(self, rig, joint: str, signal: str) -> None:
        self._at = rig.emulator.signals.index(f"{joint.upper()}_STATE", signal)
        self.value: float | None = None
        self.more = 0.0
        rig.emulator.before_send.append(self._rewrite)

    def _rewrite(self, cycle: int, values: np.ndarray) -> None:
        values[self._at] = values[self._at] + self.more if self.value is None else self.value


def refusals(rig) -> list[str]:
    return [event.text for event in rig.hal.events if event.code == "START_REFUSED"]


@joints
@pytest.mark.parametrize("torque", [-400.0, 3.0])
@pytest.mark.sample(5)
def test_torque_of_a_disabled_drive_refuses_the_start(make_rig, joint: int, torque: float):
    rig = make_rig(starts=False)
    signal = FalseSignal(rig, JOINTS[joint], "Torque")
    rig.until(S.READY)
    signal.value = torque
    rig.run(1)
    seen = set()
    rig.operator.start()
    for _ in range(30):
        rig.run(1)
        seen |= rig.controlwords()
    assert seen <= {Controlword.QUICK_STOP, Controlword.DISABLE_VOLTAGE}
    assert rig.hal.state.supervisor is S.READY
    assert refusals(rig) == [
        f"START refused: the drive of {JOINTS[joint]} reports {torque:.0f} Nm in SWITCH_ON_DISABLED; "
        "must be within 2 Nm, because it is not enabled"
    ]
    assert rig.hal.reason == refusals(rig)[0]
    signal.value = None
    rig.operator.start()
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE


@pytest.mark.parametrize(("torque", "follows"), [(-400.0, False), (60.0, True)])
def test_torque_of_a_holding_drive_is_the_first_command(make_rig, torque: float, follows: bool):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD)
    rig.run(20)
    FalseSignal(rig, "right_FH", "Torque").value = torque
    rig.run(2)
    rig.operator.start()
    first = None
    for _ in range(10):
        rig.hal.read()
        sent = rig.hal.hold().copy()
        enabled = Controlword.ENABLE_OPERATION in rig.controlwords()
        if enabled:
            first = sent[JOINTS.index("right_FH")]
            break
    assert (first == pytest.approx(60.0, abs=0.1)) if follows else first is None
    assert bool(refusals(rig)) is not follows


def test_torque_during_the_enabling_ends_the_start(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    rig.operator.start()
    signal = FalseSignal(rig, "left_SK", "Torque")
    while D.SWITCHED_ON not in rig.run(1).drive_state.tolist():
        pass
    signal.value = -400.0
    for _ in range(30):
        rig.run(1)
        targets = [v for c in rig.last_commands().values() for k, v in c.items() if k.endswith("TargetTorque")]
        assert np.abs(targets).max() < 5.0
        assert rig.hal.state.supervisor is S.READY
    assert "reports -400 Nm in SWITCHED_ON" in refusals(rig)[0]
    assert set(rig.controlwords()) == {Controlword.DISABLE_VOLTAGE}


def test_torque_of_a_disabled_drive_is_not_the_first_command(make_rig):
    rig = make_rig(starts=False)
    FalseSignal(rig, "left_SK", "Torque").value = 1.5
    rig.until(S.READY)
    rig.operator.start()
    for _ in range(150):
        state = rig.run(1)
        if state.drive_state[3] not in (D.OPERATION_ENABLED, D.QUICK_STOP_ACTIVE):
            assert rig.last_commands()["left"]["SK_TargetTorque"] == pytest.approx(0.0, abs=0.02)
        if rig.hal.moving:  # from now on, the false torque contradicts the command (TORQUE_TRACKING)
            break
    assert rig.hal.moving


class TestRange:
    GONE = 1.0  # rad

    def outside(self, rig) -> FalseSignal:
        signal = FalseSignal(rig, "left_SA", "Position")
        signal.more = self.GONE * ROBOT.gear[4] * ROBOT.polarity[4]
        return signal

    def test_joint_outside_its_range_prevents_ready(self, make_rig):
        rig = make_rig(starts=False)
        signal = self.outside(rig)
        assert rig.run(500).supervisor is S.OFF
        reported = re.match(
            r"left_SA is at ([\d.]+) degrees, outside its range of -16.0 to 9.0 degrees", rig.hal.reason
        )
        assert reported, rig.hal.reason
        # The leg sinks a little while the drives are off, and the reason follows the measured angle.
        assert float(reported[1]) == pytest.approx(np.degrees(self.GONE), abs=2.0)
        rig.operator.start()
        assert rig.run(10).supervisor is S.OFF
        assert refusals(rig) == ["START refused: " + rig.hal.reason]
        for more in np.linspace(signal.more, 0.0, 2500):  # slow enough to pass the velocity check
            signal.more = more
            rig.run(1)
        assert rig.until(S.READY, 50).supervisor is S.READY

    def test_position_within_the_tolerance_permits_the_start(self, make_rig):
        rig = make_rig(starts=False)
        low = ROBOT.position_min[4] - 0.9 * ROBOT.thresholds.position_tolerance
        FalseSignal(rig, "left_SA", "Position").more = low * ROBOT.gear[4] * ROBOT.polarity[4]
        rig.until(S.READY)
        rig.operator.start()
        assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE

    def test_joint_outside_its_range_refuses_the_start_in_hold(self, make_rig):
        rig = make_rig()
        rig.until(S.ACTIVE)
        rig.operator.hold()
        rig.until(S.HOLD)
        rig.run(10)
        signal = FalseSignal(rig, "left_SA", "Position")
        for cycle in range(800):  # slow enough to pass the velocity check
            signal.more = 0.0004 * cycle * ROBOT.gear[4] * ROBOT.polarity[4]
            rig.run(1)
        for _ in range(2):
            before = len(refusals(rig))
            rig.operator.start()
            for _ in range(30):
                assert rig.run(1).supervisor is S.HOLD
                assert rig.controlwords() == {Controlword.QUICK_STOP}
            assert len(refusals(rig)) == before + 1
            assert "left_SA is at" in refusals(rig)[-1]


class TestJump:
    """An encoder jumped and keeps its offset."""

    def jumped(self, make_rig):
        rig = make_rig()
        rig.until(S.ACTIVE)
        signal = FalseSignal(rig, "right_SA", "Position")
        signal.more = 0.1 * ROBOT.gear[10] * ROBOT.polarity[10]
        assert rig.run(5).supervisor is S.HOLD
        rig.run(400)  # at its highest velocity, the joint moves by more than 1 rad in this time
        return rig, signal

    def test_start_after_an_encoder_jump_is_refused_with_the_reason(self, make_rig):
        rig, _ = self.jumped(make_rig)
        for count in (1, 2):
            rig.operator.start()
            for _ in range(50):
                assert rig.run(1).supervisor is S.HOLD
                assert rig.controlwords() == {Controlword.QUICK_STOP}
            assert len(refusals(rig)) == count
            assert "the encoder of right_SA jumped by" in refusals(rig)[-1]
            assert "not used until it jumps back or its drive restarts" in refusals(rig)[-1]

    def test_start_is_accepted_after_the_encoder_jumped_back(self, make_rig):
        rig, signal = self.jumped(make_rig)
        signal.more = 0.0
        rig.run(30)
        rig.operator.start()
        assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE

    def test_start_is_accepted_after_the_drive_restarted(self, make_rig):
        rig, _ = self.jumped(make_rig)
        emulator = rig.emulator
        emulator._heartbeats.boot("RIGHT_FH", emulator.cycle)
        rig.run(30)
        rig.operator.start()
        assert rig.run(50).supervisor is S.HOLD
        emulator._heartbeats.boot("RIGHT_SA", emulator.cycle)
        rig.run(30)
        rig.operator.start()
        assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE


def test_start_refused_by_a_diagnostic_enables_no_drive(make_rig):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD)
    rig.run(10)
    rig.operator.start()
    for _ in range(20):
        rig.hal.report(Dtc.ENC_STUCK, "an encoder stands still")
        rig.run(1)
        assert Controlword.ENABLE_OPERATION not in rig.controlwords()
    assert rig.hal.state.supervisor is not S.ACTIVE


@pytest.mark.parametrize("state", [S.READY, S.HOLD])
@pytest.mark.parametrize("joint", [0, 3, 11])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_start_in_hold_is_refused_while_a_joint_moves(state: SupervisorState, joint: int, sign: float):
    velocity = np.full(12, np.nan)
    velocity[joint] = sign * AT_REST
    holding = np.full(12, float(D.QUICK_STOP_ACTIVE))
    request = PRESSED._replace(supervisor=state, velocity=velocity, drive_state=holding)
    assert refusal(ROBOT, request) is None
    velocity[joint] = sign * 1.0
    refused = refusal(ROBOT, request)
    text = f"{REFUSED}{JOINTS[joint]} still moves at 57 deg/s; must be at most 17 deg/s"
    assert refused == (Refusal("START_REFUSED", "warning", text) if state is S.HOLD else None)
    assert refusal(ROBOT, request._replace(pressed=False, cycles_left=100)) is None  # the test moves the joints
    holding[joint] = D.SWITCH_ON_DISABLED
    assert refusal(ROBOT, request) is None  # the joint sinks, because its drive is off


def test_unknown_velocities_do_not_refuse_a_start():
    assert (
        refusal(
            ROBOT,
            PRESSED._replace(
                supervisor=S.HOLD, velocity=np.full(12, np.nan), drive_state=np.full(12, float(D.QUICK_STOP_ACTIVE))
            ),
        )
        is None
    )
