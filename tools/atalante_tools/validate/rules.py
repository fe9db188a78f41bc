"""The rules as data: what each one means, where the DBC says so, what its worst value is measured in, and its thresholds.

The functions that judge are pure and on columns, one module a concern: `frame_rules`, `e2e_rules`, `value_rules`,
`timing_rules`, `order_rules`, `motion_rules`, `drive_rules`. A rule reports a cause once: a frame refused for its length is not
reported as lost by the counter, a silence beyond the timeout is no counter jump, a value that is out of range is in no value
table. A project's rules file (`project.py`) changes thresholds and silences rules.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Threshold = float | str | Mapping[str, float] | tuple[str, ...]


@dataclass(frozen=True)
class Rule:
    """One thing a frame can be wrong in."""

    id: str
    meaning: str  # one line
    source: str  # where the DBC (or the standard) says what is right
    worst: str = ""  # unit of the worst value
    thresholds: Mapping[str, Threshold] = field(default_factory=dict)


RULES = (
    # -- the log itself ----------------------------------------------------------------------------------------------
    Rule("log-empty", "The log holds no frame, so nothing was judged", "the log"),
    Rule("log-truncated", "The log breaks off within a record", "the log"),
    Rule("log-unreadable", "Entries of the log that are no CAN frame; nothing looked at them", "the log"),
    Rule("log-unsorted", "Time runs backwards in the log", "the log"),
    # -- identity ----------------------------------------------------------------------------------------------------
    Rule("unknown-id", "An identifier that no message of the DBC has", "BO_", "identifier"),
    Rule("unsupported", "A message whose DBC layout is not supported; nothing looked inside", "BO_, SG_", "bytes"),
    Rule("wrong-bus", "A message on another bus than its own", "BA_ Bus", "channel"),
    Rule("sender", "A message sent by another node than its transmitter", "BO_ transmitter, direction in the log"),
    # -- frame format ------------------------------------------------------------------------------------------------
    Rule("frame-ide", "Identifier length (11 or 29 bits) is not the message's", "BO_ bit 31"),
    Rule("frame-fdf", "Classic frame for a CAN FD message or the other way round", "BA_ VFrameFormat"),
    Rule("frame-brs", "Bit rate switch is not as the DBC says", "BA_ CANFD_BRS, DataBitrate"),
    Rule("frame-esi", "The sender is error passive", "ISO 11898-1 ESI"),
    Rule("frame-remote", "A remote request for a message that is sent unasked", "ISO 11898-1 RTR"),
    Rule("length", "Payload length is not the message's", "BO_ length", "bytes"),
    Rule("length-legal", "Payload length that no CAN frame can have", "ISO 11898-1 DLC", "bytes"),
    # -- end to end protection ---------------------------------------------------------------------------------------
    Rule("crc", "The CRC does not fit payload and Data ID: the frame is damaged", "BA_ E2EDataId"),
    Rule("crc-data-id", "The CRC is right for another message: sent under the wrong identifier", "BA_ E2EDataId"),
    Rule("counter-repeated", "The alive counter has not moved: the frame is a repetition", "BA_ E2EDataId", "frames"),
    Rule("counter-lost", "The alive counter says that frames before this one are missing", "BA_ E2EDataId", "lost",
         {"max_lost": 4.0}),
    Rule("counter-sequence", "The alive counter jumped: replayed, restarted, or very many lost", "BA_ E2EDataId", "steps"),
    # -- values ------------------------------------------------------------------------------------------------------
    Rule("range", "A signal outside its range", "SG_ [min|max]", "unit"),
    Rule("invalid-code", "A signal carries its code for \"no value\"", "BA_ InvalidRaw", "raw"),
    Rule("value-table", "A raw value without a name in the signal's value table", "VAL_", "raw"),
    Rule("reserved-bits", "Bits that belong to no signal are not what they should be", "SG_ (none)", "bits",
         {"value": 0.0}),
    Rule("multiplexer", "A multiplexer value for which there is no layout", "SG_ M, m", "raw"),
    Rule("dbc-hash", "A node reports the hash of another DBC than this one", "SG_ DbcHash, CRC-32 of the file", "hash",
         {"signal": "DbcHash"}),
    # -- time --------------------------------------------------------------------------------------------------------
    Rule("cycle-mean", "The mean cycle time is off", "BA_ GenMsgCycleTime", "ms",
         {"tolerance": 0.05, "min_intervals": 20.0}),
    Rule("cycle-jitter", "Cycle time jitter: 99 % of the intervals are not close enough to the median", "BA_ GenMsgCycleTime",
         "ms", {"p99": 0.25, "min_intervals": 100.0}),
    Rule("cycle-gap", "A frame came late, though none was lost", "BA_ GenMsgCycleTime", "ms", {"cycles": 2.0}),
    Rule("cycle-fast", "Three frames within one cycle: sent too often", "BA_ GenMsgCycleTime", "ms", {"cycles": 1.0}),
    Rule("inhibit", "An event was sent again too soon", "BA_ GenMsgDelayTime", "ms", {"share": 1.0}),
    Rule("timeout", "Silent beyond its timeout, to the end of the log", "BA_ TimeoutTime", "ms", {"default_cycles": 10.0}),
    Rule("recovered", "Silent beyond its timeout, then heard again", "BA_ TimeoutTime", "ms"),
    Rule("never-seen", "A cyclic message that is not in the log at all", "BA_ GenMsgCycleTime", "ms"),
    # -- order within the cycle --------------------------------------------------------------------------------------
    Rule("sync-order", "A state came before the SYNC of its cycle", "SYNC message of the bus", "ms"),
    Rule("state-late", "A state came too long after the SYNC of its cycle", "SYNC message of the bus", "ms",
         {"deadline": 0.8}),
    # -- bus ---------------------------------------------------------------------------------------------------------
    Rule("bus-load", "More load than the DBC's messages make", "BA_ NominalBitrate, DataBitrate, GenMsgCycleTime", "%",
         {"window_s": 0.1, "over_nominal": 1.02, "limit": 0.8}),
    Rule("error-frame", "An error frame: some node refused what was on the bus", "ISO 11898-1"),
    Rule("dropped", "The recording lost frames here", "controller overflow, kernel drop count", "frames"),
    # -- plausibility ------------------------------------------------------------------------------------------------
    Rule("velocity", "Velocity is not how the position changes", "SG_ Position, Velocity", "rad/s",
         {"position": "Position", "velocity": "Velocity", "window": 64.0, "lag_s": 0.005, "relative": 0.1, "absolute": 3.0}),
    Rule("quaternion-norm", "A quaternion whose length is not 1", "SG_ QuaternionW, X, Y, Z", "1",
         {"group": "Quaternion", "tolerance": 0.01}),
    Rule("stuck", "A measured value that does not move at all, not even by its noise", "SG_ of a noisy quantity", "frames",
         {"groups": ("Gyro", "Accel", "Force", "Torque"), "frames": 100.0}),
    Rule("step", "A value that jumps from one frame to the next", "SG_ of a slow quantity", "unit",
         {"Position": 0.6, "Temperature": 5.0, "SupplyVoltage": 5.0, "Uptime": 2.0, "Amplitude": 0.6}),
    # -- drives ------------------------------------------------------------------------------------------------------
    Rule("cia402-transition", "A change of drive state that CiA 402 does not have", "VAL_ DriveState, CiA 402-2",
         "from, to", {"state": "DriveState"}),
    Rule("cia402-response", "The drive did not follow a controlword", "VAL_ Controlword, CiA 402-2", "ms",
         {"command": "Controlword", "limit_ms": 10.0}),
)  # fmt: skip

RULE_OF: Mapping[str, Rule] = {rule.id: rule for rule in RULES}
assert len(RULE_OF) == len(RULES)
