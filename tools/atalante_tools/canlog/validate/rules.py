"""Table of all validator rules: meaning, source in the DBC, unit of the worst value, and default thresholds.

The modules `frame_rules`, `e2e_rules`, `value_rules`, `timing_rules`, `order_rules`, `load_rules`, `motion_rules` and
`drive_rules` check many frames at a time. Each defect is reported by one rule only. For example, a frame with a wrong
length is not also reported as lost, a timeout is not also reported as a counter jump, and a value outside its range is
not also reported as missing in the value table. The rules file of a project (`project.py`) can change thresholds and
silence rules.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Threshold = float | str | Mapping[str, float] | tuple[str, ...]


@dataclass(frozen=True)
class Rule:
    """Rule of the validator: a kind of violation that the validator finds in frames or log files."""

    id: str
    meaning: str  # the violation, in one line
    source: str  # DBC attribute or standard that defines the correct value
    worst: str = ""  # unit of the value that the report shows for the worst violation
    thresholds: Mapping[str, Threshold] = field(default_factory=dict)


RULES = (
    # -- log file ----------------------------------------------------------------------------------------------------
    Rule("log-empty", "The log has no frame", "the log"),
    Rule("log-truncated", "The log is truncated, or its recorder did not close it", "the log"),
    Rule("log-unreadable", "Entries of the log are not CAN frames and were not checked", "the log"),
    Rule("log-unsorted", "The frames of the log are not in order of time", "the log"),
    # -- identity ----------------------------------------------------------------------------------------------------
    Rule("unknown-id", "The identifier is not in the DBC", "BO_", "identifier"),
    Rule("unsupported", "The DBC layout of the message is not supported; its payload was not checked",
         "BO_, SG_", "bytes"),
    Rule("wrong-bus", "The message was received on a bus other than its bus in the DBC", "BA_ Bus", "channel"),
    Rule("sender", "The message was sent by a node other than its transmitter in the DBC",
         "BO_ transmitter, direction in the log"),
    # -- frame format ------------------------------------------------------------------------------------------------
    Rule("frame-ide", "The identifier length (11 or 29 bits) differs from the DBC", "BO_ bit 31"),
    Rule("frame-fdf", "A classic frame for a CAN FD message, or a CAN FD frame for a classic message",
         "BA_ VFrameFormat"),
    Rule("frame-brs", "The bit rate switch differs from the DBC", "BA_ CANFD_BRS, DataBitrate"),
    Rule("frame-esi", "The sender is error passive", "ISO 11898-1 ESI"),
    Rule("frame-remote", "A remote frame instead of a data frame", "ISO 11898-1 RTR"),
    Rule("length", "The payload length differs from the DBC", "BO_ length", "bytes"),
    Rule("length-legal", "The payload length is not valid for a CAN frame", "ISO 11898-1 DLC", "bytes"),
    # -- end to end protection ---------------------------------------------------------------------------------------
    Rule("crc", "The CRC does not match payload and Data ID; the frame is damaged", "BA_ E2EDataId"),
    Rule("crc-data-id", "The CRC matches the Data ID of another message; the identifier is wrong", "BA_ E2EDataId"),
    Rule("counter-repeated", "The alive counter is unchanged; the frame is a repetition", "BA_ E2EDataId", "frames"),
    Rule("counter-lost", "Frames are lost according to the alive counter", "BA_ E2EDataId", "lost",
         {"max_lost": 4.0}),
    Rule("counter-sequence", "The alive counter jumped: frames replayed, node restarted, or many frames lost",
         "BA_ E2EDataId", "steps"),
    # -- values ------------------------------------------------------------------------------------------------------
    Rule("range", "The value of a signal is outside its range", "SG_ [min|max]", "unit"),
    Rule("invalid-code", "A signal has its code for \"no value\"", "BA_ InvalidRaw", "raw"),
    Rule("value-table", "The raw value is not in the value table of the signal", "VAL_", "raw"),
    Rule("reserved-bits", "Bits without a signal differ from the reserved value", "SG_ (none)", "bits",
         {"value": 0.0}),
    Rule("multiplexer", "The DBC defines no signals for the multiplexer value", "SG_ M, m", "raw"),
    Rule("dbc-hash", "A node reports the hash of another DBC", "SG_ DbcHash, CRC-32 of the file", "hash",
         {"signal": "DbcHash"}),
    # -- time --------------------------------------------------------------------------------------------------------
    Rule("cycle-mean", "The mean cycle time differs from the DBC", "BA_ GenMsgCycleTime", "ms",
         {"tolerance": 0.05, "min_intervals": 20.0}),
    Rule("cycle-jitter", "Cycle time jitter: the 99 % quantile of the distance to the median interval is too large",
         "BA_ GenMsgCycleTime",
         "ms", {"p99": 0.25, "min_intervals": 100.0}),
    Rule("cycle-gap", "A frame was late, and no frame was lost", "BA_ GenMsgCycleTime", "ms", {"cycles": 2.0}),
    Rule("cycle-fast", "Three frames within one cycle; the message is sent too often",
         "BA_ GenMsgCycleTime", "ms", {"cycles": 1.0}),
    Rule("inhibit", "Two events within the inhibit time", "BA_ GenMsgDelayTime", "ms", {"share": 1.0}),
    Rule("timeout", "The message timed out and was not received again",
         "BA_ TimeoutTime", "ms", {"default_cycles": 10.0}),
    Rule("recovered", "The message timed out and was received again later", "BA_ TimeoutTime", "ms"),
    Rule("late-start", "The first frame of the message came later than its timeout after the begin of the log",
         "BA_ TimeoutTime", "ms"),
    Rule("never-seen", "A cyclic message is not in the log", "BA_ GenMsgCycleTime", "ms"),
    # -- order within the cycle --------------------------------------------------------------------------------------
    Rule("sync-order", "A state was received before the SYNC of its cycle", "SYNC message of the bus", "ms"),
    Rule("state-late", "A state was received too long after the SYNC of its cycle", "SYNC message of the bus", "ms",
         {"deadline": 0.8}),
    # -- bus ---------------------------------------------------------------------------------------------------------
    Rule("bus-load", "The bus load exceeds the load of the messages in the DBC",
         "BA_ NominalBitrate, DataBitrate, GenMsgCycleTime", "%",
         {"window_s": 0.1, "over_nominal": 1.02, "limit": 0.8}),
    Rule("error-frame", "An error frame: a node detected a bus error", "ISO 11898-1"),
    Rule("dropped", "The recorder lost frames", "controller overflow, kernel drop count", "frames"),
    # -- plausibility ------------------------------------------------------------------------------------------------
    Rule("velocity", "The velocity differs from the change of the position", "SG_ Position, Velocity", "rad/s",
         {"position": "Position", "velocity": "Velocity", "window": 64.0, "lag_s": 0.005, "relative": 0.1, "absolute": 3.0}),
    Rule("quaternion-norm", "The norm of a quaternion is not 1", "SG_ QuaternionW, X, Y, Z", "1",
         {"group": "Quaternion", "tolerance": 0.01}),
    Rule("stuck", "A measured value is constant and has no noise", "SG_ of a noisy quantity", "frames",
         {"groups": ("Gyro", "Accel", "Force", "Torque"), "frames": 100.0}),
    Rule("step", "A value changes too much from one frame to the next", "SG_ of a slow quantity", "unit",
         {"Position": 0.6, "Temperature": 5.0, "SupplyVoltage": 5.0, "Uptime": 2.0, "Amplitude": 0.6}),
    # -- drives ------------------------------------------------------------------------------------------------------
    Rule("cia402-transition", "The change of the drive state is not a transition of CiA 402",
         "VAL_ DriveState, CiA 402-2",
         "from, to", {"state": "DriveState"}),
    Rule("cia402-response", "The drive did not respond to a controlword in time", "VAL_ Controlword, CiA 402-2", "ms",
         {"command": "Controlword", "limit_ms": 10.0}),
)  # fmt: skip

RULE_OF: Mapping[str, Rule] = {rule.id: rule for rule in RULES}
assert len(RULE_OF) == len(RULES)
