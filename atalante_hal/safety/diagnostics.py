"""Diagnostic trouble codes: everything that can go wrong, with what is done about it, as data.

`message monitor -> diagnostics -> supervisor`: the message monitor raises codes, the supervisor folds them into the worst
reaction. A code is pending while it is noticed but survivable (a frame lost, a late cycle) and confirmed when its bound is
passed; its reaction follows when it is confirmed. The names are those of the fault matrix.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum, StrEnum


class Reaction(IntEnum):
    """What a confirmed diagnostic demands; larger is worse."""

    INFO = 0  # noted, nothing else
    NOT_READY = 1  # what moves goes on; no start until it is gone
    FULL_ASSIST = 2  # the assistance factor is led to 1
    FINISH_STEP = 3  # the step under way is finished, then HOLD
    HOLD = 4  # every drive holds its position
    LOWER = 5  # the joint concerned is let down, the others hold
    FAULT = 6  # latched until the operator acknowledges


class Severity(StrEnum):
    """How loud a confirmed diagnostic is; names of `telemetry.events.SEVERITIES`."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


_R, _S = Reaction, Severity


class Dtc(StrEnum):
    """One diagnostic trouble code; its value is the code in events, recordings and the fault matrix."""

    reaction: Reaction
    severity: Severity
    #: What it says, one phrase for people.
    meaning: str
    #: Its bit in a set of codes as an integer.
    bit: int

    def __new__(cls, code: str, reaction: Reaction, severity: Severity, meaning: str) -> Dtc:
        """Member with its data."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.reaction, member.severity, member.meaning = reaction, severity, meaning
        member.bit = 1 << len(cls.__members__)
        return member

    # Messages: what `message_monitor` finds in them.
    E2E_SOME_LOST = "E2E_SOME_LOST", _R.INFO, _S.INFO, "1 to 4 frames before this one are missing"
    E2E_REPEATED = "E2E_REPEATED", _R.INFO, _S.INFO, "a frame came twice"
    E2E_SEQUENCE = "E2E_SEQUENCE", _R.HOLD, _S.ERROR, "the counter jumped: an old frame, or more than 4 lost"
    E2E_CRC = "E2E_CRC", _R.HOLD, _S.ERROR, "a frame is damaged, or another node's"
    E2E_FROZEN = "E2E_FROZEN", _R.HOLD, _S.ERROR, "the counter of a node that speaks stands still"
    E2E_LOSS_RATE = "E2E_LOSS_RATE", _R.HOLD, _S.ERROR, "more than a fifth of a node's frames is lost"
    NODE_TIMEOUT = "NODE_TIMEOUT", _R.HOLD, _S.ERROR, "a node is silent"
    NODE_LATE = "NODE_LATE", _R.HOLD, _S.ERROR, "a node answers an earlier SYNC than the last"
    NODE_DUPLICATE = "NODE_DUPLICATE", _R.HOLD, _S.ERROR, "two senders of one message"
    FRAME_LENGTH = "FRAME_LENGTH", _R.HOLD, _S.ERROR, "length or format of a frame is not the DBC's"
    FRAME_UNKNOWN = "FRAME_UNKNOWN", _R.INFO, _S.WARNING, "a frame with an identifier nobody has"
    SIGNAL_RANGE = "SIGNAL_RANGE", _R.HOLD, _S.ERROR, "a signal is outside its DBC range"
    # Nodes.
    NODE_RESET = "NODE_RESET", _R.HOLD, _S.ERROR, "a node started anew or is not OPERATIONAL"
    HEARTBEAT_LOST = "HEARTBEAT_LOST", _R.NOT_READY, _S.WARNING, "the status of a node fails to come"
    DBC_MISMATCH = "DBC_MISMATCH", _R.NOT_READY, _S.ERROR, "a node speaks another DBC"
    DRIVE_STATE = "DRIVE_STATE", _R.HOLD, _S.ERROR, "a drive left OPERATION ENABLED unasked"
    DRIVE_FAULT = "DRIVE_FAULT", _R.FAULT, _S.ERROR, "a drive is in FAULT and did not say why"
    EMCY_CURRENT = "EMCY_2xxx", _R.FAULT, _S.ERROR, "emergency of a node: current"
    EMCY_VOLTAGE = "EMCY_3xxx", _R.HOLD, _S.ERROR, "emergency of a node: voltage"
    EMCY_ENCODER = "EMCY_7xxx", _R.LOWER, _S.ERROR, "emergency of a node: encoder or another sensor"
    EMCY_COMMUNICATION = "EMCY_8xxx", _R.HOLD, _S.ERROR, "emergency of a node: communication"
    EMCY_OTHER = "EMCY_xxxx", _R.FAULT, _S.ERROR, "emergency of a node: anything else"
    OVER_TEMP = "OVER_TEMP", _R.LOWER, _S.ERROR, "a drive is too hot to hold"
    DERATED = "DERATED", _R.HOLD, _S.WARNING, "a hot drive has less torque; confirmed: far less than its twin"
    UNDER_VOLTAGE = "UNDER_VOLTAGE", _R.HOLD, _S.ERROR, "the supply is too low"
    SUPPLY_LOW = "SUPPLY_LOW", _R.FINISH_STEP, _S.WARNING, "the supply is getting low"
    # Said by drives that hold by themselves.
    SYNC_LOST = "SYNC_LOST", _R.HOLD, _S.ERROR, "a node gets no SYNC"
    CMD_SOME_LOST = "CMD_SOME_LOST", _R.INFO, _S.INFO, "a drive misses 1 to 4 commands"
    CMD_TIMEOUT = "CMD_TIMEOUT", _R.HOLD, _S.ERROR, "a drive gets no commands"
    CMD_E2E = "CMD_E2E", _R.INFO, _S.WARNING, "a drive refused a damaged command"
    # Plausibility.
    ENC_STUCK = "ENC_STUCK", _R.LOWER, _S.ERROR, "an encoder stands still while its joint must move"
    ENC_JUMP = "ENC_JUMP", _R.HOLD, _S.ERROR, "an encoder moved further than its joint can"
    ENC_DRIFT = "ENC_DRIFT", _R.FULL_ASSIST, _S.WARNING, "an encoder has gone away from the model"
    ENC_VELOCITY = "ENC_VELOCITY", _R.HOLD, _S.ERROR, "a drive's velocity is not what its encoder does"
    POSITION_RANGE = "POSITION_RANGE", _R.HOLD, _S.ERROR, "a joint is outside its range"
    IMU_INVALID = "IMU_INVALID", _R.FULL_ASSIST, _S.WARNING, "an IMU says that it has no value"
    IMU_SATURATED = "IMU_SATURATED", _R.FULL_ASSIST, _S.WARNING, "an IMU is at the end of its range"
    IMU_STUCK = "IMU_STUCK", _R.FULL_ASSIST, _S.WARNING, "an IMU repeats one value"
    FOOT_CELL = "FOOT_CELL", _R.FULL_ASSIST, _S.WARNING, "a force cell contradicts the others"
    CONTACT_IMPLAUSIBLE = "CONTACT_IMPLAUSIBLE", _R.HOLD, _S.ERROR, "both feet say that they swing"
    # Bus.
    BUS_FLOOD = "BUS_FLOOD", _R.HOLD, _S.ERROR, "more frames than the HAL reads in a cycle"
    BUS_OFF = "BUS_OFF", _R.HOLD, _S.ERROR, "the CAN controller is bus-off"
    BUS_DOWN = "BUS_DOWN", _R.HOLD, _S.ERROR, "the bus is gone"
    BUS_TX_FULL = "BUS_TX_FULL", _R.HOLD, _S.ERROR, "the transmit queue is full"
    HAL_DUPLICATE = "HAL_DUPLICATE", _R.HOLD, _S.ERROR, "another HAL speaks on this bus"
    # Control and time.
    CONTROLLER_ERROR = "CONTROLLER_ERROR", _R.HOLD, _S.ERROR, "the controller raised"
    CMD_NONFINITE = "CMD_NONFINITE", _R.HOLD, _S.ERROR, "the controller asked for NaN or infinity"
    TORQUE_SATURATED = "TORQUE_SATURATED", _R.FULL_ASSIST, _S.WARNING, "the limiter cuts the torque"
    GUIDE_OUTSIDE = "GUIDE_OUTSIDE", _R.INFO, _S.INFO, "a joint is outside the virtual guide"
    CYCLE_GAP = "CYCLE_GAP", _R.HOLD, _S.ERROR, "too long between two cycles"
    OVERRUN = "OVERRUN", _R.HOLD, _S.ERROR, "late cycles in a row, or a loop that falls behind"
    OPERATOR_STOP = "OPERATOR_STOP", _R.HOLD, _S.INFO, "the operator stops, lets the dead-man go, or is not heard"
    SWING_TIMEOUT = "SWING_TIMEOUT", _R.FINISH_STEP, _S.ERROR, "a joint of the swing leg is not heard for a moment"
    # Outside the loop.
    RECORD_STOPPED = "RECORD_STOPPED", _R.INFO, _S.WARNING, "the recording ended early"
    TELEMETRY_DOWN = "TELEMETRY_DOWN", _R.INFO, _S.WARNING, "the telemetry process is gone"
    TELEMETRY_DROPPED = "TELEMETRY_DROPPED", _R.INFO, _S.INFO, "telemetry lost records"
    DBC_INVALID = "DBC_INVALID", _R.NOT_READY, _S.ERROR, "the DBC was refused"
    CONFIG_INVALID = "CONFIG_INVALID", _R.NOT_READY, _S.ERROR, "the configuration was refused"
    GAIT_INVALID = "GAIT_INVALID", _R.NOT_READY, _S.ERROR, "the gait was refused"


def number_of(bits: int) -> int:
    """Number of the worst of a set of codes, for one signal on the wire: its place in `Dtc`, counted from 1; 0: none."""
    found = dtcs_of(bits)
    return max(found, key=lambda dtc: (dtc.reaction, dtc.bit)).bit.bit_length() if found else 0


def by_number(number: int) -> str | None:
    """Code and meaning of `number_of`, for people; None for 0 and for what only another version knows."""
    codes = list(Dtc)
    return f"{codes[number - 1]}: {codes[number - 1].meaning}" if 0 < number <= len(codes) else None


def worst(diagnostics: Iterable[Dtc]) -> Reaction:
    """The reaction to all of them together: the worst."""
    return max((dtc.reaction for dtc in diagnostics), default=Reaction.INFO)


def dtcs_of(bits: int) -> tuple[Dtc, ...]:
    """The codes of a set of bits, in the order of their definition."""
    return tuple(dtc for dtc in Dtc if bits & dtc.bit)


#: Emergency error codes (CiA 301, CiA 402-1) that have a diagnostic of their own.
_EMERGENCIES = {
    0x3120: Dtc.UNDER_VOLTAGE,  # mains too low
    0x3220: Dtc.UNDER_VOLTAGE,  # DC link too low
    0x8110: Dtc.CMD_SOME_LOST,  # CAN overrun: objects lost
    0x8130: Dtc.SYNC_LOST,  # life guard: the master is not heard
    0x8150: Dtc.HAL_DUPLICATE,  # transmit identifier collision: a second source of commands
    0x8200: Dtc.CMD_E2E,  # protocol error
    0x8250: Dtc.CMD_TIMEOUT,  # RPDO timeout
    0x8700: Dtc.SYNC_LOST,  # SYNC controller
}
#: The others by their class, the highest digit.
_EMERGENCY_CLASSES = {
    0x2: Dtc.EMCY_CURRENT,
    0x3: Dtc.EMCY_VOLTAGE,
    0x4: Dtc.OVER_TEMP,
    0x7: Dtc.EMCY_ENCODER,
    0x8: Dtc.EMCY_COMMUNICATION,
}


def emergency(error_code: int) -> Dtc | None:
    """Diagnostic of an emergency message; None for code 0, "no error any more"."""
    if error_code == 0:
        return None
    return _EMERGENCIES.get(error_code) or _EMERGENCY_CLASSES.get(error_code >> 12, Dtc.EMCY_OTHER)


def event_code(dtc: Dtc, value: float) -> str:
    """What an event calls a diagnostic: its value, of an emergency with the error code in place of the x."""
    return f"EMCY_{int(value):04X}" if dtc.startswith("EMCY_") else dtc.value
