"""Validator rules: each mutation of a valid log violates exactly one rule; the valid log of a run violates none."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import starmap
from pathlib import Path

import numpy as np
import pytest

import atalante_dbc
from atalante_dbc.foreign import catalogue
from atalante_hal.types import Command, SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.e2e import crc, data_id_bytes
from atalante_hal.wire.frame import Frames
from atalante_tools.canlog.plan import Plan
from atalante_tools.canlog.reader.log import open_log
from atalante_tools.canlog.validate.coverage import unchecked, unseen_signals
from atalante_tools.canlog.validate.findings import Finding
from atalante_tools.canlog.validate.project import Project
from atalante_tools.canlog.validate.rules import RULE_OF
from atalante_tools.canlog.validate.validator import Validator
from atalante_tools.console.options import Target
from atalante_tools.session.rig import open_hal

NETWORK = atalante_dbc.load()
MS = 1_000_000  # ns
CYCLES = 1200
#: Cycle in which the drives are enabled and the HAL is ACTIVE.
MIDDLE = 800


@dataclasses.dataclass
class Line:
    """One frame of a candump log."""

    stamp: int  # ns
    channel: str
    identifier: str  # hexadecimal
    data: bytes
    sent: bool
    flags: str = "#1"  # "" for a classic frame
    text: str = ""  # replaces the whole line if not empty

    def __str__(self) -> str:
        seconds, rest = divmod(self.stamp, 10**9)
        direction = "T" if self.sent else "R"
        payload = self.data.hex().upper()
        return self.text or (
            f"({seconds}.{rest // 1000:06d}) {self.channel} {self.identifier}#{self.flags}{payload} {direction}"
        )


@dataclasses.dataclass
class Recording:
    """Log that tests may change; `of` finds the frames of a message."""

    lines: list[Line]

    def copy(self) -> Recording:
        lines = ((e.stamp, e.channel, e.identifier, e.data, e.sent, e.flags, e.text) for e in self.lines)
        return Recording(
            list(starmap(Line, lines))
        )  # `dataclasses.replace` takes three times as long, and a log has 30,000 lines

    def of(self, message: str) -> list[Line]:
        identifier = f"{NETWORK.message(message).frame_id:03X}"
        return [line for line in self.lines if line.identifier == identifier]

    def at(self, message: str, after: int = MIDDLE) -> Line:
        """Return the first frame of a message `after` cycles or more from the beginning of the log."""
        return next(line for line in self.of(message) if line.stamp >= self.lines[0].stamp + after * MS)

    def starting_at(self, line: Line) -> list[Line]:
        """Return the frames of the same message from this frame to the end."""
        same = [other for other in self.lines if other.identifier == line.identifier]
        return same[[other is line for other in same].index(True) :]

    def insert(self, line: Line, new: Line) -> None:
        """Insert a line after another line."""
        self.lines.insert([other is line for other in self.lines].index(True) + 1, new)

    def remove(self, lines: list[Line]) -> None:
        gone = {id(line) for line in lines}
        self.lines = [line for line in self.lines if id(line) not in gone]

    def sort(self) -> None:
        self.lines.sort(key=lambda line: line.stamp)


def set_raw(line: Line, message: str, signal: str, raw: int, data_id: int | None = None) -> None:
    """Write the raw code of a signal into a frame and update the CRC."""
    layout = NETWORK.message(message)
    field = layout.signal(signal)
    mask = (1 << field.length) - 1
    number = int.from_bytes(line.data, "little") & ~(mask << field.start) | (raw & mask) << field.start
    protect(line, message, number.to_bytes(len(line.data), "little"), data_id)


def protect(line: Line, message: str, data: bytes, data_id: int | None = None) -> None:
    data_id = NETWORK.message(message).data_id if data_id is None else data_id
    line.data = crc(data[2:], data_id_bytes(data_id)).to_bytes(2, "little") + data[2:]


def raw_of(line: Line, message: str, signal: str) -> int:
    field = NETWORK.message(message).signal(signal)
    return int.from_bytes(line.data, "little") >> field.start & (1 << field.length) - 1


class _Tap:
    """Recorder of both directions, with stamps of the cycle, as in `atalante demo --can-log`."""

    def __init__(self) -> None:
        self.cycle = 0
        self.lines: list[Line] = []
        self._bus = {m.frame_id: m.bus for m in NETWORK.messages}

    def sent(self, frames: Frames) -> None:
        self._add(frames, True)

    def received(self, frames: Frames, count: int) -> None:
        self._add(frames[:count], False)

    def _add(self, frames: Frames, sent: bool) -> None:
        for can_id, length, data in zip(frames["can_id"].tolist(), frames["len"].tolist(), frames["data"], strict=True):
            stamp = 1_700_000_000 * 10**9 + self.cycle * MS
            self.lines.append(Line(stamp, self._bus[can_id], f"{can_id:03X}", data[:length].tobytes(), sent))


@pytest.fixture(scope="module")
def recording() -> Recording:
    tap = _Tap()
    with open_hal(Target("embedded", "", True), tap=tap, seed=5) as rig:
        hal = rig.hal
        anchor = np.zeros(12)
        for tap.cycle in range(CYCLES):
            state = hal.read()
            if state.supervisor is SupervisorState.ACTIVE:
                swing = 0.05 * np.sin(2e-3 * np.pi * np.arange(12) + 0.02 * tap.cycle)
                hal.write(Command(hal.robot.hold_kp * (anchor + swing * 0.2 - state.position), np.zeros(8)))
            else:
                anchor = state.position.copy()
                hal.hold()
    assert hal.state.supervisor is SupervisorState.ACTIVE
    assert tap.cycle == CYCLES - 1
    return Recording(tap.lines)


def validate(
    lines: str, path: Path, plan: Plan, *, project: Project | None = None, pieces: int | None = None
) -> tuple[Validator, list[Finding]]:
    """Check a log, in chunks of `pieces` frames if given."""
    path.write_text(lines)
    validator = Validator(plan, project)
    log = open_log(path)
    for chunk in log.chunks():
        width = pieces or len(chunk)
        for first in range(0, len(chunk), width):
            validator.check(chunk.select(np.arange(first, min(first + width, len(chunk)))), log.channels.names)
    validator.finish(log.remarks)
    return validator, validator.findings.all()


def text_of(recording: Recording) -> str:
    return "".join(f"{line}\n" for line in recording.lines)


# -- mutations: rule -> change of the valid log ----------------------------------------------------------------------------


@dataclasses.dataclass
class Mutant:
    """Changed log; `cut` characters are missing at its end."""

    log: Recording
    cut: int = 0
    dbc: str | None = None


def unknown_id(log: Recording) -> None:
    log.insert(log.at("LEFT_FH_STATE"), dataclasses.replace(log.at("LEFT_FH_STATE"), identifier="7E0"))


def wrong_bus(log: Recording) -> None:
    log.at("LEFT_FH_STATUS").channel = "right_sense"


def sender(log: Recording) -> None:
    log.at("COMMAND_LEFT_LEG").sent = False


def identifier_length(log: Recording) -> None:
    line = log.at("LEFT_FH_STATE")
    line.identifier = f"00000{line.identifier}"


def classic(log: Recording) -> None:
    log.at("SYNC_LEFT_LEG").flags = ""


def no_rate_switch(log: Recording) -> None:
    log.at("LEFT_FH_STATE").flags = "#0"


def error_passive(log: Recording) -> None:
    log.at("LEFT_FH_STATE").flags = "#3"


def remote(log: Recording) -> None:
    line = log.at("LEFT_FH_STATUS")
    line.text = str(line).split("#")[0] + "#R R"


def short(log: Recording) -> None:
    line = log.at("LEFT_FH_STATE")
    line.data = line.data[:8]


def thirteen_bytes(log: Recording) -> None:
    log.at("LEFT_FH_STATE").data += b"\0"


def flipped_bit(log: Recording) -> None:
    line = log.at("LEFT_FH_STATE")
    line.data = line.data[:7] + bytes([line.data[7] ^ 4]) + line.data[8:]


def masquerade(log: Recording) -> None:
    line = log.at("LEFT_FH_STATE")
    protect(line, "LEFT_FH_STATE", line.data, NETWORK.message("LEFT_TH_STATE").data_id)


def repeated(log: Recording) -> None:
    line = log.at("LEFT_FH_STATE")
    log.insert(line, dataclasses.replace(line))


def lost(log: Recording) -> None:
    log.remove(log.starting_at(log.at("LEFT_FH_STATE"))[:3])


def jumped(log: Recording) -> None:
    for line in log.starting_at(log.at("LEFT_FH_STATE")):
        set_raw(line, "LEFT_FH_STATE", "Counter", raw_of(line, "LEFT_FH_STATE", "Counter") + 100)


def out_of_range(log: Recording) -> None:
    set_raw(log.at("HAPTICS_STATE"), "HAPTICS_STATE", "LeftThighFront_Amplitude", 230)


def no_value(log: Recording) -> None:
    set_raw(log.at("FOOT_LEFT_STATE"), "FOOT_LEFT_STATE", "Temperature", 0xFF)


def unnamed_value(log: Recording) -> None:
    set_raw(log.at("LEFT_FH_STATUS"), "LEFT_FH_STATUS", "NodeState", 3)


def reserved(log: Recording) -> None:
    line = log.at("IMU_TORSO_STATE")
    protect(line, "IMU_TORSO_STATE", line.data[:6] + b"\x81" + line.data[7:])


def other_dbc(log: Recording) -> None:
    set_raw(log.at("LEFT_FH_STATUS"), "LEFT_FH_STATUS", "DbcHash", 0x12345678)


def slow_clock(log: Recording) -> None:
    stretch(log, 1.06)


def fast_clock(log: Recording) -> None:
    stretch(log, 0.955)


def stretch(log: Recording, factor: float) -> None:
    first = log.lines[0].stamp
    for line in log.lines:
        line.stamp = first + round((line.stamp - first) * factor)


def jitter(log: Recording) -> None:
    for number, line in enumerate(log.of("COMMAND_LEFT_LEG")):
        line.stamp += [0, 350_000][number % 2]
    log.sort()


def late_once(log: Recording) -> None:
    for line in log.starting_at(log.at("COMMAND_LEFT_LEG")):
        line.stamp += 1_400_000
    log.sort()


def too_often(log: Recording) -> None:
    first, *others = log.starting_at(log.at("COMMAND_LEFT_LEG"))
    first.stamp -= 550_000
    for line in others:
        line.stamp -= 1_050_000
    log.sort()


def emergencies(log: Recording) -> None:
    for counter, after in enumerate((MIDDLE, MIDDLE + 10)):
        state = log.at("LEFT_FH_STATE", after)
        line = dataclasses.replace(state, identifier=f"{NETWORK.message('LEFT_FH_EMCY').frame_id:03X}", data=bytes(8))
        set_raw(line, "LEFT_FH_EMCY", "Counter", counter)
        log.insert(state, line)


def silent(log: Recording) -> None:
    log.remove(log.starting_at(log.at("LEFT_FH_STATE")))


def silent_for_a_while(log: Recording) -> None:
    log.remove(log.starting_at(log.at("LEFT_FH_STATE"))[:12])


def silent_at_first(log: Recording) -> None:
    log.remove(log.of("LEFT_FH_STATE")[:12])


def never(log: Recording) -> None:
    log.remove(log.of("HAL_STATUS"))


def before_sync(log: Recording) -> None:
    state, sync = log.at("LEFT_FH_STATE"), log.at("SYNC_LEFT_LEG")
    log.remove([sync])
    log.insert(state, sync)


def after_deadline(log: Recording) -> None:
    log.at("LEFT_FH_STATE").stamp += 900_000
    log.sort()


def error_frame(log: Recording) -> None:
    line = log.at("LEFT_FH_STATE")
    log.insert(line, dataclasses.replace(line, identifier="20000088", data=bytes(8), flags=""))


def overflow(log: Recording) -> None:
    line = log.at("LEFT_FH_STATE")
    log.insert(line, dataclasses.replace(line, identifier="20000004", data=b"\0\1" + bytes(6), flags=""))


def biased_velocity(log: Recording) -> None:
    for line in log.starting_at(log.at("LEFT_SK_STATE"))[:200]:
        raw = raw_of(line, "LEFT_SK_STATE", "Velocity")
        set_raw(line, "LEFT_SK_STATE", "Velocity", raw + 1000)


def short_quaternion(log: Recording) -> None:
    set_raw(log.at("IMU_TORSO_STATE"), "IMU_TORSO_STATE", "QuaternionW", 20000)


def frozen_gyro(log: Recording) -> None:
    for line in log.starting_at(log.at("IMU_PELVIS_STATE"))[:150]:
        set_raw(line, "IMU_PELVIS_STATE", "GyroX", 7)


def jump(log: Recording) -> None:
    set_raw(log.at("LEFT_FH_STATE"), "LEFT_FH_STATE", "Temperature", 120)


def illegal_transition(log: Recording) -> None:
    set_raw(log.at("LEFT_FH_STATE"), "LEFT_FH_STATE", "DriveState", DriveState.READY_TO_SWITCH_ON)


def not_followed(log: Recording) -> None:
    for line in log.starting_at(log.at("COMMAND_LEFT_LEG"))[:30]:
        set_raw(line, "COMMAND_LEFT_LEG", "FH_Controlword", Controlword.SWITCH_ON)


def garbage(log: Recording) -> None:
    log.insert(log.at("LEFT_FH_STATE"), dataclasses.replace(log.lines[0], text="(17000000x0.000000) left_leg 181##1"))


def exchanged(log: Recording) -> None:
    """Move a frame after frames with later stamps."""
    status, sync = log.at("LEFT_FH_STATUS"), log.at("SYNC_LEFT_LEG", MIDDLE + 150)
    log.remove([status])
    log.insert(sync, status)


def nothing(log: Recording) -> None:
    log.lines.clear()


def last_line(_log: Recording) -> None:
    pass


#: Rule -> mutation. `MULTIPLEXED` and `REFUSED` are added to the network for rules that need such messages.
MUTATIONS: dict[str, Callable[[Recording], None]] = {
    "log-empty": nothing,
    "log-truncated": last_line,
    "log-unreadable": garbage,
    "log-unsorted": exchanged,
    "unknown-id": unknown_id,
    "unsupported": lambda log: extra_message(log, "7F0", 1),
    "wrong-bus": wrong_bus,
    "sender": sender,
    "frame-ide": identifier_length,
    "frame-fdf": classic,
    "frame-brs": no_rate_switch,
    "frame-esi": error_passive,
    "frame-remote": remote,
    "length": short,
    "length-legal": thirteen_bytes,
    "crc": flipped_bit,
    "crc-data-id": masquerade,
    "counter-repeated": repeated,
    "counter-lost": lost,
    "counter-sequence": jumped,
    "range": out_of_range,
    "invalid-code": no_value,
    "value-table": unnamed_value,
    "reserved-bits": reserved,
    "multiplexer": lambda log: extra_message(log, "7F1", 2),
    "dbc-hash": other_dbc,
    "cycle-mean": slow_clock,
    "cycle-jitter": jitter,
    "cycle-gap": late_once,
    "cycle-fast": too_often,
    "inhibit": emergencies,
    "timeout": silent,
    "recovered": silent_for_a_while,
    "late-start": silent_at_first,
    "never-seen": never,
    "sync-order": before_sync,
    "state-late": after_deadline,
    "bus-load": fast_clock,
    "error-frame": error_frame,
    "dropped": overflow,
    "velocity": biased_velocity,
    "quaternion-norm": short_quaternion,
    "stuck": frozen_gyro,
    "step": jump,
    "cia402-transition": illegal_transition,
    "cia402-response": not_followed,
}

EXTRA = """BO_ 2032 REFUSED: 8 LEFT_FH
 SG_ Long : 0|65@1+ (1,0) [0|0] "1" HAL

BO_ 2033 MULTIPLEXED: 8 LEFT_FH
 SG_ Mode M : 0|8@1+ (1,0) [0|0] "1" HAL
 SG_ Speed m0 : 8|56@1+ (1,0) [0|0] "1" HAL
 SG_ Level m1 : 8|56@1- (1,0) [0|0] "1" HAL

"""


def extra_message(log: Recording, identifier: str, mode: int) -> None:
    state = log.at("LEFT_FH_STATE")
    log.insert(state, dataclasses.replace(state, identifier=identifier, data=bytes([mode]) + bytes(7)))


@pytest.fixture(scope="module")
def network() -> Plan:
    return Plan(catalogue(atalante_dbc.DBC_FILE))


@pytest.fixture(scope="module")
def extended_network(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """Return the network of the robot with a multiplexed message and a message with an unsupported layout."""
    path = tmp_path_factory.mktemp("dbc") / "extended.dbc"
    text = atalante_dbc.DBC_FILE.read_text()
    attributes = "".join(
        f'BA_ "VFrameFormat" BO_ {number} 14;\nBA_ "GenMsgSendType" BO_ {number} 1;\n' for number in (2032, 2033)
    )
    path.write_text(text.replace("BO_ 16 SYNC_LEFT_LEG", EXTRA + "BO_ 16 SYNC_LEFT_LEG", 1) + attributes)
    return Plan(catalogue(path))


def test_every_rule_has_a_mutation() -> None:
    assert set(MUTATIONS) == set(RULE_OF)


def set_dbc_hash(log: Recording, hash32: int) -> None:
    """Replace the DBC hash that all nodes report."""
    for message in NETWORK.messages:
        if message.name.endswith("_STATUS"):
            for line in log.of(message.name):
                set_raw(line, message.name, "DbcHash", hash32)


def mutant_of(rule: str, recording: Recording, plan: Plan) -> str:
    log = recording.copy()
    MUTATIONS[rule](log)
    if plan.catalogue.hash32 != NETWORK.hash32:
        set_dbc_hash(log, plan.catalogue.hash32)
    text = text_of(log)
    return text[:-20] if rule == "log-truncated" else text


def dbc_of(rule: str, network: Plan, extended_network: Plan) -> Plan:
    return extended_network if rule in ("unsupported", "multiplexer") else network


def test_valid_log_has_no_findings(recording: Recording, network: Plan, extended_network: Plan, tmp_path: Path) -> None:
    for dbc in (network, extended_network):
        log = recording.copy()
        set_dbc_hash(log, dbc.catalogue.hash32)
        validator, found = validate(text_of(log), tmp_path / "good.log", dbc)
        assert found == []
        assert validator.frames == len(recording.lines)


def test_all_buses_on_one_channel_are_reported_as_unchecked(
    recording: Recording, network: Plan, tmp_path: Path
) -> None:
    """A log of one virtual channel has no findings; the rules for bus and sender are listed as unchecked."""
    log = recording.copy()
    text = text_of(log)
    for bus in NETWORK.buses:
        text = text.replace(f" {bus} ", " vcan0 ")
    text = text.replace(" T\n", "\n").replace(" R\n", "\n")
    validator, found = validate(text, tmp_path / "vcan.log", network)
    assert found == []
    rules = {rule for item in unchecked(validator) for rule in item.rules}
    assert {"wrong-bus", "sender"} <= rules
    validator, _ = validate(text_of(log), tmp_path / "named.log", network)
    assert not {"wrong-bus", "sender"} & {rule for item in unchecked(validator) for rule in item.rules}


def test_unchecked_signals_are_listed(recording: Recording, network: Plan, tmp_path: Path) -> None:
    """Signals without a rule are in the list of unchecked signals; signals with a rule are not."""
    validator, _ = validate(text_of(recording), tmp_path / "good.log", network)
    unseen = {f"{layout.name}.{name}" for layout, name in unseen_signals(validator)}
    assert "SYNC_LEFT_LEG.Cycle" in unseen
    assert "PENDANT_STATE.RequestCounter" in unseen
    for seen in (
        "LEFT_FH_STATE.Position",
        "LEFT_FH_STATE.DriveState",
        "COMMAND_LEFT_LEG.FH_Controlword",
        "HAL_STATUS.DbcHash",
    ):
        assert seen not in unseen


@pytest.mark.sample(3)
@pytest.mark.parametrize("rule", RULE_OF)
def test_mutation_violates_only_its_rule(
    rule: str, recording: Recording, network: Plan, extended_network: Plan, tmp_path: Path
) -> None:
    """One chunk and chunks of 1601 frames give the same findings."""
    dbc = dbc_of(rule, network, extended_network)
    text = mutant_of(rule, recording, dbc)
    _, found = validate(text, tmp_path / "mutant.log", dbc)
    assert {finding.rule for finding in found} == {rule}, [finding.as_json() for finding in found]
    _, in_pieces = validate(text, tmp_path / "mutant.log", dbc, pieces=1601)
    assert [f.as_json() for f in in_pieces] == [f.as_json() for f in found]


def test_stuck_value_ends_at_its_first_change_although_frames_were_repeated(
    recording: Recording, network: Plan, tmp_path: Path
) -> None:
    log = recording.copy()
    frozen_gyro(log)
    frozen = log.starting_at(log.at("IMU_PELVIS_STATE"))
    for line in frozen[:40]:
        log.insert(line, dataclasses.replace(line))
    _, found = validate(text_of(log), tmp_path / "stuck.log", network)
    (stuck,) = (finding for finding in found if finding.rule == "stuck")
    assert stuck.first == frozen[150].stamp


def test_repeated_frames_do_not_change_the_mean_interval(recording: Recording, network: Plan, tmp_path: Path) -> None:
    log = recording.copy()
    lines = log.of("LEFT_FH_STATE")
    for line in lines[100:400:4]:
        log.insert(line, dataclasses.replace(line, stamp=line.stamp + 4 * MS // 10))
    log.sort()
    for pieces in (None, 1601):
        validator, found = validate(text_of(log), tmp_path / "repeated.log", network, pieces=pieces)
        assert "counter-repeated" in {finding.rule for finding in found}
        row = next(i for i, layout in enumerate(network.layouts) if layout.name == "LEFT_FH_STATE")
        assert validator.timing.mean_ms(row) == pytest.approx(1.0, abs=1e-3)
