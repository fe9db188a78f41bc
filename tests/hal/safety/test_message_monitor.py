"""Message monitor: trust, age and diagnostics of each message."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from atalante_dbc import load
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.safety.message_monitor import GROUND_TOLERANCE, NO_TOLERANCE, MessageMonitor, Tolerance, rivals_of
from atalante_hal.wire.e2e import COUNTER_BYTE, SETTLED, Check, crc, data_id_bytes
from atalante_hal.wire.frame import FLAG_ESI, Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

NETWORK = load()
MESSAGES = [
    NETWORK.message(name)
    for name in ("LEFT_SK_STATE", "RIGHT_SK_STATE", "IMU_PELVIS_STATE", "FOOT_LEFT_STATE", "PENDANT_STATE")
]
KNEE, OTHER_KNEE, IMU, FOOT, PENDANT = range(5)
Change = Callable[[Frames], Frames]


class MonitorBench:
    """Simulated nodes and the message monitor. A test can lose, change or delay the frames of a cycle."""

    def __init__(self) -> None:
        self.tx, self.image = TransmitImage(MESSAGES), ReceiveImage(MESSAGES)
        self.message_monitor, self.memory = MessageMonitor(NETWORK, self.image), FaultMemory()
        self.buffer, self.number = new_frames(64), 0
        self.tolerance = NO_TOLERANCE

    def cycle(self, change: Change = lambda frames: frames, times: int = 1) -> MonitorBench:
        for _ in range(times):
            self.number += 1
            frames = change(self.tx.seal(self.number & 0xFF).copy())
            self.buffer[: len(frames)] = frames
            self.image.accept(self.buffer, len(frames), self.number & 0xFF)
            self.message_monitor.evaluate(self.number, self.memory, self.tolerance)
            self.memory.close_cycle(self.number)
        return self

    def trust_all(self) -> MonitorBench:
        return self.cycle(times=16)

    @property
    def active(self) -> dict[tuple[str, str], bool]:
        return {(dtc.value, node): entry.confirmed for (dtc, node), entry in self.memory.active.items()}


@pytest.fixture
def bench() -> MonitorBench:
    return MonitorBench()


def undisturbed(frames: Frames) -> Frames:
    return frames


def lose(*rows: int) -> Change:
    return lambda frames: np.delete(frames, rows)


def flip(row: int) -> Change:
    def change(frames: Frames) -> Frames:
        frames["data"][row, 5] ^= 1
        return frames

    return change


def test_sender_is_trusted_after_16_good_cycles(bench: MonitorBench):
    assert not bench.cycle(times=15).message_monitor.nodes_ready
    assert not bench.message_monitor.valid.any()
    assert bench.message_monitor.missing() == {"LEFT_SK", "RIGHT_SK", "IMU_PELVIS", "FOOT_LEFT"}
    assert not bench.message_monitor.settled
    bench.cycle()
    assert bench.message_monitor.nodes_ready
    assert bench.message_monitor.is_trusted(KNEE)
    assert bench.message_monitor.valid.all()
    assert bench.message_monitor.joints_valid
    assert bench.message_monitor.missing() == set()
    assert bench.message_monitor.settled
    assert bench.active == {}


def test_node_without_any_frame_has_no_timeout(bench: MonitorBench):
    bench.cycle(lose(IMU), times=40)
    assert bench.active == {}
    assert not bench.message_monitor.nodes_ready
    assert bench.message_monitor.missing() == {"IMU_PELVIS"}
    assert bench.message_monitor.joints_valid


@pytest.mark.parametrize(
    ("row", "node", "timeout"), [(KNEE, "LEFT_SK", 5), (IMU, "IMU_PELVIS", 10), (FOOT, "FOOT_LEFT", 10)]
)
def test_silent_node_times_out_exactly_at_its_timeout(bench: MonitorBench, row: int, node: str, timeout: int):
    bench.trust_all().cycle(lose(row), times=timeout - 1)
    assert bench.active == {}
    assert bench.message_monitor.nodes_ready
    assert not bench.message_monitor.valid[row]
    assert bench.message_monitor.joints_valid is (row != KNEE)
    bench.cycle(lose(row))
    assert bench.active == {("NODE_TIMEOUT", node): True}
    assert not bench.message_monitor.nodes_ready
    event = bench.memory.events[-1]
    assert (event.code, event.node, event.value, event.cycle) == ("NODE_TIMEOUT", node, timeout, 16 + timeout)
    assert event.text == f"{node}: a node timed out; its data is {timeout} cycles old"


def test_first_frame_after_lost_frames_is_used_and_reported(bench: MonitorBench):
    bench.trust_all().cycle(lose(KNEE), times=4).cycle()
    assert bench.active == {("E2E_SOME_LOST", "LEFT_SK"): False}
    assert bench.message_monitor.valid.all()
    assert not bench.message_monitor.settled
    bench.cycle()
    assert bench.active == {}
    assert not bench.message_monitor.settled
    bench.cycle(times=14)
    assert bench.message_monitor.settled


def test_node_is_trusted_16_good_cycles_after_a_timeout(bench: MonitorBench):
    bench.trust_all().cycle(lose(KNEE), times=5).cycle()
    assert bench.active == {("E2E_SEQUENCE", "LEFT_SK"): True}  # more than four frames were lost
    bench.cycle(times=15)
    assert not bench.message_monitor.nodes_ready
    assert not bench.message_monitor.valid[KNEE]
    assert bench.message_monitor.valid[OTHER_KNEE]
    bench.cycle(times=2)
    assert bench.message_monitor.nodes_ready


def repeat(frames: Frames) -> Frames:
    return np.concatenate([frames, frames[[KNEE]]])


def test_repeated_frame_is_reported_and_not_committed(bench: MonitorBench):
    bench.trust_all().cycle(repeat)
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
    bench.trust_all()
    stuck = frozen(bench)
    bench.cycle(stuck, times=4)
    assert bench.active == {("E2E_REPEATED", "LEFT_SK"): False}
    bench.cycle(stuck)
    assert bench.active == {("E2E_REPEATED", "LEFT_SK"): False, ("E2E_FROZEN", "LEFT_SK"): True}


def test_crc_error_is_pending_until_the_data_times_out(bench: MonitorBench):
    bench.trust_all().cycle(flip(KNEE), times=4)
    assert bench.active == {("E2E_CRC", "LEFT_SK"): False}
    bench.cycle(flip(KNEE))
    assert bench.active == {("E2E_CRC", "LEFT_SK"): True}


def test_wrong_length_is_pending_until_the_data_times_out(bench: MonitorBench):
    def shorten(frames: Frames) -> Frames:
        frames["len"][KNEE] = 8
        return frames

    bench.trust_all().cycle(shorten, times=4)
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
    bench.trust_all()
    bench.tx.values[bench.tx.codec.index(message, signal)] = value
    timeout, node = MESSAGES[row].timeout_ms, MESSAGES[row].sender
    bench.cycle(times=timeout - 1)
    assert bench.active == {(code, node): False}
    assert not bench.message_monitor.valid[row]
    bench.cycle()
    assert bench.active == {(code, node): True}


def test_invalid_values_do_not_fill_the_leaky_bucket(bench: MonitorBench):
    bench.trust_all()
    gyro = bench.tx.codec.index("IMU_PELVIS_STATE", "GyroX")
    for _ in range(20):  # two of three frames are invalid
        bench.tx.values[gyro] = np.nan
        bench.cycle(times=2)
        bench.tx.values[gyro] = 0.0
        bench.cycle()
    assert not any(event.code == "E2E_LOSS_RATE" for event in bench.memory.events)
    assert bench.message_monitor.nodes_ready


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
    bench.trust_all().cycle(late(bench, KNEE, by), times=40)
    assert bench.active == {("NODE_LATE", "LEFT_SK"): False}
    assert bench.memory.active[Dtc.NODE_LATE, "LEFT_SK"].value == by
    assert bench.image.age[KNEE] == by
    assert bench.message_monitor.valid[KNEE]
    assert bench.message_monitor.nodes_ready


@pytest.mark.parametrize("by", [5, 6])
def test_answer_later_than_the_timeout_is_reported_as_timeout(bench: MonitorBench, by: int):
    bench.trust_all().cycle(late(bench, KNEE, by), times=5)
    assert bench.active == {("NODE_TIMEOUT", "LEFT_SK"): True}
    bench.cycle(times=0)
    change = late(bench, KNEE, by)
    bench.trust_all()
    for _ in range(3):
        bench.cycle(change, times=10)
    assert bench.memory.active[Dtc.NODE_LATE, "LEFT_SK"].confirmed
    assert bench.memory.active[Dtc.NODE_LATE, "LEFT_SK"].value == by
    assert not bench.message_monitor.nodes_ready


def test_steady_loss_fills_the_leaky_bucket_of_each_sender(bench: MonitorBench):
    bench.trust_all()
    loss = lose(KNEE, PENDANT)
    for _ in range(5):
        bench.cycle(loss, times=3).cycle()  # fills the bucket to 55
    bench.cycle(loss, times=2)
    assert bench.message_monitor.is_trusted(KNEE)
    bench.cycle(loss)
    assert bench.active == {("E2E_LOSS_RATE", "LEFT_SK"): True}
    assert bench.memory.active[Dtc.E2E_LOSS_RATE, "LEFT_SK"].value == 64
    assert not bench.message_monitor.nodes_ready
    assert not bench.message_monitor.is_trusted(PENDANT)


def test_lost_pendant_is_not_reported_as_a_lost_node(bench: MonitorBench):
    bench.trust_all().cycle(lose(PENDANT), times=20)
    assert bench.active == {}
    assert bench.message_monitor.nodes_ready
    assert not bench.message_monitor.is_trusted(PENDANT)


def test_implausible_row_is_invalid_without_another_diagnostic(bench: MonitorBench):
    bench.trust_all()
    for age in range(1, 7):
        bench.number += 1
        frames = bench.tx.seal(bench.number & 0xFF)
        bench.buffer[: len(frames)] = frames
        bench.image.accept(bench.buffer, len(frames), bench.number & 0xFF)
        bench.image.refuse(KNEE, np.array([bench.image.codec.index("LEFT_SK_STATE", "Position")]))
        bench.message_monitor.evaluate(bench.number, bench.memory)
        bench.memory.close_cycle(bench.number)
        assert bench.image.check[KNEE] == Check.IMPLAUSIBLE
        assert bench.image.age[KNEE] == age
        assert not bench.message_monitor.valid[KNEE]
        assert bench.message_monitor.is_trusted(KNEE) is (age < 5)
    assert bench.active == {}


def test_replayed_frame_is_rejected_and_the_next_frame_accepted(bench: MonitorBench):
    bench.trust_all()
    old = bench.tx.frames[[KNEE]].copy()
    bench.cycle(times=30)
    bench.cycle(lambda frames: np.concatenate([old, frames]))
    assert bench.active == {("E2E_SEQUENCE", "LEFT_SK"): False}
    assert bench.message_monitor.valid[KNEE]
    assert old["data"][0, COUNTER_BYTE] == 16


def test_rejected_first_frame_is_reported_with_age_zero(bench: MonitorBench):
    bench.cycle(flip(KNEE))
    assert bench.memory.events[0].value == 0
    bench.trust_all().cycle(flip(KNEE), times=2)
    assert bench.memory.active[Dtc.E2E_CRC, "LEFT_SK"].value == 2


def test_no_row_is_valid_before_the_first_cycle(bench: MonitorBench) -> None:
    message_monitor = bench.message_monitor
    assert message_monitor.valid.tolist() == [False] * len(MESSAGES)
    assert message_monitor.valid.dtype == np.bool_
    assert message_monitor.joints_valid is False
    assert message_monitor.settled is False
    assert not message_monitor.nodes_ready
    assert not any(message_monitor.is_trusted(row) for row in range(len(MESSAGES)))


def test_value_out_of_range_does_not_affect_trust(bench: MonitorBench) -> None:
    bench.trust_all()
    for _ in range(20):
        bench.cycle(out_of_range)
        assert bench.image.check[KNEE] == Check.RANGE
        assert bench.message_monitor.qualification[KNEE] is SETTLED
        bench.cycle()


def test_late_frame_after_a_loss_is_reported_with_its_age(bench: MonitorBench) -> None:
    bench.trust_all()
    bench.cycle(lose(KNEE))
    kept: list[Frames] = []

    def keep(frames: Frames) -> Frames:
        kept.append(frames[KNEE : KNEE + 1].copy())
        return np.delete(frames, KNEE)

    bench.cycle(keep)
    bench.cycle(lambda frames: np.concatenate([kept[0], np.delete(frames, KNEE)]))
    assert bench.image.check[KNEE] == Check.SOME_LOST
    assert bench.memory.active[Dtc.E2E_SOME_LOST, "LEFT_SK"].value == 1


def out_of_range(frames: Frames) -> Frames:
    drive_state, data = MESSAGES[KNEE].signal("DriveState"), frames[KNEE]["data"]
    data[drive_state.start // 8] = 65  # raw code that is one above the largest valid code
    protected = data[2 : MESSAGES[KNEE].length].tobytes()
    data[:2] = list(crc(protected, data_id_bytes(MESSAGES[KNEE].data_id)).to_bytes(2, "little"))
    return frames


def error_passive(frames: Frames) -> Frames:
    frames["flags"][KNEE] |= FLAG_ESI
    return frames


DISTURBANCES = [
    (repeat, "E2E_REPEATED", "E2E_REPEAT_RATE", "frames of a node are received twice"),
    (out_of_range, "SIGNAL_RANGE", "SIGNAL_RANGE", "a signal is outside its range in the DBC"),
    (error_passive, "NODE_ERROR_PASSIVE", "NODE_ERROR_PASSIVE", "the CAN controller of a node is error passive"),
]
disturbances = pytest.mark.parametrize(
    ("change", "pending", "code", "meaning"), DISTURBANCES, ids=[d[2] for d in DISTURBANCES]
)


@disturbances
def test_disturbance_of_every_second_cycle_is_confirmed(bench: MonitorBench, change, pending, code, meaning):
    bench.trust_all()
    for _ in range(20):
        assert bench.cycle(change).active == {(pending, "LEFT_SK"): False}
        assert bench.cycle().active == {}
        assert not bench.message_monitor.settled
    assert bench.cycle(change).active == {(pending, "LEFT_SK"): False} | {(code, "LEFT_SK"): True}
    entry = bench.memory.active[Dtc(code), "LEFT_SK"]
    assert (entry.value, entry.text) == (64, f"LEFT_SK: {meaning}, more than a fifth of LEFT_SK_STATE")
    for _ in range(15):
        assert bench.cycle().active == {(code, "LEFT_SK"): True}
    assert bench.cycle().active == {}
    assert not bench.message_monitor.settled
    assert bench.cycle(change).active == {(pending, "LEFT_SK"): False}
    for _ in range(51):
        assert not bench.cycle().message_monitor.settled
    assert bench.cycle().message_monitor.settled


@disturbances
def test_disturbance_of_a_fifth_of_the_cycles_is_tolerated(bench: MonitorBench, change, pending, code, meaning):
    bench.trust_all()
    for _ in range(100):
        assert bench.cycle(change).active == {(pending, "LEFT_SK"): False}
        assert bench.cycle(times=4).active == {}
        assert not bench.message_monitor.settled
    bench.cycle(times=11)
    assert not bench.message_monitor.settled
    assert bench.cycle().message_monitor.settled


def test_disturbance_of_an_imu_without_values_is_an_imu_fault(bench: MonitorBench):
    bench.trust_all()
    gyro = bench.tx.codec.index("IMU_PELVIS_STATE", "GyroX")
    for _ in range(21):
        bench.tx.values[gyro] = np.nan
        bench.cycle()
        bench.tx.values[gyro] = 0.0
        assert bench.memory.active[Dtc.IMU_INVALID, "IMU_PELVIS"].confirmed is (bench.number == 16 + 41)
        bench.cycle()
    assert bench.active == {("IMU_INVALID", "IMU_PELVIS"): True}


def test_disturbances_of_two_nodes_are_counted_separately(bench: MonitorBench):
    bench.trust_all()
    gyro = bench.tx.codec.index("IMU_PELVIS_STATE", "GyroX")
    for number in range(40):
        bench.tx.values[gyro] = np.nan if number % 4 == 1 else 0.0
        bench.cycle(repeat if number % 4 == 3 else undisturbed)
    assert not any(entry for entry in bench.active.values())


class TestTolerantLeg:
    """The robot stands on its right leg, so a brief timeout in the left leg is tolerated."""

    @pytest.fixture
    def bench(self) -> MonitorBench:
        bench = MonitorBench().trust_all()
        bench.tolerance = Tolerance((0,))
        return bench

    def test_timeout_of_a_swing_joint_lets_the_step_finish(self, bench: MonitorBench):
        bench.cycle(lose(KNEE), times=4)
        assert bench.active == {}
        for _ in range(5):
            bench.cycle(lose(KNEE))
            assert bench.active == {("JOINT_TIMEOUT", "LEFT_SK"): True, ("NODE_TIMEOUT", "LEFT_SK"): False}
            assert {entry.value for entry in bench.memory.active.values()} == {bench.image.age[KNEE]}
        assert bench.cycle(lose(KNEE)).active == {("NODE_TIMEOUT", "LEFT_SK"): True}

    def test_timeouts_of_both_legs_are_three_cycles_longer_in_a_walk_on_the_ground(self, bench: MonitorBench):
        bench.tolerance = GROUND_TOLERANCE
        assert bench.cycle(lose(OTHER_KNEE), times=7).active == {}
        assert bench.message_monitor.is_trusted(OTHER_KNEE)
        for _ in range(2):
            assert bench.cycle(lose(OTHER_KNEE)).active == {
                ("JOINT_TIMEOUT", "RIGHT_SK"): True,
                ("NODE_TIMEOUT", "RIGHT_SK"): False,
            }
        assert bench.cycle(lose(OTHER_KNEE)).active == {("NODE_TIMEOUT", "RIGHT_SK"): True}

    def test_five_lost_frames_in_a_walk_on_the_ground_raise_no_timeout(self, bench: MonitorBench):
        bench.tolerance = GROUND_TOLERANCE
        bench.cycle(lose(KNEE), times=5)
        assert bench.cycle().active == {("E2E_SEQUENCE", "LEFT_SK"): False}
        assert bench.cycle().active == {}

    @pytest.mark.parametrize("by", range(3, 11))
    def test_frames_with_a_delay_above_the_timeout_end_a_walk_on_the_ground(self, bench: MonitorBench, by: int):
        bench.tolerance = GROUND_TOLERANCE
        bench.cycle(late(bench, KNEE, by), times=by + 20)
        timeout = {("JOINT_TIMEOUT", "LEFT_SK"): True} if 5 <= by < 10 else {}
        assert bench.active == {("NODE_LATE", "LEFT_SK"): by >= 10} | timeout
        assert bench.message_monitor.valid[KNEE] == (by < 5)

    def test_timeout_of_imu_and_foot_is_not_longer_in_a_walk_on_the_ground(self, bench: MonitorBench):
        bench.tolerance = GROUND_TOLERANCE
        assert bench.cycle(lose(IMU, FOOT), times=10).active == {
            ("NODE_TIMEOUT", "IMU_PELVIS"): True,
            ("NODE_TIMEOUT", "FOOT_LEFT"): True,
        }

    def test_timeout_of_a_stance_joint_is_confirmed_immediately(self, bench: MonitorBench):
        assert bench.cycle(lose(OTHER_KNEE), times=5).active == {("NODE_TIMEOUT", "RIGHT_SK"): True}

    def test_timeout_in_double_stance_is_confirmed_immediately(self, bench: MonitorBench):
        bench.tolerance = NO_TOLERANCE
        assert bench.cycle(lose(KNEE), times=5).active == {("NODE_TIMEOUT", "LEFT_SK"): True}

    def test_timeout_of_imu_and_foot_is_confirmed_immediately(self, bench: MonitorBench):
        assert bench.cycle(lose(IMU, FOOT), times=10).active == {
            ("NODE_TIMEOUT", "IMU_PELVIS"): True,
            ("NODE_TIMEOUT", "FOOT_LEFT"): True,
        }

    def test_second_frame_after_five_lost_frames_is_accepted(self, bench: MonitorBench):
        bench.cycle(lose(KNEE), times=5)
        assert bench.cycle().active == {("JOINT_TIMEOUT", "LEFT_SK"): True, ("E2E_SEQUENCE", "LEFT_SK"): False}
        assert bench.cycle().active == {}


class TestTwoSenders:
    """A message has a second sender, whose frames are all valid."""

    @staticmethod
    def rival(row: int, *, first: bool = False, ahead: int = 0) -> Change:
        """Return a change that adds a second frame of a row, with another last byte and `ahead` added to its counter."""

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
        bench.trust_all().cycle(self.rival(row, first=first), times=3)
        assert bench.active == {("NODE_DUPLICATE", node): False}
        assert bench.message_monitor.is_trusted(row)
        assert bench.message_monitor.valid[row]
        assert not bench.message_monitor.settled
        bench.cycle(self.rival(row, first=first))
        assert bench.active == {("NODE_DUPLICATE", node): True}
        assert bench.memory.active[Dtc.NODE_DUPLICATE, node].value == 64
        assert not bench.message_monitor.is_trusted(row)
        text = f"{node}: two senders of one message, {MESSAGES[row].name}: switch one of them off"
        assert bench.memory.events[-1].text == text
        bench.cycle(self.rival(row, first=first), times=100)
        assert bench.active == {("NODE_DUPLICATE", node): True}
        assert not bench.message_monitor.is_trusted(row)
        events = [event for event in bench.memory.events if event.code == "NODE_DUPLICATE"]
        assert [event.severity for event in events] == ["warning", "error"]

    def test_trust_returns_after_16_clean_cycles_until_another_second_sender(self, bench: MonitorBench):
        bench.trust_all().cycle(self.rival(KNEE), times=4).cycle(times=15)
        assert bench.active == {}
        assert not bench.message_monitor.nodes_ready
        bench.cycle()
        assert bench.message_monitor.nodes_ready
        assert not bench.message_monitor.settled
        bench.cycle(self.rival(KNEE))
        assert bench.active == {("NODE_DUPLICATE", "LEFT_SK"): True}
        bench.cycle(times=63)
        assert not bench.message_monitor.settled
        bench.cycle()
        assert bench.message_monitor.settled

    @pytest.mark.parametrize("cycles", [1, 4, 100])
    def test_two_senders_are_possible_until_16_good_cycles(self, bench: MonitorBench, cycles: int):
        bench.cycle()
        assert not bench.message_monitor.may_have_two_senders(PENDANT)
        bench.trust_all()
        assert not bench.message_monitor.may_have_two_senders(PENDANT)
        bench.cycle(self.rival(PENDANT), times=cycles)
        assert bench.message_monitor.may_have_two_senders(PENDANT)
        bench.cycle(times=15)
        assert bench.message_monitor.may_have_two_senders(PENDANT)
        assert not bench.message_monitor.may_have_two_senders(KNEE)
        bench.cycle()
        assert not bench.message_monitor.may_have_two_senders(PENDANT)

    def test_node_with_two_senders_is_never_trusted(self, bench: MonitorBench):
        bench.cycle()
        for _ in range(10):
            bench.cycle(self.rival(IMU)).cycle(times=5)
        assert bench.message_monitor.missing() == {"IMU_PELVIS"}
        assert any(e.code == "NODE_DUPLICATE" and e.severity == "error" for e in bench.memory.events)

    @pytest.mark.parametrize("ahead", [-2, 2, 30])
    def test_second_sender_with_another_counter_is_found(self, bench: MonitorBench, ahead: int):
        bench.trust_all().cycle(self.rival(KNEE, ahead=ahead), times=3)
        assert bench.active == {("E2E_SEQUENCE", "LEFT_SK"): False}
        bench.cycle(self.rival(KNEE, ahead=ahead))
        assert bench.active == {("E2E_SEQUENCE", "LEFT_SK"): False, ("NODE_DUPLICATE", "LEFT_SK"): True}

    def test_crc_error_is_reported_in_a_cycle_with_a_second_sender(self, bench: MonitorBench):
        def change(frames: Frames) -> Frames:
            frames = self.rival(KNEE, first=True)(frames)
            frames["data"][1 + IMU, 5] ^= 1
            return frames

        bench.trust_all().cycle(change)
        assert bench.active == {("NODE_DUPLICATE", "LEFT_SK"): False, ("E2E_CRC", MESSAGES[IMU].sender): False}

    def test_conflict_in_a_cycle_with_an_accepted_frame_is_a_second_sender(self):
        assert rivals_of([(1, Check.CONFLICT)], [Check.OK, Check.SOME_LOST]) == {1}
        assert rivals_of([(1, Check.CONFLICT)], [Check.OK, Check.CONFLICT]) == set()

    def test_second_sender_is_found_if_values_are_out_of_range(self, bench: MonitorBench):
        bench.trust_all()
        bench.tx.values[bench.tx.codec.index("LEFT_SK_STATE", "Torque")] = np.nan
        bench.cycle(self.rival(KNEE), times=4)
        assert bench.active["NODE_DUPLICATE", "LEFT_SK"]

    def test_constant_counter_with_changing_data_is_one_sender(self, bench: MonitorBench):
        bench.trust_all()
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

    def test_sender_counts_as_present_until_its_timeout(self, bench: MonitorBench):
        assert not bench.message_monitor.in_time(PENDANT)
        bench.cycle()
        assert bench.message_monitor.in_time(PENDANT)
        bench.cycle(lose(PENDANT), times=4)
        assert bench.message_monitor.in_time(PENDANT)
        bench.cycle(lose(PENDANT))
        assert not bench.message_monitor.in_time(PENDANT)
