"""Diagnostic codes: completeness, distinct bits and the reaction of each code."""

from __future__ import annotations

import pytest

from atalante_hal.record_layout import joined_bits, split_bits
from atalante_hal.safety.diagnostics import (
    Dtc,
    Reaction,
    Severity,
    by_number,
    dtcs_of,
    emergency,
    event_code,
    number_of,
    permits_walk_end,
    worst,
)
from atalante_hal.safety.events import SEVERITIES

R = Reaction

#: Expected reaction of every code, so that an accidental change of a reaction fails the test.
REACTIONS = {
    R.INFO: "E2E_SOME_LOST E2E_REPEATED FRAME_UNKNOWN CMD_SOME_LOST CMD_E2E RECORD_STOPPED TELEMETRY_DOWN "
    "TELEMETRY_DROPPED",
    R.NOT_READY: "HEARTBEAT_LOST DBC_MISMATCH DBC_INVALID CONFIG_INVALID GAIT_INVALID",
    R.FULL_ASSIST: "ENC_DRIFT IMU_INVALID IMU_SATURATED IMU_STUCK IMU_IMPLAUSIBLE FOOT_CELL TORQUE_SATURATED GUIDE_OUTSIDE",
    R.FINISH_STEP: "SUPPLY_LOW JOINT_TIMEOUT",
    R.HOLD: "E2E_SEQUENCE E2E_CRC E2E_FROZEN E2E_LOSS_RATE NODE_TIMEOUT NODE_LATE NODE_DUPLICATE FRAME_LENGTH SIGNAL_RANGE "
    "NODE_RESET DRIVE_STATE EMCY_3xxx EMCY_8xxx DERATED UNDER_VOLTAGE SYNC_LOST CMD_TIMEOUT ENC_JUMP ENC_VELOCITY "
    "POSITION_RANGE CONTACT_IMPLAUSIBLE BUS_FLOOD BUS_OFF BUS_DOWN BUS_TX_FULL HAL_DUPLICATE CONTROLLER_ERROR CMD_NONFINITE "
    "CONTROLLER_LOST CYCLE_GAP OVERRUN OPERATOR_STOP E2E_REPEAT_RATE NODE_ERROR_PASSIVE BUS_ERROR OVERSPEED FALLEN",
    R.LOWER: "EMCY_7xxx OVER_TEMP ENC_STUCK TORQUE_DIRECTION TORQUE_TRACKING TORQUE_MOTION HOLD_UNSTABLE",
    R.FAULT: "DRIVE_FAULT EMCY_2xxx EMCY_xxxx",
}  # fmt: skip


def test_every_code_has_its_expected_reaction():
    found = {reaction: {d.value for d in Dtc if d.reaction is reaction} for reaction in Reaction}
    assert found == {reaction: set(codes.split()) for reaction, codes in REACTIONS.items()}


#: Codes with the reaction HOLD with which a walk may end on both feet: for every node, or only if the node is not a drive.
WALK_ENDS = "E2E_REPEAT_RATE E2E_LOSS_RATE NODE_ERROR_PASSIVE DERATED BUS_ERROR CONTROLLER_ERROR OVERRUN"
WALK_ENDS_WITHOUT_SENSOR = "E2E_SEQUENCE E2E_CRC E2E_FROZEN NODE_TIMEOUT NODE_LATE FRAME_LENGTH SIGNAL_RANGE NODE_RESET"


def test_walk_ends_on_both_feet_only_if_the_joints_are_known_and_the_drives_follow():
    with_drive = {dtc.value for dtc in Dtc if permits_walk_end(dtc, drive=True)}
    with_sensor = {dtc.value for dtc in Dtc if permits_walk_end(dtc, drive=False)}
    assert with_drive == set(WALK_ENDS.split())
    assert with_sensor - with_drive == set(WALK_ENDS_WITHOUT_SENSOR.split())
    assert {Dtc(code).reaction for code in with_sensor} == {R.HOLD}


def test_severities_are_valid_and_stopping_codes_are_not_information():
    for dtc in Dtc:
        assert dtc.severity.value in SEVERITIES
        assert dtc.meaning
        if dtc.reaction >= R.HOLD:
            assert (dtc.severity is not Severity.INFO) or dtc is Dtc.OPERATOR_STOP


def test_bits_are_distinct_and_converted_back_to_codes():
    assert [dtc.bit for dtc in Dtc] == [1 << position for position in range(len(Dtc))]
    assert dtcs_of(0) == ()
    assert dtcs_of(Dtc.BUS_OFF.bit | Dtc.E2E_CRC.bit) == (Dtc.E2E_CRC, Dtc.BUS_OFF)
    assert dtcs_of((1 << len(Dtc)) - 1) == tuple(Dtc)


def test_all_codes_fit_exactly_into_the_two_fields_of_a_record():
    for bits in [(1 << len(Dtc)) - 1, *(dtc.bit for dtc in Dtc)]:
        low, high = split_bits(bits)
        assert joined_bits(float(low), float(high)) == bits
        assert max(low, high) < 1 << 53  # float64 represents the sum of all lower bits exactly


def test_new_codes_do_not_change_the_numbers_of_the_other_codes():
    """HAL_STATUS contains this number, and the hash of the DBC does not depend on it."""
    assert list(Dtc).index(Dtc.GAIT_INVALID) == 68
    assert number_of(Dtc.BUS_FLOOD.bit) == 48
    assert number_of(Dtc.FALLEN.bit) == 70


def test_worst_is_the_most_severe_reaction_of_the_codes():
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
def test_emergency_code_gives_the_diagnostic_of_its_class(code: int, dtc: Dtc | None):
    assert emergency(code) is dtc


def test_event_of_an_emergency_class_contains_its_error_code():
    assert event_code(Dtc.EMCY_CURRENT, 0x2310) == "EMCY_2310"
    assert event_code(Dtc.EMCY_OTHER, 0x00FF) == "EMCY_00FF"
    assert event_code(Dtc.OVER_TEMP, 0x4310) == "OVER_TEMP"


def test_number_of_a_set_is_that_of_its_most_severe_code():
    assert number_of(0) == 0
    assert by_number(0) is None
    for position, dtc in enumerate(Dtc, start=1):
        assert number_of(dtc.bit) == position
        assert by_number(position) == f"{dtc}: {dtc.meaning}"
    assert by_number(len(Dtc) + 1) is None
    assert by_number(-1) is None
    assert number_of(Dtc.FOOT_CELL.bit | Dtc.ENC_STUCK.bit | Dtc.OPERATOR_STOP.bit) == number_of(Dtc.ENC_STUCK.bit)
    assert number_of(Dtc.E2E_SEQUENCE.bit | Dtc.OPERATOR_STOP.bit) == number_of(Dtc.OPERATOR_STOP.bit)
    assert number_of(Dtc.E2E_SOME_LOST.bit) == 1
