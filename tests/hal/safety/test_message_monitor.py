"""Message monitor: trust, age and diagnostics of each message."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from atalante_dbc import load
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.safety.message_monitor import MessageMonitor, rivals_of
from atalante_hal.wire.e2e import COUNTER_BYTE, SETTLED, Check, crc, data_id_bytes
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

NETWORK = load()
MESSAGES = [
    NETWORK.message(name)
    for name in ("LEFT_SK_STATE", "RIGHT_SK_STATE", "IMU_PELVIS_STATE", "FOOT_LEFT_STATE", "PENDANT_STATE")
]
KNEE, OTHER_KNEE, IMU, FOOT, PENDANT = range(5)
Change = Callable[[Frames], Frames]


class MonitorBench:
    """Simulated nodes and the message monitor; the frames of a cycle may be lost, changed or delayed."""

    def __init__(self) -> None:
        self.tx, self.image = TransmitImage(MESSAGES), ReceiveImage(MESSAGES)
        self.message_monitor, self.memory = MessageMonitor(NETWORK, self.image), FaultMemory()
        self.buffer, self.number = new_frames(64), 0
        self.swing: int | None = None

    def cycle(self, change: Change = lambda frames: frames, times: int = 1) -> MonitorBench:
        for _ in range(times):
            self.number += 1
            frames = change(self.tx.seal(self.number & 0xFF).copy())
            self.buffer[: len(frames)] = frames
            self.image.accept(self.buffer, len(frames), self.number & 0xFF)
            self.message_monitor.judge(self.number, self.memory, self.swing)
            self.memory.close_cycle(self.number)
        return self

    def well(self) -> MonitorBench:
        return self.cycle(times=16)

    @property
    def active(self) -> dict[tuple[str, str], bool]:
        return {(dtc.value, node): entry.confirmed for (dtc, node), entry in self.memory.active.items()}


@pytest.fixture
def bench() -> MonitorBench:
    return MonitorBench()


def lose(*rows: int) -> Change:
    return lambda frames: np.delete(frames, rows)


def flip(row: int) -> Change:
    def change(frames: Frames) -> Frames:
        frames["data"][row, 5] ^= 1
        return frames

    return change


def test_sender_is_trusted_after_16_good_cycles(bench: MonitorBench):
    assert not bench.cycle(times=15).message_monitor.nodes_well
    assert not bench.message_monitor.valid.any()
    assert bench.message_monitor.missing() == {"LEFT_SK", "RIGHT_SK", "IMU_PELVIS", "FOOT_LEFT"}
    assert not bench.message_monitor.settled
    bench.cycle()
    assert bench.message_monitor.nodes_well
    assert bench.message_monitor.trusts(KNEE)
    assert bench.message_monitor.valid.all()
    assert bench.message_monitor.joints_valid
    assert bench.message_monitor.missing() == set()
    assert bench.message_monitor.settled
    assert bench.active == {}


def test_node_without_any_frame_has_no_timeout(bench: MonitorBench):
    bench.cycle(lose(IMU), times=40)
    assert bench.active == {}
    assert not bench.message_monitor.nodes_well
    assert bench.message_monitor.missing() == {"IMU_PELVIS"}
    assert bench.message_monitor.joints_valid


@pytest.mark.parametrize(
    ("row", "node", "timeout"), [(KNEE, "LEFT_SK", 5), (IMU, "IMU_PELVIS", 10), (FOOT, "FOOT_LEFT", 10)]
)
def test_silent_node_times_out_exactly_at_its_timeout(bench: MonitorBench, row: int, node: str, timeout: int):
    bench.well().cycle(lose(row), times=timeout - 1)
    assert bench.active == {}
    assert bench.message_monitor.nodes_well
    assert not bench.message_monitor.valid[row]
    assert bench.message_monitor.joints_valid is (row != KNEE)
    bench.cycle(lose(row))
    assert bench.active == {("NODE_TIMEOUT", node): True}
    assert not bench.message_monitor.nodes_well
    event = bench.memory.events[-1]
    assert (event.code, event.node, event.value, event.cycle) == ("NODE_TIMEOUT", node, timeout, 16 + timeout)
    assert event.text == f"{node}: a node timed out; its data is {timeout} cycles old"


def test_first_frame_after_lost_frames_is_used_and_reported(bench: MonitorBench):
    bench.well().cycle(lose(KNEE), times=4).cycle()
    assert bench.active == {("E2E_SOME_LOST", "LEFT_SK"): False}
    assert bench.message_monitor.valid.all()
    assert not bench.message_monitor.settled
    bench.cycle()
    assert bench.active == {}
    assert not bench.message_monitor.settled
    bench.cycle(times=14)
    assert bench.message_monitor.settled


def test_node_is_trusted_16_good_cycles_after_a_timeout(bench: MonitorBench):
    bench.well().cycle(lose(KNEE), times=5).cycle()
    assert bench.active == {("E2E_SEQUENCE", "LEFT_SK"): True}  # more than four are missing
    bench.cycle(times=15)
    assert not bench.message_monitor.nodes_well
    assert not bench.message_monitor.valid[KNEE]
    assert bench.message_monitor.valid[OTHER_KNEE]
    bench.cycle(times=2)
    assert bench.message_monitor.nodes_well


def repeat(frames: Frames) -> Frames:
    return np.concatenate([frames, frames[[KNEE]]])


def test_repeated_frame_is_reported_and_not_committed(bench: MonitorBench):
    bench.well().cycle(repeat)
    assert bench.active == {("E2E_REPEATED", "LEFT_SK"): False}
    assert bench.image.age[KNEE] == 0
    assert bench.message_monitor.valid.all()


def frozen(bench: MonitorBench) -> Change:
    last = bench.tx.frames[[KNEE]].copy()

    def change(frames: Frames) -> Frames:
        frames[[KNEE]] = last
        return frames

    return change


def test_constant_counter_is_confirmed_after_the_timeout(bench: MonitorBench):
    bench.well()
    stuck = frozen(bench)
    bench.cycle(stuck, times=4)
    assert bench.active == {("E2E_REPEATED", "LEFT_SK"): False}
    bench.cycle(stuck)
    assert bench.active == {("E2E_REPEATED", "LEFT_SK"): False, ("E2E_FROZEN", "LEFT_SK"): True}


def test_crc_error_is_pending_until_the_data_times_out(bench: MonitorBench):
    bench.well().cycle(flip(KNEE), times=4)
    assert bench.active == {("E2E_CRC", "LEFT_SK"): False}
    bench.cycle(flip(KNEE))
    assert bench.active == {("E2E_CRC", "LEFT_SK"): True}


def test_wrong_length_is_pending_until_the_data_times_out(bench: MonitorBench):
    def shorten(frames: Frames) -> Frames:
        frames["len"][KNEE] = 8
        return frames

    bench.well().cycle(shorten, times=4)
    assert bench.active == {("FRAME_LENGTH", "LEFT_SK"): False}
    bench.cycle(shorten)
    assert bench.active == {("FRAME_LENGTH", "LEFT_SK"): True}


@pytest.mark.parametrize(
    ("row", "message", "signal", "value", "code"),
    [
        (KNEE, "LEFT_SK_STATE", "Torque", np.nan, "SIGNAL_RANGE"),
        (IMU, "IMU_PELVIS_STATE", "GyroX", np.nan, "IMU_INVALID"),
    ],
)
def test_invalid_code_is_reported_as_range_or_imu_fault(row, message, signal, value, code):
    bench = MonitorBench()
    bench.well()
    bench.tx.values[bench.tx.codec.index(message, signal)] = value
    timeout, node = MESSAGES[row].timeout_ms, MESSAGES[row].sender
    bench.cycle(times=timeout - 1)
    assert bench.active == {(code, node): False}
    assert not bench.message_monitor.valid[row]
    bench.cycle()
    assert bench.active == {(code, node): True}


def test_invalid_values_do_not_fill_the_leaky_bucket(bench: MonitorBench):
    bench.well()
    place = bench.tx.codec.index("IMU_PELVIS_STATE", "GyroX")
    for _ in range(20):  # two of three frames are invalid
        bench.tx.values[place] = np.nan
        bench.cycle(times=2)
        bench.tx.values[place] = 0.0
        bench.cycle()
    assert not any(event.code == "E2E_LOSS_RATE" for event in bench.memory.events)
    assert bench.message_monitor.nodes_well


def late(bench: MonitorBench, row: int, by: int) -> Change:
    """Delay the frame of one node by `by` cycles."""
    waiting: list[Frames] = []

    def change(frames: Frames) -> Frames:
        waiting.append(frames[[row]].copy())
        kept = np.delete(frames, row)
        return np.concatenate([kept, waiting.pop(0)]) if len(waiting) > by else kept

    return change


@pytest.mark.parametrize("by", [1, 2, 3, 4])
def test_late_answer_is_used_with_its_age(bench: MonitorBench, by: int):
    bench.well().cycle(late(bench, KNEE, by), times=40)
    assert bench.active == {("NODE_LATE", "LEFT_SK"): False}
    assert bench.memory.active[Dtc.NODE_LATE, "LEFT_SK"].value == by
    assert bench.image.age[KNEE] == by
    assert bench.message_monitor.valid[KNEE]
    assert bench.message_monitor.nodes_well


@pytest.mark.parametrize("by", [5, 6])
def test_answer_later_than_the_timeout_counts_as_silence(bench: MonitorBench, by: int):
    bench.well().cycle(late(bench, KNEE, by), times=5)
    assert bench.active == {("NODE_TIMEOUT", "LEFT_SK"): True}
    bench.cycle(times=0)
    change = late(bench, KNEE, by)
    bench.well()
    for _ in range(3):
        bench.cycle(change, times=10)
    assert bench.memory.active[Dtc.NODE_LATE, "LEFT_SK"].confirmed
    assert bench.memory.active[Dtc.NODE_LATE, "LEFT_SK"].value == by
    assert not bench.message_monitor.nodes_well


def test_steady_loss_trips_the_leaky_bucket_of_each_sender(bench: MonitorBench):
    bench.well()
    loss = lose(KNEE, PENDANT)
    for _ in range(5):
        bench.cycle(loss, times=3).cycle()  # fills the bucket to 55
    bench.cycle(loss, times=2)
    assert bench.message_monitor.trusts(KNEE)
    bench.cycle(loss)
    assert bench.active == {("E2E_LOSS_RATE", "LEFT_SK"): True}
    assert bench.memory.active[Dtc.E2E_LOSS_RATE, "LEFT_SK"].value == 64
    assert not bench.message_monitor.nodes_well
    assert not bench.message_monitor.trusts(PENDANT)


def test_lost_pendant_is_not_reported_as_a_lost_node(bench: MonitorBench):
    bench.well().cycle(lose(PENDANT), times=20)
    assert bench.active == {}
    assert bench.message_monitor.nodes_well
    assert not bench.message_monitor.trusts(PENDANT)


def test_implausible_row_is_invalid_without_another_diagnostic(bench: MonitorBench):
    bench.well()
    for age in range(1, 7):
        bench.number += 1
        frames = bench.tx.seal(bench.number & 0xFF)
        bench.buffer[: len(frames)] = frames
        bench.image.accept(bench.buffer, len(frames), bench.number & 0xFF)
        bench.image.refuse(KNEE)
        bench.message_monitor.judge(bench.number, bench.memory)
        bench.memory.close_cycle(bench.number)
        assert bench.image.check[KNEE] == Check.IMPLAUSIBLE
        assert bench.image.age[KNEE] == age
        assert not bench.message_monitor.valid[KNEE]
        assert bench.message_monitor.trusts(KNEE) is (age < 5)
    assert bench.active == {}


def test_replayed_frame_is_rejected_and_the_next_frame_accepted(bench: MonitorBench):
    bench.well()
    old = bench.tx.frames[[KNEE]].copy()
    bench.cycle(times=30)
    bench.cycle(lambda frames: np.concatenate([old, frames]))
    assert bench.active == {("E2E_SEQUENCE", "LEFT_SK"): False}
    assert bench.message_monitor.valid[KNEE]
    assert old["data"][0, COUNTER_BYTE] == 16


def test_rejected_first_frame_is_reported_with_age_zero(bench: MonitorBench):
    bench.cycle(flip(KNEE))
    assert bench.memory.events[0].value == 0
    bench.well().cycle(flip(KNEE), times=2)
    assert bench.memory.active[Dtc.E2E_CRC, "LEFT_SK"].value == 2


def test_no_row_is_valid_before_the_first_cycle(bench: MonitorBench) -> None:
    message_monitor = bench.message_monitor
    assert message_monitor.valid.tolist() == [False] * len(MESSAGES)
    assert message_monitor.valid.dtype == np.bool_
    assert message_monitor.joints_valid is False
    assert message_monitor.settled is False
    assert not message_monitor.nodes_well
    assert not any(message_monitor.trusts(row) for row in range(len(MESSAGES)))


def test_value_out_of_range_does_not_affect_trust(bench: MonitorBench) -> None:
    drive_state = MESSAGES[KNEE].signal("DriveState")

    def impossible(frames: Frames) -> Frames:
        data = frames[KNEE]["data"]
        data[drive_state.start // 8] = 65  # one more than the largest
        protected = data[2 : MESSAGES[KNEE].length].tobytes()
        data[:2] = list(crc(protected, data_id_bytes(MESSAGES[KNEE].data_id)).to_bytes(2, "little"))
        return frames

    bench.well()
    for _ in range(20):
        bench.cycle(impossible)
        assert bench.image.check[KNEE] == Check.RANGE
        assert bench.message_monitor.qualification[KNEE] is SETTLED
        bench.cycle()


def test_late_frame_after_a_loss_is_reported_with_its_age(bench: MonitorBench) -> None:
    bench.well()
    bench.cycle(lose(KNEE))
    kept: list[Frames] = []

    def keep(frames: Frames) -> Frames:
        kept.append(frames[KNEE : KNEE + 1].copy())
        return np.delete(frames, KNEE)

    bench.cycle(keep)
    bench.cycle(lambda frames: np.concatenate([kept[0], np.delete(frames, KNEE)]))
    assert bench.image.check[KNEE] == Check.SOME_LOST
    assert bench.memory.active[Dtc.E2E_SOME_LOST, "LEFT_SK"].value == 1


class TestSwingLeg:
    """The robot stands on its right leg."""

    @pytest.fixture
    def bench(self) -> MonitorBench:
        bench = MonitorBench().well()
        bench.swing = 0
        return bench

    def test_timeout_of_a_swing_joint_lets_the_step_finish(self, bench: MonitorBench):
        bench.cycle(lose(KNEE), times=4)
        assert bench.active == {}
        for _ in range(5):
            bench.cycle(lose(KNEE))
            assert bench.active == {("SWING_TIMEOUT", "LEFT_SK"): True, ("NODE_TIMEOUT", "LEFT_SK"): False}
            assert {entry.value for entry in bench.memory.active.values()} == {bench.image.age[KNEE]}
        assert bench.cycle(lose(KNEE)).active == {("NODE_TIMEOUT", "LEFT_SK"): True}

    def test_timeout_of_a_stance_joint_is_confirmed_immediately(self, bench: MonitorBench):
        assert bench.cycle(lose(OTHER_KNEE), times=5).active == {("NODE_TIMEOUT", "RIGHT_SK"): True}

    def test_timeout_in_double_stance_is_confirmed_immediately(self, bench: MonitorBench):
        bench.swing = None
        assert bench.cycle(lose(KNEE), times=5).active == {("NODE_TIMEOUT", "LEFT_SK"): True}

    def test_timeout_of_imu_and_foot_is_confirmed_immediately(self, bench: MonitorBench):
        assert bench.cycle(lose(IMU, FOOT), times=10).active == {
            ("NODE_TIMEOUT", "IMU_PELVIS"): True,
            ("NODE_TIMEOUT", "FOOT_LEFT"): True,
        }

    def test_second_frame_after_five_lost_frames_is_accepted(self, bench: MonitorBench):
        bench.cycle(lose(KNEE), times=5)
        assert bench.cycle().active == {("SWING_TIMEOUT", "LEFT_SK"): True, ("E2E_SEQUENCE", "LEFT_SK"): False}
        assert bench.cycle().active == {}


class TestTwoSenders:
    """A second sender of a message; each of its frames is valid."""

    @staticmethod
    def rival(row: int, *, first: bool = False, ahead: int = 0) -> Change:
        """Add a second frame of a row, with a changed bit in its last byte and its counter increased by `ahead`."""

        def change(frames: Frames) -> Frames:
            message, other = MESSAGES[row], frames[[row]].copy()
            data = other["data"][0]
            data[message.length - 1] ^= 1
            data[COUNTER_BYTE] = (int(data[COUNTER_BYTE]) + ahead) & 0xFF
            protected = data[2 : message.length].tobytes()
            data[:2] = list(crc(protected, data_id_bytes(message.data_id)).to_bytes(2, "little"))
            return np.concatenate([other, frames] if first else [frames, other])

        return change

    @pytest.mark.parametrize("first", [False, True])
    @pytest.mark.parametrize("row", range(len(MESSAGES)))
    def test_two_senders_are_confirmed_in_the_fourth_cycle(self, bench: MonitorBench, row: int, first: bool):
        node = MESSAGES[row].sender
        bench.well().cycle(self.rival(row, first=first), times=3)
        assert bench.active == {("NODE_DUPLICATE", node): False}
        assert bench.message_monitor.trusts(row)
        assert bench.message_monitor.valid[row]
        assert not bench.message_monitor.settled
        bench.cycle(self.rival(row, first=first))
        assert bench.active == {("NODE_DUPLICATE", node): True}
        assert bench.memory.active[Dtc.NODE_DUPLICATE, node].value == 64
        assert not bench.message_monitor.trusts(row)
        text = f"{node}: two senders of one message, {MESSAGES[row].name}: switch one of them off"
        assert bench.memory.events[-1].text == text
        bench.cycle(self.rival(row, first=first), times=100)
        assert bench.active == {("NODE_DUPLICATE", node): True}
        assert not bench.message_monitor.trusts(row)
        told = [event for event in bench.memory.events if event.code == "NODE_DUPLICATE"]
        assert [event.severity for event in told] == ["warning", "error"]

    def test_trust_returns_after_16_clean_cycles_until_another_second_sender(self, bench: MonitorBench):
        bench.well().cycle(self.rival(KNEE), times=4).cycle(times=15)
        assert bench.active == {}
        assert not bench.message_monitor.nodes_well
        bench.cycle()
        assert bench.message_monitor.nodes_well
        assert not bench.message_monitor.settled
        bench.cycle(self.rival(KNEE))
        assert bench.active == {("NODE_DUPLICATE", "LEFT_SK"): True}
        bench.cycle(times=63)
        assert not bench.message_monitor.settled
        bench.cycle()
        assert bench.message_monitor.settled

    def test_node_with_two_senders_is_never_trusted(self, bench: MonitorBench):
        bench.cycle()
        for _ in range(10):
            bench.cycle(self.rival(IMU)).cycle(times=5)
        assert bench.message_monitor.missing() == {"IMU_PELVIS"}
        assert any(e.code == "NODE_DUPLICATE" and e.severity == "error" for e in bench.memory.events)

    @pytest.mark.parametrize("ahead", [-2, 2, 30])
    def test_second_sender_with_another_counter_is_found(self, bench: MonitorBench, ahead: int):
        bench.well().cycle(self.rival(KNEE, ahead=ahead), times=3)
        assert bench.active == {("E2E_SEQUENCE", "LEFT_SK"): False}
        bench.cycle(self.rival(KNEE, ahead=ahead))
        assert bench.active == {("E2E_SEQUENCE", "LEFT_SK"): False, ("NODE_DUPLICATE", "LEFT_SK"): True}

    def test_crc_error_beside_a_second_sender_is_reported(self, bench: MonitorBench):
        def change(frames: Frames) -> Frames:
            frames = self.rival(KNEE, first=True)(frames)
            frames["data"][1 + IMU, 5] ^= 1
            return frames

        bench.well().cycle(change)
        assert bench.active == {("NODE_DUPLICATE", "LEFT_SK"): False, ("E2E_CRC", MESSAGES[IMU].sender): False}

    def test_conflict_beside_an_accepted_frame_is_a_second_sender(self):
        assert rivals_of([(1, Check.CONFLICT)], [Check.OK, Check.SOME_LOST]) == {1}
        assert rivals_of([(1, Check.CONFLICT)], [Check.OK, Check.CONFLICT]) == set()

    def test_second_sender_beside_a_value_out_of_range_is_found(self, bench: MonitorBench):
        bench.well()
        bench.tx.values[bench.tx.codec.index("LEFT_SK_STATE", "Torque")] = np.nan
        bench.cycle(self.rival(KNEE), times=4)
        assert bench.active["NODE_DUPLICATE", "LEFT_SK"]

    def test_constant_counter_with_changing_data_is_one_sender(self, bench: MonitorBench):
        bench.well()
        last = bench.tx.frames[[KNEE]].copy()
        changed = self.rival(0)

        def stuck(frames: Frames) -> Frames:
            frames[[KNEE]] = changed(last)[1:]
            return frames

        bench.cycle(stuck, times=4)
        assert bench.image.check[KNEE] == Check.CONFLICT
        assert bench.active == {("E2E_REPEATED", "LEFT_SK"): False}
        bench.cycle(stuck)
        assert bench.active == {("E2E_REPEATED", "LEFT_SK"): False, ("E2E_FROZEN", "LEFT_SK"): True}

    def test_sender_counts_as_heard_until_its_timeout(self, bench: MonitorBench):
        assert not bench.message_monitor.hears(PENDANT)
        bench.cycle()
        assert bench.message_monitor.hears(PENDANT)
        bench.cycle(lose(PENDANT), times=4)
        assert bench.message_monitor.hears(PENDANT)
        bench.cycle(lose(PENDANT))
        assert not bench.message_monitor.hears(PENDANT)
