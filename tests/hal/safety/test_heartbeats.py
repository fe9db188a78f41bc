"""Heartbeats: status, emergencies and supply voltage of the nodes."""

from __future__ import annotations

import random

import numpy as np
import pytest

from atalante_dbc import load
from atalante_hal.robot import load_robot
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.safety.heartbeats import BOOT_UP, Heartbeats
from atalante_hal.wire.e2e import FULL
from atalante_hal.wire.frame import FLAG_ESI, Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage

NETWORK, THRESHOLDS = load(), load_robot().thresholds
LOW, UNDER = THRESHOLDS.supply_low, THRESHOLDS.supply_under
SLOW = [m for m in NETWORK.received_by("HAL") if m.cycle_ms != 1]
NODES = [n.name for n in NETWORK.nodes if n.kind not in ("master", "pendant")]


class Nodes:
    """Simulated nodes, and the heartbeat monitor that receives their frames."""

    def __init__(self) -> None:
        self.tx = TransmitImage(SLOW)
        self.heartbeats, self.memory = Heartbeats(NETWORK, THRESHOLDS), FaultMemory()
        self.vibration = np.zeros(8)
        self.now = 0
        for node in [*NODES, "PENDANT"]:
            self.set_signals(node, "STATUS", NodeState=5, DbcHash=NETWORK.hash32, SupplyVoltage=48.0)

    def set_signals(self, node: str, kind: str, **signals: float) -> None:
        for signal, value in signals.items():
            self.tx.values[self.tx.codec.index(f"{node}_{kind}", signal)] = value

    def frame(self, node: str, kind: str = "STATUS", **signals: float) -> Frames:
        self.set_signals(node, kind, **signals)
        return self.tx.seal_row(self.tx.codec.rows[f"{node}_{kind}"]).copy()

    def receive(self, *frames: Frames, cycle: int | None = None) -> list[int]:
        self.now = self.now + 1 if cycle is None else cycle
        return self.heartbeats.accept(np.concatenate(frames), self.now, self.vibration)

    def evaluate(self) -> dict[tuple[str, str], bool]:
        self.heartbeats.evaluate(self.now, self.memory)
        self.memory.close_cycle(self.now)
        return {(dtc.value, node): entry.confirmed for (dtc, node), entry in self.memory.active.items()}

    def send_every_status(self) -> None:
        self.receive(*[self.frame(node) for node in [*NODES, "PENDANT"]])


@pytest.fixture
def nodes() -> Nodes:
    return Nodes()


@pytest.fixture
def running(nodes: Nodes) -> Nodes:
    nodes.send_every_status()
    assert nodes.evaluate() == {}
    return nodes


def test_nodes_are_known_after_a_status_of_each_except_the_pendant(nodes: Nodes):
    *first, last = NODES
    for node in first:
        nodes.receive(nodes.frame(node))
        assert not nodes.heartbeats.all_reported
    assert nodes.heartbeats.missing() == {last}
    nodes.receive(nodes.frame(last))
    assert nodes.heartbeats.all_reported
    assert nodes.heartbeats.missing() == set()
    assert nodes.heartbeats.quiet is False, "the state machine has to be run: the robot may become READY"
    assert nodes.evaluate() == {}
    assert nodes.heartbeats.quiet
    assert nodes.heartbeats.quiet


def test_second_boot_up_is_reported_as_reset(nodes: Nodes):
    nodes.receive(nodes.frame("LEFT_SK", NodeState=0))
    assert nodes.evaluate() == {}
    assert nodes.heartbeats.quiet
    nodes.receive(nodes.frame("LEFT_SK", NodeState=0))
    assert nodes.heartbeats.quiet is False
    assert nodes.evaluate() == {("NODE_RESET", "LEFT_SK"): True}
    nodes.receive(nodes.frame("LEFT_SK", NodeState=5))
    assert nodes.evaluate() == {}


def test_boot_up_with_any_counter_is_reported_as_reset(running: Nodes):
    running.tx.set_counter(running.tx.codec.rows["LEFT_SK_STATUS"], 100)
    running.receive(running.frame("LEFT_SK", NodeState=0))
    assert running.evaluate() == {("NODE_RESET", "LEFT_SK"): True}


@pytest.mark.parametrize("state", [4, 127, 1])
@pytest.mark.parametrize("known", [True, False])
def test_node_that_is_not_operational_is_reported_until_its_state_changes(nodes: Nodes, state: int, known: bool):
    if known:
        nodes.send_every_status()
        assert nodes.evaluate() == {}
    nodes.receive(nodes.frame("LEFT_SK", NodeState=state))
    for _ in range(3):
        assert nodes.heartbeats.quiet is False
        assert nodes.evaluate() == {("NODE_RESET", "LEFT_SK"): True}
        nodes.now += 1
    nodes.receive(nodes.frame("LEFT_SK", NodeState=5))
    assert nodes.evaluate() == {}
    assert nodes.heartbeats.quiet


def test_node_that_was_not_operational_for_a_moment_is_reported_once(running: Nodes):
    running.receive(running.frame("LEFT_SK", NodeState=4), running.frame("LEFT_SK", NodeState=5))
    assert running.evaluate() == {("NODE_RESET", "LEFT_SK"): True}
    running.now += 1
    assert running.evaluate() == {}


def test_node_that_reports_boot_up_again_and_again_is_reported_until_it_is_operational(nodes: Nodes):
    for _ in range(2):
        nodes.receive(nodes.frame("LEFT_SK", NodeState=0))
    for _ in range(3):
        assert nodes.evaluate() == {("NODE_RESET", "LEFT_SK"): True}
        nodes.now += 1
    nodes.receive(nodes.frame("LEFT_SK", NodeState=5))
    assert nodes.evaluate() == {}
    nodes.receive(nodes.frame("LEFT_SK", NodeState=0))
    assert nodes.evaluate() == {("NODE_RESET", "LEFT_SK"): True}
    nodes.now += 1
    assert nodes.evaluate() == {}, "one boot-up is an event"


def test_emergency_that_is_cleared_in_the_same_cycle_is_reported_once(running: Nodes):
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0x2310), running.frame("LEFT_SK", "EMCY", ErrorCode=0))
    assert running.evaluate() == {("EMCY_2xxx", "LEFT_SK"): True}
    assert running.memory.events[0].value == 0x2310
    running.now += 1
    assert running.evaluate() == {}
    assert running.heartbeats.quiet


def test_emergency_that_is_cleared_in_the_next_cycle_is_not_reported_again(running: Nodes):
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0x2310))
    assert running.evaluate() == {("EMCY_2xxx", "LEFT_SK"): True}
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0))
    assert running.evaluate() == {}


def test_essential_frames_are_emergencies_and_the_newest_status_with_each_state(nodes: Nodes):
    sent = [
        nodes.frame("LEFT_SK", NodeState=5),
        nodes.frame("LEFT_SK", NodeState=0),
        nodes.frame("LEFT_SK", "EMCY", ErrorCode=0x2310),
        nodes.frame("LEFT_SK", NodeState=5),
        nodes.frame("RIGHT_SK", NodeState=5),
        nodes.frame("LEFT_SK", "EMCY", ErrorCode=0x2310),
        nodes.frame("LEFT_SK", NodeState=5),
        nodes.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=0.5),
        nodes.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=1.0),
    ]
    assert nodes.heartbeats.essential(np.concatenate(sent)).tolist() == [1, 2, 4, 5, 6, 8]
    assert nodes.heartbeats.essential(new_frames(0)).tolist() == []
    many = np.concatenate([nodes.frame("LEFT_SK", "EMCY", ErrorCode=0x2310)] * 300)
    assert nodes.heartbeats.essential(many).tolist() == list(range(172, 300))


def test_other_dbc_hash_is_reported_until_it_changes(nodes: Nodes):
    nodes.receive(nodes.frame("IMU_TORSO", DbcHash=NETWORK.hash32 ^ 1))
    assert nodes.heartbeats.quiet is False
    assert nodes.evaluate() == {("DBC_MISMATCH", "IMU_TORSO"): True}
    assert nodes.heartbeats.missing() == set(NODES)
    assert nodes.memory.events[0].value == NETWORK.hash32 ^ 1
    nodes.now += 1
    assert nodes.evaluate() == {("DBC_MISMATCH", "IMU_TORSO"): True}  # until the node sends another status
    assert nodes.heartbeats.quiet is False


@pytest.mark.parametrize("node", ["LEFT_SK", "HAPTICS", "PENDANT"])
def test_heartbeat_is_lost_exactly_at_its_timeout(running: Nodes, node: str):
    others = [n for n in [*NODES, "PENDANT"] if n != node]
    running.receive(*[running.frame(n) for n in others], cycle=150)
    running.now = 1 + 249
    assert not running.heartbeats.overdue(running.now)
    assert running.evaluate() == {}
    running.now = 1 + 250
    assert running.heartbeats.overdue(running.now)
    assert running.evaluate() == {("HEARTBEAT_LOST", node): True}
    assert running.heartbeats.quiet is False
    assert running.memory.events[0].value == 250
    running.receive(running.frame(node))
    assert not running.heartbeats.overdue(running.now)
    assert running.evaluate() == {}
    assert running.heartbeats.quiet


def test_no_node_is_known_before_the_first_frame(nodes: Nodes):
    assert nodes.heartbeats.all_reported is False
    assert nodes.heartbeats.quiet is True
    assert nodes.heartbeats.missing() == set(NODES)


@pytest.mark.parametrize("cycle", [0, 1, 10_000])
def test_node_without_any_frame_is_not_overdue(nodes: Nodes, cycle: int):
    assert not nodes.heartbeats.overdue(cycle)
    assert nodes.evaluate() == {}


@pytest.mark.parametrize(
    ("volts", "code"),
    [
        (48.0, None),
        (LOW, None),
        (LOW - 0.1, "SUPPLY_LOW"),
        (UNDER, "SUPPLY_LOW"),
        (UNDER - 0.1, "UNDER_VOLTAGE"),
        (0.0, "UNDER_VOLTAGE"),
    ],
)
def test_low_supply_of_a_drive_is_reported(running: Nodes, volts: float, code: str | None):
    running.receive(running.frame("LEFT_SK", SupplyVoltage=volts))
    assert running.heartbeats.quiet is (code is None)
    assert running.evaluate() == ({(code, "LEFT_SK"): True} if code else {})
    assert running.heartbeats.quiet is (code is None)
    assert not code or running.memory.events[0].value == pytest.approx(volts)


@pytest.mark.parametrize("node", ["PENDANT", "IMU_TORSO", "FOOT_LEFT", "HAPTICS"])
def test_low_supply_of_another_node_is_ignored(running: Nodes, node: str):
    running.receive(running.frame(node, SupplyVoltage=0.0))
    assert running.heartbeats.quiet
    assert running.evaluate() == {}


@pytest.mark.parametrize("node", ["PENDANT", "IMU_TORSO", "FOOT_LEFT", "HAPTICS"])
def test_low_supply_of_another_node_is_ignored_beside_a_fault(running: Nodes, node: str):
    running.receive(running.frame(node, SupplyVoltage=0.0), running.frame("LEFT_SK", SupplyVoltage=UNDER - 0.1))
    assert running.evaluate() == {("UNDER_VOLTAGE", "LEFT_SK"): True}


def test_node_without_any_frame_is_not_lost_beside_a_fault(nodes: Nodes):
    nodes.receive(nodes.frame("LEFT_SK", SupplyVoltage=UNDER - 0.1), cycle=0)
    assert nodes.evaluate() == {("UNDER_VOLTAGE", "LEFT_SK"): True}


def test_emergency_lasts_until_the_node_clears_it(running: Nodes):
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0x4310))
    assert running.heartbeats.quiet is False
    for _ in range(3):
        assert running.evaluate() == {("OVER_TEMP", "LEFT_SK"): True}
        assert running.heartbeats.quiet is False
        running.now += 1
    assert running.memory.events[0].text == "LEFT_SK: a drive is too hot to hold its position (emergency 0x4310)"
    assert running.memory.events[0].value == 0x4310
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0))
    assert running.evaluate() == {}
    assert running.heartbeats.quiet
    running.receive(running.frame("LEFT_SA", "EMCY", ErrorCode=0))
    assert running.evaluate() == {}


def test_several_emergencies_in_one_cycle_are_all_reported(running: Nodes):
    running.receive(
        running.frame("LEFT_SK", "EMCY", ErrorCode=0x8110),
        running.frame("LEFT_SA", "EMCY", ErrorCode=0x2310),
        running.frame("LEFT_SK", "EMCY", ErrorCode=0x8250),
    )
    assert running.evaluate() == {
        ("CMD_SOME_LOST", "LEFT_SK"): False,
        ("CMD_TIMEOUT", "LEFT_SK"): True,
        ("EMCY_2xxx", "LEFT_SA"): True,
    }
    running.now += 1
    assert running.evaluate() == {("CMD_TIMEOUT", "LEFT_SK"): True, ("EMCY_2xxx", "LEFT_SA"): True}
    assert [(e.code, e.value) for e in running.memory.events] == [
        ("CMD_SOME_LOST", 0x8110),
        ("EMCY_2310", 0x2310),
        ("CMD_TIMEOUT", 0x8250),
    ]


@pytest.mark.parametrize("same_cycle", [False, True])
@pytest.mark.parametrize(("worst", "code"), [(0x2310, "EMCY_2xxx"), (0x4310, "OVER_TEMP")])
def test_milder_emergency_does_not_replace_a_worse_one(running: Nodes, worst: int, code: str, same_cycle: bool):
    frames = [running.frame("LEFT_SK", "EMCY", ErrorCode=error) for error in (worst, 0x3220)]
    if same_cycle:
        running.receive(*frames)
    else:
        running.receive(frames[0])
        assert running.evaluate() == {(code, "LEFT_SK"): True}
        running.receive(frames[1])
    assert running.evaluate() == {(code, "LEFT_SK"): True, ("UNDER_VOLTAGE", "LEFT_SK"): False}
    running.now += 1
    assert running.evaluate() == {(code, "LEFT_SK"): True}
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0))
    assert running.evaluate() == {}


def test_worse_emergency_replaces_a_milder_one(running: Nodes):
    for error in (0x3220, 0x4310):
        running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=error))
    assert running.evaluate() == {("OVER_TEMP", "LEFT_SK"): True}


def test_acknowledge_keeps_emergencies_of_faulty_drives(running: Nodes):
    for node in ("LEFT_SK", "LEFT_SA"):
        running.receive(running.frame(node, "EMCY", ErrorCode=0x4310))
    running.heartbeats.acknowledge({"LEFT_SA"})
    assert running.heartbeats.emergencies == {"LEFT_SA": (Dtc.OVER_TEMP, 0x4310)}
    assert running.evaluate() == {("OVER_TEMP", "LEFT_SA"): True}


def test_acknowledge_keeps_emergencies_of_the_same_cycle(running: Nodes):
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0x4310))
    running.evaluate()
    running.receive(running.frame("LEFT_SA", "EMCY", ErrorCode=0x4310))
    running.evaluate()
    running.heartbeats.acknowledge(set())
    running.now += 1
    assert running.evaluate() == {("OVER_TEMP", "LEFT_SA"): True}
    running.heartbeats.acknowledge(set())
    running.now += 1
    assert running.evaluate() == {}


def test_start_before_the_first_evaluation_acknowledges_the_emergencies(nodes: Nodes):
    nodes.receive(nodes.frame("LEFT_SK", "EMCY", ErrorCode=0x4310))
    nodes.heartbeats.acknowledge(set())
    assert nodes.heartbeats.emergencies == {}


def test_received_amplitudes_are_written_to_the_state(running: Nodes):
    level = running.tx.codec.slice("Amplitude")
    running.tx.values[level] = 0.5
    running.receive(running.frame("LEFT_SK"))
    assert not running.vibration.any()
    row = running.tx.codec.rows["HAPTICS_STATE"]
    assert running.receive(running.tx.seal_row(row).copy()) == []
    assert (running.vibration == 0.5).all()
    running.tx.values[level] = 0.75
    running.tx.seal_row(row)  # is lost
    assert running.receive(running.tx.seal_row(row).copy()) == []
    assert (running.vibration == 0.75).all()
    running.tx.values[level] = 1.0
    damaged = running.tx.seal_row(row).copy()
    damaged["data"][0, 9] ^= 1
    running.receive(damaged)
    assert (running.vibration == 0.75).all()
    assert running.heartbeats.quiet is False


def damaged(frame: Frames) -> Frames:
    frame["data"][0, 6] ^= 1
    return frame


def shortened(frame: Frames) -> Frames:
    frame["len"] = 12
    return frame


def test_rejected_frames_are_reported_and_not_used(running: Nodes):
    repeated = running.frame("FOOT_LEFT")
    out_of_range = running.frame("IMU_TORSO", SupplyVoltage=np.nan)
    running.receive(
        damaged(running.frame("LEFT_SK", NodeState=0)),
        shortened(running.frame("LEFT_SA", NodeState=0)),
        repeated,
        repeated,
        out_of_range,
    )
    assert running.heartbeats.quiet is False
    assert running.evaluate() == {
        ("E2E_CRC", "LEFT_SK"): False,
        ("FRAME_LENGTH", "LEFT_SA"): False,
        ("E2E_REPEATED", "FOOT_LEFT"): False,
        ("SIGNAL_RANGE", "IMU_TORSO"): False,
    }
    running.now += 1
    assert running.evaluate() == {}


def test_unknown_frames_are_returned(running: Nodes):
    unknown = new_frames(1)
    unknown["can_id"] = 0x7FF
    assert running.receive(unknown, running.frame("LEFT_SK"), unknown) == [0, 2]
    assert running.heartbeats.quiet
    cyclic = TransmitImage([NETWORK.message("LEFT_SK_STATE")]).seal()
    assert running.receive(cyclic) == [0]  # a cyclic message, which another process image receives


def test_restarted_sender_with_the_last_counter_is_accepted_and_reported(running: Nodes):
    row = running.tx.codec.rows["LEFT_SK_STATUS"]
    running.tx.set_counter(row, int(running.tx.frames["data"][row, 2]) - 1 & 0xFF)
    running.receive(running.frame("LEFT_SK", Uptime=9.0))
    assert running.heartbeats.quiet is False
    assert running.heartbeats.image.values[running.heartbeats.image.codec.index("LEFT_SK_STATUS", "Uptime")] == 9.0
    assert running.evaluate() == {("NODE_DUPLICATE", "LEFT_SK"): False}
    assert running.heartbeats.quiet


def test_emergency_with_the_last_counter_is_accepted(running: Nodes):
    row = running.tx.codec.rows["LEFT_SK_EMCY"]
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0x7305))
    running.tx.set_counter(row, int(running.tx.frames["data"][row, 2]) - 1 & 0xFF)
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0x4310))
    assert running.heartbeats.emergencies == {"LEFT_SK": (Dtc.OVER_TEMP, 0x4310)}


def test_two_senders_are_confirmed_at_the_fifth_conflict(running: Nodes):
    row = running.tx.codec.rows["HAPTICS_STATE"]
    for pair in range(1, 7):
        true = running.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=0.25)
        running.tx.set_counter(row, int(true["data"][0, 2]) - 1 & 0xFF)
        running.receive(true, running.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=0.5))
        assert not running.heartbeats.quiet
        assert running.evaluate() == {("NODE_DUPLICATE", "HAPTICS"): pair > 4}
        assert running.heartbeats.quiet is (pair <= 4)
    entry = running.memory.active[Dtc.NODE_DUPLICATE, "HAPTICS"]
    assert entry.value == FULL
    assert entry.text == "HAPTICS: two senders of one message, HAPTICS_STATE: switch one of them off"
    running.receive(running.frame("HAPTICS", "STATE"))
    assert running.evaluate() == {}
    assert running.heartbeats.quiet


def test_two_senders_are_confirmed_although_frames_of_another_node_are_damaged(running: Nodes):
    row = running.tx.codec.rows["HAPTICS_STATE"]
    for pair in range(1, 6):
        damaged = running.frame("LEFT_SK")
        damaged["data"][0, 5] ^= 1
        true = running.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=0.25)
        running.tx.set_counter(row, int(true["data"][0, 2]) - 1 & 0xFF)
        running.receive(damaged, true, running.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=0.5))
        assert running.evaluate()["NODE_DUPLICATE", "HAPTICS"] is (pair > 4)


def test_frames_of_one_sender_are_no_evidence_of_two_senders(running: Nodes):
    running.receive(running.frame("LEFT_SK"), running.frame("HAPTICS", "STATE"))  # the first frame of HAPTICS_STATE
    assert running.heartbeats.quiet is True


def test_booted_node_is_listed(running: Nodes):
    running.receive(running.frame("LEFT_SK"))
    assert running.heartbeats.booted == set()
    running.receive(running.frame("LEFT_SK", NodeState=BOOT_UP))
    running.evaluate()
    assert running.heartbeats.booted == {"LEFT_SK"}


def test_node_whose_uptime_decreases_is_listed_as_booted_and_reported_as_reset(running: Nodes):
    """The boot-up message was lost. After 65535 s, the uptime of a node that has not restarted may continue with 0."""
    for uptime, booted in (
        (0, False),
        (7, False),
        (7, False),
        (8, False),
        (6, True),
        (65535, False),
        (0, False),
        (65534, False),
        (65533, True),
    ):
        running.heartbeats.booted.clear()
        running.receive(running.frame("IMU_PELVIS", Uptime=uptime), running.frame("LEFT_SK", Uptime=3))
        assert running.heartbeats.booted == ({"IMU_PELVIS"} if booted else set())
        assert running.heartbeats.quiet is not booted
        assert running.evaluate() == ({("NODE_RESET", "IMU_PELVIS"): True} if booted else {})
        assert running.heartbeats.quiet


def test_pendant_that_takes_over_with_a_lower_uptime_is_no_restart(running: Nodes):
    for uptime in (9, 0):
        running.receive(running.frame("PENDANT", Uptime=uptime))
        assert running.heartbeats.booted == set()
        assert running.heartbeats.quiet
        assert running.evaluate() == {}


def test_same_emergency_after_a_restart_of_the_node_is_accepted(running: Nodes):
    emergency = running.frame("LEFT_SK", "EMCY", ErrorCode=0x7305)
    running.receive(emergency)
    assert running.evaluate() == {("EMCY_7xxx", "LEFT_SK"): True}
    running.heartbeats.acknowledge(set())
    running.receive(running.frame("LEFT_SK", NodeState=BOOT_UP))
    running.evaluate()
    running.receive(emergency)
    assert running.evaluate() == {("EMCY_7xxx", "LEFT_SK"): True}


def test_restart_of_another_node_does_not_repeat_an_emergency(running: Nodes):
    emergency = running.frame("LEFT_SK", "EMCY", ErrorCode=0x7305)
    running.receive(emergency)
    running.heartbeats.acknowledge(set())
    running.receive(running.frame("LEFT_SA", NodeState=BOOT_UP), emergency)
    assert running.evaluate() == {("NODE_RESET", "LEFT_SA"): True, ("E2E_REPEATED", "LEFT_SK"): False}


def test_emergency_explains_a_fault_until_it_is_cleared(running: Nodes):
    assert not running.heartbeats.has_emergency("LEFT_SK")
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0x7305))
    running.evaluate()
    assert running.heartbeats.has_emergency("LEFT_SK")
    assert not running.heartbeats.has_emergency("LEFT_SA")
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0))
    running.evaluate()
    assert running.heartbeats.has_emergency("LEFT_SK")
    running.now += 1
    running.evaluate()
    assert not running.heartbeats.has_emergency("LEFT_SK")
    running.receive(running.frame("LEFT_SK", "EMCY", ErrorCode=0))
    assert not running.heartbeats.has_emergency("LEFT_SK"), "no emergency was active"


def test_status_of_an_error_passive_node_is_reported(running: Nodes):
    status = running.frame("LEFT_SK")
    status["flags"] |= FLAG_ESI
    running.receive(status)
    assert running.heartbeats.quiet is False
    assert running.evaluate() == {("NODE_ERROR_PASSIVE", "LEFT_SK"): False}


def test_status_of_an_error_passive_node_is_used(running: Nodes):
    status = running.frame("LEFT_SK", SupplyVoltage=UNDER - 1.0)
    status["flags"] |= FLAG_ESI
    assert running.receive(status) == []
    assert running.heartbeats.quiet is False
    assert running.evaluate() == {("NODE_ERROR_PASSIVE", "LEFT_SK"): False, ("UNDER_VOLTAGE", "LEFT_SK"): True}
    assert running.memory.active[Dtc.NODE_ERROR_PASSIVE, "LEFT_SK"].value == 0
    running.receive(running.frame("LEFT_SK", SupplyVoltage=48.0))
    assert running.evaluate() == {}


def test_status_that_is_received_twice_in_a_cycle_is_reported(running: Nodes):
    status = running.frame("LEFT_SK")
    running.receive(status, status)
    assert running.heartbeats.quiet is False
    assert running.evaluate() == {("E2E_REPEATED", "LEFT_SK"): False}
    assert running.heartbeats.quiet


def test_boot_up_that_is_received_twice_in_a_cycle_is_no_reset(nodes: Nodes):
    boot_up = nodes.frame("LEFT_SK", NodeState=BOOT_UP)
    nodes.receive(boot_up, boot_up)
    assert nodes.evaluate() == {("E2E_REPEATED", "LEFT_SK"): False}


#: Signals of the status messages and emergencies of a random history: some are fault-free, the others have one fault.
HISTORY = [
    ("STATUS", {"NodeState": 5, "DbcHash": NETWORK.hash32, "SupplyVoltage": 48.0}),
    ("STATUS", {"NodeState": 5, "DbcHash": NETWORK.hash32, "SupplyVoltage": LOW - 0.1}),
    ("STATUS", {"NodeState": 5, "DbcHash": NETWORK.hash32, "SupplyVoltage": UNDER - 0.1}),
    ("STATUS", {"NodeState": BOOT_UP, "DbcHash": NETWORK.hash32, "SupplyVoltage": 48.0}),
    ("STATUS", {"NodeState": 5, "DbcHash": NETWORK.hash32 ^ 1, "SupplyVoltage": 48.0}),
    ("EMCY", {"ErrorCode": 0x4310}),
    ("EMCY", {"ErrorCode": 0x8120}),
    ("EMCY", {"ErrorCode": 0}),
]


@pytest.mark.parametrize("seed", range(10))
def test_quiet_never_hides_a_fault(nodes: Nodes, seed: int):
    """A second monitor gets the same frames, but has to look for faults in every cycle."""
    rng = random.Random(seed)
    full, memory = Heartbeats(NETWORK, THRESHOLDS), FaultMemory()
    some, good = ("LEFT_SK", "RIGHT_HA", "LEFT_FH"), HISTORY[0][1]
    outcomes = set()
    for step in range(300):
        if step % 15 == 0:  # the end of all faults
            frames = [nodes.frame(node, **good) for node in [*NODES, "PENDANT"] if node not in some]
            frames += [
                nodes.frame(node, kind, **signals) for node in some for kind, signals in (HISTORY[0], HISTORY[-1])
            ]
        else:
            chosen = rng.choices(HISTORY, weights=[8, *[1] * 7], k=rng.choice((0, 0, 0, 1, 2)))
            frames = [nodes.frame(rng.choice(some), kind, **signals) for kind, signals in chosen]
        if frames and rng.random() < 0.1:
            frames[0]["data"][0, 6] ^= 1
        if frames and rng.random() < 0.1:
            frames.append(frames[0])
        nodes.now += rng.choice((1, 1, 1, 20, 60))
        if frames:
            full.accept(np.concatenate(frames), nodes.now, np.zeros(8))
            nodes.receive(*frames, cycle=nodes.now)
        quiet = full.quiet
        assert nodes.heartbeats.quiet is quiet
        full.quiet = False
        full.evaluate(nodes.now, memory)
        memory.close_cycle(nodes.now)
        found = nodes.evaluate()
        assert {(dtc.value, node): entry.confirmed for (dtc, node), entry in memory.active.items()} == found
        assert [str(e) for e in memory.events] == [str(e) for e in nodes.memory.events]
        assert nodes.heartbeats.quiet is full.quiet
        assert nodes.heartbeats.booted == full.booted
        outcomes.add((quiet, bool(found)))
    assert {(True, False), (False, True)} <= outcomes
