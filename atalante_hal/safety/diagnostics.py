"""Table of the diagnostic trouble codes (DTCs), each with its reaction, severity and meaning.

`message monitor and other checks -> fault memory -> state machine`: the checks raise codes, and the state machine acts
on the worst reaction of the confirmed codes. A code is pending while the fault can be tolerated (a lost frame, a late
cycle). The code is confirmed when the fault exceeds its limit. Only a confirmed code causes a reaction. The fault
matrix uses the same names.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, StrEnum


class Reaction(IntEnum):
    """Reaction to a confirmed diagnostic, ordered from the mildest to the most severe."""

    INFO = 0  # record only
    NOT_READY = 1  # a moving robot does not react, but START is refused while the diagnostic is active
    FULL_ASSIST = 2  # ramp the assistance factor to 1
    FINISH_STEP = 3  # finish the walking step, then HOLD
    HOLD = 4  # all drives hold their positions
    LOWER = 5  # switch off the affected drive, so that its joint sinks slowly; all other drives hold their positions
    FAULT = 6  # the drives hold their positions until the operator acknowledges the fault


class Severity(StrEnum):
    """Severity of a confirmed diagnostic. The values are the strings in `events.SEVERITIES`."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


_R, _S = Reaction, Severity


class Dtc(StrEnum):
    """Diagnostic trouble code. The value of a member is its name in events, recordings and the fault matrix."""

    reaction: Reaction
    severity: Severity
    #: Short description for the operator.
    meaning: str
    #: Power of two, unique for each code. A set of codes is an integer, the sum of the values `bit` of its codes.
    bit: int

    def __new__(cls, code: str, reaction: Reaction, severity: Severity, meaning: str) -> Dtc:
        """Create a member of the enumeration from its code, reaction, severity and meaning."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.reaction, member.severity, member.meaning = reaction, severity, meaning
        member.bit = 1 << len(cls.__members__)
        return member

    # Faults of received messages, most of them raised by `message_monitor`.
    E2E_SOME_LOST = "E2E_SOME_LOST", _R.INFO, _S.INFO, "1 to 4 frames before this frame are missing"
    E2E_REPEATED = "E2E_REPEATED", _R.INFO, _S.INFO, "a frame was received twice"
    E2E_SEQUENCE = "E2E_SEQUENCE", _R.HOLD, _S.ERROR, "the counter jumped: an old frame, or more than 4 frames lost"
    E2E_CRC = "E2E_CRC", _R.HOLD, _S.ERROR, "the CRC is wrong: a damaged frame, or a frame of another node"
    E2E_FROZEN = "E2E_FROZEN", _R.HOLD, _S.ERROR, "the alive counter of a sending node does not change"
    E2E_REPEAT_RATE = "E2E_REPEAT_RATE", _R.HOLD, _S.ERROR, "frames of a node are received twice"
    E2E_LOSS_RATE = "E2E_LOSS_RATE", _R.HOLD, _S.ERROR, "more than a fifth of a node's frames are lost"
    NODE_TIMEOUT = "NODE_TIMEOUT", _R.HOLD, _S.ERROR, "a node timed out"
    NODE_LATE = "NODE_LATE", _R.HOLD, _S.ERROR, "a node answers an earlier SYNC than the latest one"
    NODE_DUPLICATE = "NODE_DUPLICATE", _R.HOLD, _S.ERROR, "two senders of one message"
    NODE_ERROR_PASSIVE = "NODE_ERROR_PASSIVE", _R.HOLD, _S.WARNING, "the CAN controller of a node is error passive"
    FRAME_LENGTH = "FRAME_LENGTH", _R.HOLD, _S.ERROR, "length or format of a frame differs from the DBC"
    FRAME_UNKNOWN = "FRAME_UNKNOWN", _R.INFO, _S.WARNING, "a frame has an identifier that the DBC does not define"
    SIGNAL_RANGE = "SIGNAL_RANGE", _R.HOLD, _S.ERROR, "a signal is outside its range in the DBC"
    # Nodes.
    NODE_RESET = "NODE_RESET", _R.HOLD, _S.ERROR, "a node restarted or is not OPERATIONAL"
    HEARTBEAT_LOST = "HEARTBEAT_LOST", _R.NOT_READY, _S.WARNING, "the status message of a node timed out"
    DBC_MISMATCH = "DBC_MISMATCH", _R.NOT_READY, _S.ERROR, "a node uses a different DBC than the HAL"
    DRIVE_STATE = "DRIVE_STATE", _R.HOLD, _S.ERROR, "a drive left OPERATION ENABLED without a command"
    DRIVE_FAULT = "DRIVE_FAULT", _R.FAULT, _S.ERROR, "a drive is in FAULT and sent no emergency message"
    EMCY_CURRENT = "EMCY_2xxx", _R.FAULT, _S.ERROR, "emergency of a node: current"
    EMCY_VOLTAGE = "EMCY_3xxx", _R.HOLD, _S.ERROR, "emergency of a node: voltage"
    EMCY_ENCODER = "EMCY_7xxx", _R.LOWER, _S.ERROR, "emergency of a node: encoder or another sensor"
    EMCY_COMMUNICATION = "EMCY_8xxx", _R.HOLD, _S.ERROR, "emergency of a node: communication"
    EMCY_OTHER = "EMCY_xxxx", _R.FAULT, _S.ERROR, "emergency of a node: anything else"
    OVER_TEMP = "OVER_TEMP", _R.LOWER, _S.ERROR, "a drive is too hot to hold its position"
    DERATED = "DERATED", _R.HOLD, _S.WARNING, "a hot drive has less torque; confirmed if far less than the other leg"
    UNDER_VOLTAGE = "UNDER_VOLTAGE", _R.HOLD, _S.ERROR, "the supply voltage is too low"
    SUPPLY_LOW = "SUPPLY_LOW", _R.FINISH_STEP, _S.WARNING, "the supply voltage is low"
    # Faults that drives report. A drive that reports SYNC_LOST or CMD_TIMEOUT already holds its position.
    SYNC_LOST = "SYNC_LOST", _R.HOLD, _S.ERROR, "a node receives no SYNC"
    CMD_SOME_LOST = "CMD_SOME_LOST", _R.INFO, _S.INFO, "a drive missed 1 to 4 commands"
    CMD_TIMEOUT = "CMD_TIMEOUT", _R.HOLD, _S.ERROR, "a drive receives no commands"
    CMD_E2E = "CMD_E2E", _R.INFO, _S.WARNING, "a drive rejected a damaged command"
    # Plausibility.
    ENC_STUCK = "ENC_STUCK", _R.LOWER, _S.ERROR, "the reading of an encoder is constant while its joint must move"
    ENC_JUMP = "ENC_JUMP", _R.HOLD, _S.ERROR, "an encoder reading changed by more than its joint can move"
    ENC_DRIFT = "ENC_DRIFT", _R.FULL_ASSIST, _S.WARNING, "an encoder reading contradicts the IMUs of its leg"
    ENC_VELOCITY = "ENC_VELOCITY", _R.HOLD, _S.ERROR, "the velocity of a drive contradicts its encoder position"
    POSITION_RANGE = "POSITION_RANGE", _R.HOLD, _S.ERROR, "a joint is outside its position range"
    IMU_INVALID = "IMU_INVALID", _R.FULL_ASSIST, _S.WARNING, "an IMU reports that it has no valid value"
    IMU_SATURATED = "IMU_SATURATED", _R.FULL_ASSIST, _S.WARNING, "an IMU reading is at the end of its measuring range"
    IMU_STUCK = "IMU_STUCK", _R.FULL_ASSIST, _S.WARNING, "the gyro reading of an IMU does not change"
    IMU_IMPLAUSIBLE = (
        "IMU_IMPLAUSIBLE",
        _R.FULL_ASSIST,
        _S.WARNING,
        "the readings of an IMU contradict gravity, each other or another IMU",
    )
    FOOT_CELL = "FOOT_CELL", _R.FULL_ASSIST, _S.WARNING, "a force cell contradicts the other cells or the posture"
    CONTACT_IMPLAUSIBLE = (
        "CONTACT_IMPLAUSIBLE",
        _R.HOLD,
        _S.ERROR,
        "the load on the feet contradicts ground and posture",
    )
    TORQUE_DIRECTION = (
        "TORQUE_DIRECTION",
        _R.LOWER,
        _S.ERROR,
        "a joint moves against its torque or not at all, or its encoder is that of the other leg",
    )
    TORQUE_TRACKING = "TORQUE_TRACKING", _R.LOWER, _S.ERROR, "a drive reports a torque that differs from its command"
    TORQUE_MOTION = "TORQUE_MOTION", _R.LOWER, _S.ERROR, "the motion of a joint contradicts the torque that was sent"
    HOLD_UNSTABLE = "HOLD_UNSTABLE", _R.LOWER, _S.ERROR, "a drive holds its position, but does not hold its joint"
    # Bus.
    BUS_FLOOD = "BUS_FLOOD", _R.HOLD, _S.ERROR, "too many frames arrived in a cycle"
    BUS_OFF = "BUS_OFF", _R.HOLD, _S.ERROR, "the CAN controller is bus-off"
    BUS_ERROR = "BUS_ERROR", _R.HOLD, _S.WARNING, "the CAN controller of the HAL reports errors on the bus"
    BUS_DOWN = "BUS_DOWN", _R.HOLD, _S.ERROR, "the bus interface is down"
    BUS_TX_FULL = "BUS_TX_FULL", _R.HOLD, _S.ERROR, "the transmit queue is full"
    HAL_DUPLICATE = "HAL_DUPLICATE", _R.HOLD, _S.ERROR, "another HAL sends on this bus"
    # Control and time.
    CONTROLLER_ERROR = "CONTROLLER_ERROR", _R.HOLD, _S.ERROR, "the controller raised an exception"
    CONTROLLER_LOST = (
        "CONTROLLER_LOST",
        _R.HOLD,
        _S.ERROR,
        "the controller raised exceptions in five consecutive cycles",
    )
    CMD_NONFINITE = "CMD_NONFINITE", _R.HOLD, _S.ERROR, "the controller requested a torque of NaN or infinity"
    TORQUE_SATURATED = "TORQUE_SATURATED", _R.FULL_ASSIST, _S.WARNING, "the limiter cuts the torque"
    GUIDE_OUTSIDE = (
        "GUIDE_OUTSIDE",
        _R.FULL_ASSIST,
        _S.WARNING,
        "h < 0: a joint is outside the virtual guide, or is predicted to exceed its guide, torque or speed limit",
    )
    CYCLE_GAP = "CYCLE_GAP", _R.HOLD, _S.ERROR, "the time between two cycles is too long"
    OVERRUN = "OVERRUN", _R.HOLD, _S.ERROR, "several consecutive cycles are late, or the loop falls behind the clock"
    OPERATOR_STOP = "OPERATOR_STOP", _R.HOLD, _S.INFO, "STOP pressed, dead-man switch released, or pendant timed out"
    JOINT_TIMEOUT = "JOINT_TIMEOUT", _R.FINISH_STEP, _S.ERROR, "a joint timed out briefly"
    OVERSPEED = "OVERSPEED", _R.HOLD, _S.ERROR, "a joint moves faster than the limiter permits"
    # Outside the loop.
    RECORD_STOPPED = "RECORD_STOPPED", _R.INFO, _S.WARNING, "the recording ended early"
    TELEMETRY_DOWN = "TELEMETRY_DOWN", _R.INFO, _S.WARNING, "the telemetry process ended"
    TELEMETRY_DROPPED = "TELEMETRY_DROPPED", _R.INFO, _S.INFO, "telemetry lost records"
    DBC_INVALID = "DBC_INVALID", _R.NOT_READY, _S.ERROR, "the DBC was rejected"
    CONFIG_INVALID = "CONFIG_INVALID", _R.NOT_READY, _S.ERROR, "the configuration was rejected"
    GAIT_INVALID = "GAIT_INVALID", _R.NOT_READY, _S.ERROR, "the gait was rejected"
    # New codes are appended here, because HAL_STATUS and recordings contain the position of a code in this list.
    FALLEN = "FALLEN", _R.HOLD, _S.ERROR, "the trunk leans so far that the robot has fallen"


#: Codes whose reaction is HOLD. A walking robot may make some more steps before HOLD, because the HAL can still control it.
_CONTROLLABLE = frozenset(
    {
        Dtc.E2E_REPEAT_RATE,
        Dtc.E2E_LOSS_RATE,
        Dtc.NODE_ERROR_PASSIVE,
        Dtc.DERATED,
        Dtc.BUS_ERROR,
        Dtc.CONTROLLER_ERROR,
        Dtc.OVERRUN,
    }
)
#: Codes whose reaction is HOLD. If the affected node is a drive, the robot goes to HOLD at once.
#: If the affected node is not a drive, but for example an IMU or a foot, a walking robot may make some more steps before HOLD.
#: Until the robot stands, the walking controller replaces the values of a lost IMU or of lost foot force sensors.
_CONTROLLABLE_WITHOUT_SENSOR = frozenset(
    {
        Dtc.E2E_SEQUENCE,
        Dtc.E2E_CRC,
        Dtc.E2E_FROZEN,
        Dtc.NODE_TIMEOUT,
        Dtc.NODE_LATE,
        Dtc.FRAME_LENGTH,
        Dtc.SIGNAL_RANGE,
        Dtc.NODE_RESET,
    }
)


def permits_walk_end(dtc: Dtc, drive: bool) -> bool:
    """Return whether a walking robot may end its walk on both feet (FINISH_STEP) although a diagnostic demands HOLD.

    A robot that stops within a step falls, because it stands on one foot and moves. So HOLD is delayed if the HAL still
    receives the joint values and the drives still follow the HAL.

    Args:
        dtc: confirmed diagnostic.
        drive: True if the affected node is a drive.
    """
    return dtc in _CONTROLLABLE or (not drive and dtc in _CONTROLLABLE_WITHOUT_SENSOR)


@dataclass(frozen=True)
class Finding:
    """Fault that a check finds in one cycle; the fault memory turns it into an active diagnostic."""

    dtc: Dtc
    node: str  # DBC name of the affected node
    value: float  # measured value; quantity and unit depend on the code
    confirmed: bool  # whether the diagnostic is confirmed (its reaction follows) or pending (no reaction)
    text: str  # one sentence for the operator; if empty, the event shows the node name and the code's meaning


def number_of(bits: int) -> int:
    """Return the number of the worst code in a bit set, as HAL_STATUS sends it.

    Args:
        bits: bit set of codes, see `Dtc.bit`.

    Returns:
        Position of the worst code in `Dtc`, counted from 1; 0 if the set is empty.
    """
    found = dtcs_of(bits)
    return max(found, key=lambda dtc: (dtc.reaction, dtc.bit)).bit.bit_length() if found else 0


def by_number(number: int) -> str | None:
    """Look up a diagnostic by its number, and return its code and meaning as text.

    Args:
        number: position of the code in `Dtc`, counted from 1.

    Returns:
        Text `code: meaning`; None for 0 and for a number that this version does not define.
    """
    codes = list(Dtc)
    return f"{codes[number - 1]}: {codes[number - 1].meaning}" if 0 < number <= len(codes) else None


def worst(diagnostics: Iterable[Dtc]) -> Reaction:
    """Return the most severe reaction of the diagnostics, INFO if there are none."""
    return max((dtc.reaction for dtc in diagnostics), default=Reaction.INFO)


def dtcs_of(bits: int) -> tuple[Dtc, ...]:
    """Return the codes in a bit set, in the order of their definition."""
    return tuple(dtc for dtc in Dtc if bits & dtc.bit)


#: Emergency error code (CiA 301, CiA 402-1) -> diagnostic. For all other error codes, the highest digit gives the diagnostic.
_EMERGENCIES = {
    0x3120: Dtc.UNDER_VOLTAGE,  # mains too low
    0x3220: Dtc.UNDER_VOLTAGE,  # DC link too low
    0x8110: Dtc.CMD_SOME_LOST,  # CAN overrun: objects lost
    0x8130: Dtc.SYNC_LOST,  # life guard: the messages of the HAL timed out
    0x8150: Dtc.HAL_DUPLICATE,  # identifier collision: a second node sends commands
    0x8200: Dtc.CMD_E2E,  # protocol error
    0x8250: Dtc.CMD_TIMEOUT,  # RPDO timeout
    0x8700: Dtc.SYNC_LOST,  # SYNC controller
}
#: Highest hexadecimal digit of an emergency error code -> diagnostic, for all codes that `_EMERGENCIES` does not contain.
_EMERGENCY_CLASSES = {
    0x2: Dtc.EMCY_CURRENT,
    0x3: Dtc.EMCY_VOLTAGE,
    0x4: Dtc.OVER_TEMP,
    0x7: Dtc.EMCY_ENCODER,
    0x8: Dtc.EMCY_COMMUNICATION,
}


def emergency(error_code: int) -> Dtc | None:
    """Return the diagnostic of an emergency message.

    Args:
        error_code: emergency error code (CiA 301), 16 bits.

    Returns:
        The diagnostic; None for code 0, which reports that the node has no error any more.
    """
    if error_code == 0:
        return None
    return _EMERGENCIES.get(error_code) or _EMERGENCY_CLASSES.get(error_code >> 12, Dtc.EMCY_OTHER)


def event_code(dtc: Dtc, value: float) -> str:
    """Return the code that an event shows for a diagnostic. The code of an emergency includes its error code, as in EMCY_8130.

    Args:
        dtc: diagnostic trouble code.
        value: measured value of the diagnostic; for an emergency its error code.
    """
    return f"EMCY_{int(value):04X}" if dtc.startswith("EMCY_") else dtc.value
