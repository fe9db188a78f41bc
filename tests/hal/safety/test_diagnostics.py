"""Diagnostic codes: completeness, distinct bits and the reaction of each code."""

from __future__ import annotations

import pytest

from atalante_hal.safety.diagnostics import (
    Dtc,
    Reaction,
    Severity,
    by_number,
    dtcs_of,
    emergency,
    event_code,
    number_of,
    worst,
)
from atalante_hal.safety.events import SEVERITIES

R = Reaction

#: Expected reaction of every code; an accidental change of a reaction fails the test.
DEMANDS = {
    R.INFO: "E2E_SOME_LOST E2E_REPEATED FRAME_UNKNOWN CMD_SOME_LOST CMD_E2E GUIDE_OUTSIDE RECORD_STOPPED TELEMETRY_DOWN "
    "TELEMETRY_DROPPED",
    R.NOT_READY: "HEARTBEAT_LOST DBC_MISMATCH DBC_INVALID CONFIG_INVALID GAIT_INVALID",
    R.FULL_ASSIST: "ENC_DRIFT IMU_INVALID IMU_SATURATED IMU_STUCK FOOT_CELL TORQUE_SATURATED",
    R.FINISH_STEP: "SUPPLY_LOW SWING_TIMEOUT",
    R.HOLD: "E2E_SEQUENCE E2E_CRC E2E_FROZEN E2E_LOSS_RATE NODE_TIMEOUT NODE_LATE NODE_DUPLICATE FRAME_LENGTH SIGNAL_RANGE "
    "NODE_RESET DRIVE_STATE EMCY_3xxx EMCY_8xxx DERATED UNDER_VOLTAGE SYNC_LOST CMD_TIMEOUT ENC_JUMP ENC_VELOCITY "
    "POSITION_RANGE CONTACT_IMPLAUSIBLE BUS_FLOOD BUS_OFF BUS_DOWN BUS_TX_FULL HAL_DUPLICATE CONTROLLER_ERROR CMD_NONFINITE "
    "CYCLE_GAP OVERRUN OPERATOR_STOP",
    R.LOWER: "EMCY_7xxx OVER_TEMP ENC_STUCK",
    R.FAULT: "DRIVE_FAULT EMCY_2xxx EMCY_xxxx",
}  # fmt: skip


def test_each_code_demands_what_is_written_here_and_there_is_no_other():
    found = {reaction: {d.value for d in Dtc if d.reaction is reaction} for reaction in Reaction}
    assert found == {reaction: set(codes.split()) for reaction, codes in DEMANDS.items()}


def test_severities_are_those_of_events_and_what_stops_the_robot_is_no_information():
    for dtc in Dtc:
        assert dtc.severity.value in SEVERITIES
        assert dtc.meaning
        if dtc.reaction >= R.HOLD:
            assert (dtc.severity is not Severity.INFO) or dtc is Dtc.OPERATOR_STOP


def test_bits_are_distinct_and_come_back_as_codes():
    assert [dtc.bit for dtc in Dtc] == [1 << place for place in range(len(Dtc))]
    assert dtcs_of(0) == ()
    assert dtcs_of(Dtc.BUS_OFF.bit | Dtc.E2E_CRC.bit) == (Dtc.E2E_CRC, Dtc.BUS_OFF)
    assert dtcs_of((1 << len(Dtc)) - 1) == tuple(Dtc)


def test_what_the_loop_can_find_fits_into_one_number_of_the_record():
    outside = list(Dtc)[list(Dtc).index(Dtc.RECORD_STOPPED) :]
    assert {d.value for d in outside} == {
        "RECORD_STOPPED", "TELEMETRY_DOWN", "TELEMETRY_DROPPED", "DBC_INVALID", "CONFIG_INVALID", "GAIT_INVALID"
    }  # fmt: skip
    assert outside[0].bit <= 1 << 53  # float64 represents the sum of all lower bits exactly


def test_worst():
    assert worst([]) is R.INFO
    assert worst([Dtc.FOOT_CELL, Dtc.ENC_STUCK, Dtc.BUS_OFF]) is R.LOWER


@pytest.mark.parametrize(
    ("code", "dtc"),
    [
        (0x0000, None),
        (0x1000, Dtc.EMCY_OTHER),
        (0x2310, Dtc.EMCY_CURRENT),
        (0x3120, Dtc.UNDER_VOLTAGE),
        (0x3220, Dtc.UNDER_VOLTAGE),
        (0x3210, Dtc.EMCY_VOLTAGE),
        (0x4310, Dtc.OVER_TEMP),
        (0x5000, Dtc.EMCY_OTHER),
        (0x7305, Dtc.EMCY_ENCODER),
        (0x8110, Dtc.CMD_SOME_LOST),
        (0x8130, Dtc.SYNC_LOST),
        (0x8150, Dtc.HAL_DUPLICATE),
        (0x8700, Dtc.SYNC_LOST),
        (0x8140, Dtc.EMCY_COMMUNICATION),
        (0x8200, Dtc.CMD_E2E),
        (0x8250, Dtc.CMD_TIMEOUT),
        (0xFFFF, Dtc.EMCY_OTHER),
    ],
)
def test_the_class_of_an_emergency(code: int, dtc: Dtc | None):
    assert emergency(code) is dtc


def test_an_emergency_event_carries_its_error_code():
    assert event_code(Dtc.EMCY_CURRENT, 0x2310) == "EMCY_2310"
    assert event_code(Dtc.EMCY_OTHER, 0x00FF) == "EMCY_00FF"
    assert event_code(Dtc.OVER_TEMP, 0x4310) == "OVER_TEMP"


def test_one_number_stands_for_the_worst_of_a_set():
    assert number_of(0) == 0
    assert by_number(0) is None
    for place, dtc in enumerate(Dtc, start=1):
        assert number_of(dtc.bit) == place
        assert by_number(place) == f"{dtc}: {dtc.meaning}"
    assert by_number(len(Dtc) + 1) is None
    assert by_number(-1) is None
    assert number_of(Dtc.FOOT_CELL.bit | Dtc.ENC_STUCK.bit | Dtc.OPERATOR_STOP.bit) == number_of(Dtc.ENC_STUCK.bit)
    assert number_of(Dtc.E2E_SEQUENCE.bit | Dtc.OPERATOR_STOP.bit) == number_of(Dtc.OPERATOR_STOP.bit)
    assert number_of(Dtc.E2E_SOME_LOST.bit) == 1
