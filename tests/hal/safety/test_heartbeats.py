"""Heartbeats: status, emergencies and supply voltage of the nodes."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import load
from atalante_hal.robot import load_robot
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.safety.heartbeats import BOOT_UP, Heartbeats
from atalante_hal.wire.e2e import FULL
from atalante_hal.wire.frame import Frames, new_frames
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
            self.say(node, "STATUS", NodeState=5, DbcHash=NETWORK.hash32, SupplyVoltage=48.0)

    def say(self, node: str, kind: str, **signals: float) -> None:
        for signal, value in signals.items():
            self.tx.values[self.tx.codec.index(f"{node}_{kind}", signal)] = value

    def frame(self, node: str, kind: str = "STATUS", **signals: float) -> Frames:
        self.say(node, kind, **signals)
        return self.tx.seal_row(self.tx.codec.rows[f"{node}_{kind}"]).copy()

    def hear(self, *frames: Frames, cycle: int | None = None) -> list[int]:
        self.now = self.now + 1 if cycle is None else cycle
        return self.heartbeats.accept(np.concatenate(frames), self.now, self.vibration)

    def judge(self) -> dict[tuple[str, str], bool]:
        self.heartbeats.judge(self.now, self.memory)
        self.memory.close_cycle(self.now)
        return {(dtc.value, node): entry.confirmed for (dtc, node), entry in self.memory.active.items()}

    def all_well(self) -> None:
        self.hear(*[self.frame(node) for node in [*NODES, "PENDANT"]])


@pytest.fixture
def nodes() -> Nodes:
    return Nodes()


@pytest.fixture
def well(nodes: Nodes) -> Nodes:
    nodes.all_well()
    assert nodes.judge() == {}
    return nodes


def test_nodes_are_known_after_a_status_of_each_except_the_pendant(nodes: Nodes):
    *first, last = NODES
    for node in first:
        nodes.hear(nodes.frame(node))
        assert not nodes.heartbeats.known
    assert nodes.heartbeats.missing() == {last}
    nodes.hear(nodes.frame(last))
    assert nodes.heartbeats.known
    assert nodes.heartbeats.missing() == set()
    assert nodes.heartbeats.quiet is False, "the state machine has to be run: the robot may become READY"
    assert nodes.judge() == {}
    assert nodes.heartbeats.quiet
    assert nodes.heartbeats.quiet


def test_second_boot_up_is_reported_as_reset(nodes: Nodes):
    nodes.hear(nodes.frame("LEFT_SK", NodeState=0))
    assert nodes.judge() == {}
    assert nodes.heartbeats.quiet
    nodes.hear(nodes.frame("LEFT_SK", NodeState=0))
    assert nodes.heartbeats.quiet is False
    assert nodes.judge() == {("NODE_RESET", "LEFT_SK"): True}
    nodes.hear(nodes.frame("LEFT_SK", NodeState=5))
    assert nodes.judge() == {}


def test_boot_up_with_any_counter_is_reported_as_reset(well: Nodes):
    well.tx.resume(well.tx.codec.rows["LEFT_SK_STATUS"], 100)
    well.hear(well.frame("LEFT_SK", NodeState=0))
    assert well.judge() == {("NODE_RESET", "LEFT_SK"): True}


def test_other_dbc_hash_is_reported_until_it_changes(nodes: Nodes):
    nodes.hear(nodes.frame("IMU_TORSO", DbcHash=NETWORK.hash32 ^ 1))
    assert nodes.heartbeats.quiet is False
    assert nodes.judge() == {("DBC_MISMATCH", "IMU_TORSO"): True}
    assert nodes.heartbeats.missing() == set(NODES)
    assert nodes.memory.events[0].value == NETWORK.hash32 ^ 1
    nodes.now += 1
    assert nodes.judge() == {("DBC_MISMATCH", "IMU_TORSO"): True}  # until the node sends another status
    assert nodes.heartbeats.quiet is False


@pytest.mark.parametrize("node", ["LEFT_SK", "HAPTICS", "PENDANT"])
def test_heartbeat_is_lost_exactly_at_its_timeout(well: Nodes, node: str):
    others = [n for n in [*NODES, "PENDANT"] if n != node]
    well.hear(*[well.frame(n) for n in others], cycle=150)
    well.now = 1 + 249
    assert not well.heartbeats.overdue(well.now)
    assert well.judge() == {}
    well.now = 1 + 250
    assert well.heartbeats.overdue(well.now)
    assert well.judge() == {("HEARTBEAT_LOST", node): True}
    assert well.heartbeats.quiet is False
    assert well.memory.events[0].value == 250
    well.hear(well.frame(node))
    assert not well.heartbeats.overdue(well.now)
    assert well.judge() == {}
    assert well.heartbeats.quiet


def test_no_node_is_known_before_the_first_frame(nodes: Nodes):
    assert nodes.heartbeats.known is False
    assert nodes.heartbeats.quiet is True
    assert nodes.heartbeats.missing() == set(NODES)


@pytest.mark.parametrize("cycle", [0, 1, 10_000])
def test_node_without_any_frame_is_not_overdue(nodes: Nodes, cycle: int):
    assert not nodes.heartbeats.overdue(cycle)
    assert nodes.judge() == {}


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
def test_low_supply_of_a_drive_is_reported(well: Nodes, volts: float, code: str | None):
    well.hear(well.frame("LEFT_SK", SupplyVoltage=volts))
    assert well.heartbeats.quiet is (code is None)
    assert well.judge() == ({(code, "LEFT_SK"): True} if code else {})
    assert well.heartbeats.quiet is (code is None)
    assert not code or well.memory.events[0].value == pytest.approx(volts)


@pytest.mark.parametrize("node", ["PENDANT", "IMU_TORSO", "FOOT_LEFT", "HAPTICS"])
def test_low_supply_of_another_node_is_ignored(well: Nodes, node: str):
    well.hear(well.frame(node, SupplyVoltage=0.0))
    assert well.heartbeats.quiet
    assert well.judge() == {}


def test_emergency_lasts_until_the_node_clears_it(well: Nodes):
    well.hear(well.frame("LEFT_SK", "EMCY", ErrorCode=0x4310))
    assert well.heartbeats.quiet is False
    for _ in range(3):
        assert well.judge() == {("OVER_TEMP", "LEFT_SK"): True}
        assert well.heartbeats.quiet is False
        well.now += 1
    assert well.memory.events[0].text == "LEFT_SK: a drive is too hot to hold its position (emergency 0x4310)"
    assert well.memory.events[0].value == 0x4310
    well.hear(well.frame("LEFT_SK", "EMCY", ErrorCode=0))
    assert well.judge() == {}
    assert well.heartbeats.quiet
    well.hear(well.frame("LEFT_SA", "EMCY", ErrorCode=0))
    assert well.judge() == {}


def test_several_emergencies_in_one_cycle_are_all_reported(well: Nodes):
    well.hear(
        well.frame("LEFT_SK", "EMCY", ErrorCode=0x8110),
        well.frame("LEFT_SA", "EMCY", ErrorCode=0x2310),
        well.frame("LEFT_SK", "EMCY", ErrorCode=0x8250),
    )
    assert well.judge() == {
        ("CMD_SOME_LOST", "LEFT_SK"): False,
        ("CMD_TIMEOUT", "LEFT_SK"): True,
        ("EMCY_2xxx", "LEFT_SA"): True,
    }
    well.now += 1
    assert well.judge() == {("CMD_TIMEOUT", "LEFT_SK"): True, ("EMCY_2xxx", "LEFT_SA"): True}
    assert [(e.code, e.value) for e in well.memory.events] == [
        ("CMD_SOME_LOST", 0x8110),
        ("EMCY_2310", 0x2310),
        ("CMD_TIMEOUT", 0x8250),
    ]


def test_acknowledge_keeps_emergencies_of_faulty_drives(well: Nodes):
    for node in ("LEFT_SK", "LEFT_SA"):
        well.hear(well.frame(node, "EMCY", ErrorCode=0x4310))
    well.heartbeats.acknowledge({"LEFT_SA"})
    assert well.heartbeats.emergencies == {"LEFT_SA": (Dtc.OVER_TEMP, 0x4310)}
    assert well.judge() == {("OVER_TEMP", "LEFT_SA"): True}


def test_received_amplitudes_are_written_to_the_state(well: Nodes):
    level = well.tx.codec.slice("Amplitude")
    well.tx.values[level] = 0.5
    well.hear(well.frame("LEFT_SK"))
    assert not well.vibration.any()
    row = well.tx.codec.rows["HAPTICS_STATE"]
    assert well.hear(well.tx.seal_row(row).copy()) == []
    assert (well.vibration == 0.5).all()
    well.tx.values[level] = 0.75
    well.tx.seal_row(row)  # is lost
    assert well.hear(well.tx.seal_row(row).copy()) == []
    assert (well.vibration == 0.75).all()
    well.tx.values[level] = 1.0
    damaged = well.tx.seal_row(row).copy()
    damaged["data"][0, 9] ^= 1
    well.hear(damaged)
    assert (well.vibration == 0.75).all()
    assert well.heartbeats.quiet is False


def damaged(frame: Frames) -> Frames:
    frame["data"][0, 6] ^= 1
    return frame


def shortened(frame: Frames) -> Frames:
    frame["len"] = 12
    return frame


def test_rejected_frames_are_reported_and_not_used(well: Nodes):
    repeated = well.frame("FOOT_LEFT")
    out_of_range = well.frame("IMU_TORSO", SupplyVoltage=np.nan)
    well.hear(
        damaged(well.frame("LEFT_SK", NodeState=0)),
        shortened(well.frame("LEFT_SA", NodeState=0)),
        repeated,
        repeated,
        out_of_range,
    )
    assert well.heartbeats.quiet is False
    assert well.judge() == {
        ("E2E_CRC", "LEFT_SK"): False,
        ("FRAME_LENGTH", "LEFT_SA"): False,
        ("E2E_REPEATED", "FOOT_LEFT"): False,
        ("SIGNAL_RANGE", "IMU_TORSO"): False,
    }
    well.now += 1
    assert well.judge() == {}


def test_unknown_frames_are_returned(well: Nodes):
    stranger = new_frames(1)
    stranger["can_id"] = 0x7FF
    assert well.hear(stranger, well.frame("LEFT_SK"), stranger) == [0, 2]
    assert well.heartbeats.quiet
    cyclic = TransmitImage([NETWORK.message("LEFT_SK_STATE")]).seal()
    assert well.hear(cyclic) == [0]  # that is the fast image's


def test_restarted_sender_with_the_last_counter_is_accepted_and_reported(well: Nodes):
    row = well.tx.codec.rows["LEFT_SK_STATUS"]
    well.tx.resume(row, int(well.tx.frames["data"][row, 2]) - 1 & 0xFF)
    well.hear(well.frame("LEFT_SK", Uptime=9.0))
    assert well.heartbeats.quiet is False
    assert well.heartbeats.image.values[well.heartbeats.image.codec.index("LEFT_SK_STATUS", "Uptime")] == 9.0
    assert well.judge() == {("NODE_DUPLICATE", "LEFT_SK"): False}
    assert well.heartbeats.quiet


def test_emergency_with_the_last_counter_is_accepted(well: Nodes):
    row = well.tx.codec.rows["LEFT_SK_EMCY"]
    well.hear(well.frame("LEFT_SK", "EMCY", ErrorCode=0x7305))
    well.tx.resume(row, int(well.tx.frames["data"][row, 2]) - 1 & 0xFF)
    well.hear(well.frame("LEFT_SK", "EMCY", ErrorCode=0x4310))
    assert well.heartbeats.emergencies == {"LEFT_SK": (Dtc.OVER_TEMP, 0x4310)}


def test_two_senders_are_confirmed_at_the_fifth_conflict(well: Nodes):
    row = well.tx.codec.rows["HAPTICS_STATE"]
    for pair in range(1, 7):
        true = well.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=0.25)
        well.tx.resume(row, int(true["data"][0, 2]) - 1 & 0xFF)
        well.hear(true, well.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=0.5))
        assert not well.heartbeats.quiet
        assert well.judge() == {("NODE_DUPLICATE", "HAPTICS"): pair > 4}
        assert well.heartbeats.quiet is (pair <= 4)
    entry = well.memory.active[Dtc.NODE_DUPLICATE, "HAPTICS"]
    assert entry.value == FULL
    assert entry.text == "HAPTICS: two senders of one message, HAPTICS_STATE: switch one of them off"
    well.hear(well.frame("HAPTICS", "STATE"))
    assert well.judge() == {}
    assert well.heartbeats.quiet


def test_two_senders_are_confirmed_beside_damaged_frames_of_another_node(well: Nodes):
    row = well.tx.codec.rows["HAPTICS_STATE"]
    for pair in range(1, 6):
        damaged = well.frame("LEFT_SK")
        damaged["data"][0, 5] ^= 1
        true = well.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=0.25)
        well.tx.resume(row, int(true["data"][0, 2]) - 1 & 0xFF)
        well.hear(damaged, true, well.frame("HAPTICS", "STATE", LeftThighFront_Amplitude=0.5))
        assert well.judge()["NODE_DUPLICATE", "HAPTICS"] is (pair > 4)


def test_one_sender_leaves_no_evidence_of_a_second(well: Nodes):
    well.hear(well.frame("LEFT_SK"), well.frame("HAPTICS", "STATE"))  # the first frame of HAPTICS_STATE
    assert well.heartbeats.quiet is True


def test_booted_node_is_listed(well: Nodes):
    well.hear(well.frame("LEFT_SK"))
    assert well.heartbeats.booted == set()
    well.hear(well.frame("LEFT_SK", NodeState=BOOT_UP))
    well.judge()
    assert well.heartbeats.booted == {"LEFT_SK"}


def test_emergency_explains_a_fault_until_it_is_cleared(well: Nodes):
    assert not well.heartbeats.explains_fault("LEFT_SK")
    well.hear(well.frame("LEFT_SK", "EMCY", ErrorCode=0x7305))
    well.judge()
    assert well.heartbeats.explains_fault("LEFT_SK")
    assert not well.heartbeats.explains_fault("LEFT_SA")
    well.hear(well.frame("LEFT_SK", "EMCY", ErrorCode=0))
    well.judge()
    assert well.heartbeats.explains_fault("LEFT_SK")
    well.now += 1
    well.judge()
    assert not well.heartbeats.explains_fault("LEFT_SK")
    well.hear(well.frame("LEFT_SK", "EMCY", ErrorCode=0))
    assert not well.heartbeats.explains_fault("LEFT_SK"), "no emergency was active"
