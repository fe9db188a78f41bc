"""Process image: committed values, ages and results of the checks, which are equal on the fast and the slow path."""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_dbc import Message, load
from atalante_hal.wire import process_image
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.frame import FLAG_BRS, FLAG_ESI, FLAG_FDF, new_frames
from atalante_hal.wire.process_image import NEVER, ReceiveImage, TransmitImage

NETWORK = load()
#: Cyclic messages of several kinds of nodes. `test_e2e` tests all cyclic messages.
NAMES = ("LEFT_FH", "LEFT_SK", "RIGHT_FH", "FOOT_LEFT", "RIGHT_SK", "IMU_TORSO", "IMU_PELVIS", "PENDANT")
CYCLIC = [NETWORK.message(f"{name}_STATE") for name in NAMES]
ROWS = len(CYCLIC)


def protection(protected: bytes, data_id: int) -> int:
    return crc_hqx(protected + data_id.to_bytes(2, "little"), 0xFFFF)


def pair() -> tuple[TransmitImage, ReceiveImage, np.ndarray]:
    return TransmitImage(CYCLIC), ReceiveImage(CYCLIC), new_frames(64)


def deliver(tx: TransmitImage, rx: ReceiveImage, buffer: np.ndarray, order: list[int] | None = None) -> list[int]:
    frames = tx.seal()
    order = list(range(ROWS)) if order is None else order
    buffer[: len(order)] = frames[order]
    return list(rx.accept(buffer, len(order)))


def array_types(arguments: tuple[Any, ...]) -> list[Any]:
    return [
        array_types(value)
        if isinstance(value, tuple)
        else (value.dtype, value.ndim, value.flags.c_contiguous)
        if isinstance(value, np.ndarray)
        else type(value)
        for value in arguments
    ]


def test_each_call_has_the_argument_types_of_the_compilation(monkeypatch):
    called = set()

    def checked(function: Callable[..., Any], *first: Any) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            assert array_types(arguments) == array_types(first)
            called.add(function.__name__)
            return function(*arguments)

        function(*first)
        return call

    monkeypatch.setattr(process_image, "specialised", checked)
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    deliver(tx, rx, buffer, list(reversed(range(ROWS))))
    buffer[:ROWS] = tx.seal_prepared(tx.prepare())
    rx.accept(buffer[:ROWS], ROWS, 2)
    rx.accept(buffer, 1, 3)
    assert called == {"begin_cycle", "accept_exact", "accept_frames", "seal", "protect"}


def test_cycle_without_frames_leaves_all_rows_without_data():
    _, rx, buffer = pair()
    rx.accept(buffer, 0)
    assert (rx.check == Check.NO_DATA).all()
    assert (rx.age >= NEVER).all()
    assert not rx.all_fresh


def test_received_values_match_the_sent_values():
    tx, rx, buffer = pair()
    rng = np.random.default_rng(0)
    for _ in range(5):
        tx.values[:] = rng.uniform([s.minimum for _, s in tx.codec.signals], [s.maximum for _, s in tx.codec.signals])
        deliver(tx, rx, buffer)
        skip = {i for i, (_, s) in enumerate(tx.codec.signals) if s.name in ("Crc", "Counter")}
        keep = [i for i in range(tx.codec.size) if i not in skip]
        resolution = np.array([s.factor for _, s in tx.codec.signals])
        assert (np.abs(rx.values - tx.values)[keep] <= 0.51 * resolution[keep]).all()
        assert (rx.age == 0).all()
    assert rx.all_fresh


def test_row_without_frames_ages_and_keeps_its_values():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    kept = rx.values.copy()
    order = [r for r in range(ROWS) if r != 3]
    for missed in range(1, 5):
        tx.values[:] += 0.01
        deliver(tx, rx, buffer, order)
        assert rx.check[3] == Check.NO_DATA
        assert rx.age[3] == missed
        assert np.array_equal(rx.values[rx.codec.row_of == 3], kept[rx.codec.row_of == 3])
    deliver(tx, rx, buffer)
    assert rx.check[3] == Check.SOME_LOST
    assert rx.age[3] == 0


def test_second_frame_after_five_lost_frames_is_accepted():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    for _ in range(5):
        deliver(tx, rx, buffer, [r for r in range(ROWS) if r != 3])
    deliver(tx, rx, buffer)
    assert rx.check[3] == Check.WRONG_SEQUENCE
    deliver(tx, rx, buffer)
    assert rx.check[3] == Check.OK


def test_invalid_code_keeps_the_last_good_values():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    before = rx.values.copy()
    tx.values[tx.codec.index("IMU_PELVIS_STATE", "GyroX")] = np.nan
    deliver(tx, rx, buffer)
    row = rx.codec.rows["IMU_PELVIS_STATE"]
    assert rx.check[row] == Check.INVALID
    assert rx.age[row] == 1
    own = rx.codec.row_of == row
    assert np.array_equal(rx.values[own], before[own])
    assert (np.delete(rx.check, row) == Check.OK).all()


def test_frames_can_be_sealed_with_a_given_counter():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    tx.seal_row(2)
    for counter in (1, 1, 2, 255, 255):
        frames = tx.seal(counter)
        assert (frames["data"][:, 2] == counter).all()
        assert tx.counter == counter
    assert (tx.seal()["data"][:, 2] == 0).all()


def test_prepared_payloads_are_sealed_with_the_next_counter():
    tx, rx, buffer = pair()
    tx.values[:] = 1.0
    prepared = tx.prepare()
    deliver(tx, rx, buffer)
    tx.values.fill(np.nan)
    buffer[:ROWS] = tx.seal_prepared(prepared)
    rx.accept(buffer, ROWS)
    assert rx.all_fresh
    assert np.allclose(rx.values[rx.codec.slice("Force")], 1.0)


def test_indices_of_foreign_frames_are_returned():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    frames = tx.seal()
    buffer[:ROWS] = frames
    buffer[ROWS]["can_id"] = 0x7FF
    assert list(rx.accept(buffer, ROWS + 1)) == [ROWS]
    frames = tx.seal()
    buffer[1 : ROWS + 1] = frames
    buffer[0]["can_id"] = 0x7FF
    assert list(rx.accept(buffer, ROWS + 1)) == [0]
    assert rx.all_fresh


CHANGES = ("none", "flip", "drop", "twice", "rival", "rival first", "old", "range", "foreign", "length", "swap")


def rival(frame: np.ndarray, message: Message, byte: int = 0) -> np.ndarray:
    """Return the frame of a second sender: the same counter, one changed bit, and a correct CRC."""
    other = frame.copy()
    index = 3 + byte % (message.length - 3)
    other["data"][index] ^= 1
    checksum = protection(other["data"][2 : message.length].tobytes(), message.data_id)
    other["data"][:2] = list(checksum.to_bytes(2, "little"))
    return other


@pytest.mark.parametrize("row", range(ROWS))
def test_same_counter_with_other_bytes_is_a_conflict(row: int):
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    for byte in range(CYCLIC[row].length - 3):
        true = tx.seal().copy()
        other = rival(true[row], CYCLIC[row], byte)
        buffer[:ROWS], buffer[ROWS] = true, other
        rx.accept(buffer, ROWS + 1)
        assert rx.refused == [(row, Check.CONFLICT)]
        assert rx.check[row] == Check.OK
        assert rx.frames[row] == true[row]
        # The second frame is one cycle late, and arrives with the next frame of the first sender.
        following = tx.seal().copy()
        buffer[0], buffer[1 : ROWS + 1] = rival(true[row], CYCLIC[row], byte), following
        rx.accept(buffer, ROWS + 1)
        assert rx.refused == [(row, Check.CONFLICT)]
        assert (rx.check[row], rx.age[row]) == (Check.OK, 0)
        # The second frame arrives alone, with the counter of the last accepted frame.
        deliver_frames(rx, buffer, [rival(following[row], CYCLIC[row], byte)])
        assert rx.check[row] == Check.CONFLICT
        assert rx.age[row] == 1
        deliver_frames(rx, buffer, [following[row]])
        assert rx.check[row] == Check.REPEATED


def deliver_frames(rx: ReceiveImage, buffer: np.ndarray, frames: list[np.ndarray]) -> None:
    for index, frame in enumerate(frames):
        buffer[index] = frame
    rx.accept(buffer, len(frames))


def test_bytes_after_the_payload_cause_no_conflict():
    tx, rx, buffer = pair()
    true = tx.seal()[0].copy()
    again = true.copy()
    again["data"][CYCLIC[0].length :] = 0xAA
    deliver_frames(rx, buffer, [true, again])
    assert rx.refused == [(0, Check.REPEATED)]


def test_repetition_and_conflict_are_found_after_an_invalid_frame():
    tx, rx, buffer = pair()
    row = rx.codec.rows["IMU_PELVIS_STATE"]
    deliver(tx, rx, buffer)
    tx.values[tx.codec.index("IMU_PELVIS_STATE", "GyroX")] = np.nan
    bad = tx.seal()[row].copy()
    deliver_frames(rx, buffer, [bad, bad, rival(bad, CYCLIC[row], 20)])
    assert rx.refused == [(row, Check.INVALID), (row, Check.REPEATED), (row, Check.CONFLICT)]


def test_restarted_sender_with_the_last_counter_is_accepted_and_listed():
    status = [m for m in NETWORK.received_by("HAL") if m.name == "LEFT_FH_STATUS"]
    tx, rx, buffer = TransmitImage(status), ReceiveImage(status, restarts=True), new_frames(4)
    uptime = tx.codec.index("LEFT_FH_STATUS", "Uptime")
    deliver_frames(rx, buffer, [tx.seal(7)[0].copy()])
    tx.values[uptime] = 5.0
    deliver_frames(rx, buffer, [tx.seal(7)[0].copy()])
    assert (rx.check[0], rx.age[0], rx.values[uptime]) == (Check.SOME_LOST, 0, 5.0)
    assert rx.refused == [(0, Check.CONFLICT)]
    deliver_frames(rx, buffer, [tx.seal(7)[0].copy()])
    assert rx.refused == [(0, Check.REPEATED)]


def test_age_of_a_received_message_stays_below_never():
    tx, rx, buffer = pair()
    deliver_frames(rx, buffer, [tx.seal()[0].copy()])
    for elapsed, age in ((NEVER - 2, NEVER - 2), (1, NEVER - 1), (1, NEVER - 1), (NEVER, NEVER - 1)):
        rx.new_cycle(elapsed)
        assert rx.age[0] == age
        assert (rx.age[1:] >= NEVER).all()


def test_same_frame_after_a_known_restart_of_its_sender_is_accepted():
    messages = [m for m in NETWORK.received_by("HAL") if m.name in ("LEFT_FH_EMCY", "LEFT_TH_EMCY")]
    tx, rx, buffer = TransmitImage(messages), ReceiveImage(messages, restarts=True), new_frames(4)
    frames = tx.seal(0).copy()
    deliver_frames(rx, buffer, list(frames))
    rx.restart(1)
    deliver_frames(rx, buffer, list(frames))
    assert rx.check.tolist() == [Check.REPEATED, Check.OK]
    deliver_frames(rx, buffer, list(frames))
    assert rx.check.tolist() == [Check.REPEATED] * 2


def test_committed_frame_after_a_loss_is_not_a_further_frame():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    tx.seal()  # lost
    true = tx.seal()[0].copy()
    deliver_frames(rx, buffer, [true, rival(true, CYCLIC[0])])
    assert rx.check[0] == Check.SOME_LOST
    assert len(rx.decode_further_frames(0)) == 1


def test_further_frames_of_a_row_are_decoded_in_order_of_arrival():
    tx, rx, buffer = pair()
    row, own = rx.codec.rows["PENDANT_STATE"], slice(None)
    dead_man, position = rx.codec.index("PENDANT_STATE", "DeadMan"), rx.codec.index("LEFT_SK_STATE", "Position")
    tx.values[position] = 2.0
    deliver(tx, rx, buffer)
    deliver(tx, rx, buffer)
    assert rx.decode_further_frames(row) == []
    tx.values[dead_man] = 1.0
    released, true = tx.seal()[row].copy(), tx.frames[row].copy()
    released["data"][3] ^= 1
    released["data"][:2] = list(protection(released["data"][2:8].tobytes(), CYCLIC[row].data_id).to_bytes(2, "little"))
    damaged = true.copy()
    damaged["data"][5] ^= 1
    deliver_frames(rx, buffer, [damaged, true, true, released])
    (further,) = rx.decode_further_frames(row)
    assert further[dead_man] == 0.0
    assert further[position] == rx.values[position] == pytest.approx(2.0, abs=0.01)  # a value of another row is kept
    assert rx.values[dead_man] == 1.0
    assert rx.decode_further_frames(0) == []
    late, now = tx.seal()[row].copy(), tx.seal()[row].copy()
    deliver_frames(rx, buffer, [released, late, now])
    assert [values[dead_man] for values in rx.decode_further_frames(row)] == [0.0, 1.0]
    assert rx.values[own][dead_man] == 1.0
    deliver(tx, rx, buffer)
    assert rx.decode_further_frames(row) == []


@given(
    st.lists(
        st.tuples(st.sampled_from(CHANGES), st.integers(0, ROWS - 1), st.integers(0, 63)), min_size=1, max_size=12
    ),
    st.randoms(use_true_random=False),
)
def test_fast_and_slow_path_agree_for_any_history(history, shuffler):
    """One process image may use its fast path, the other checks frame by frame. All results must be equal."""
    tx, fast, buffer = pair()
    slow = ReceiveImage(CYCLIC)
    old = tx.seal().copy()
    for change, row, byte in history:
        tx.values[tx.codec.index("IMU_TORSO_STATE", "AccelX")] = np.nan if change == "range" else 1.0
        frames = list(tx.seal().copy())
        if change == "flip":
            frames[row]["data"][byte % CYCLIC[row].length] ^= 1 << (byte % 8)
        elif change == "drop":
            del frames[row]
        elif change == "twice":
            frames.append(frames[row].copy())
        elif change.startswith("rival"):
            frames.insert(row if change == "rival first" else len(frames), rival(frames[row], CYCLIC[row], byte))
        elif change == "old":
            frames[row] = old[row]
        elif change == "foreign":
            frames.insert(row, new_frames(1)[0])
        elif change == "length":
            frames[row]["len"] = byte
        elif change == "swap":
            shuffler.shuffle(frames)
        for index, frame in enumerate(frames):
            buffer[index] = frame
        foreign_fast = list(fast.accept(buffer, len(frames)))
        slow.new_cycle()
        foreign_slow = slow.accept_each(buffer, len(frames))
        assert foreign_fast == foreign_slow
        assert np.array_equal(fast.check, slow.check)
        assert np.array_equal(fast.age, slow.age)
        assert np.array_equal(fast.values, slow.values, equal_nan=True)
        assert fast.crc_errors == slow.crc_errors
        # In a perfect cycle neither path lists a rejected frame.
        assert slow.refused == fast.refused
        assert fast.frames.tobytes() == slow.frames.tobytes()
        for each in range(ROWS):
            assert np.array_equal(fast.decode_further_frames(each), slow.decode_further_frames(each), equal_nan=True)


@pytest.mark.parametrize("byte", [0, 1, 2, 11])
def test_flipped_bit_in_a_single_frame_is_found(byte: int):
    tx, rx, _ = pair()
    frame = tx.seal_row(0).copy()
    frame["data"][0, byte] ^= 0x40
    rx.new_cycle()
    rx.accept_each(frame, 1)
    assert rx.refused == [(0, Check.CRC)]
    assert rx.check[0] == Check.CRC
    assert rx.crc_errors == 1


def test_single_row_has_its_own_counter():
    tx = TransmitImage(CYCLIC)
    rx = ReceiveImage(CYCLIC)
    for _ in range(3):
        frame = tx.seal_row(2)
        rx.new_cycle()
        rx.accept_each(frame, 1)
        assert rx.check[2] == Check.OK
    tx.seal_row(4)
    tx.seal_row(2)
    assert tx.frames[2]["data"][2] == 3
    assert tx.frames[4]["data"][2] == 0


def answer(tx: TransmitImage, rx: ReceiveImage, buffer: np.ndarray, cycle: int, delays: dict[int, int]) -> None:
    """Receive the answers of all rows to the SYNC of a cycle.

    Args:
        tx: process image of the nodes.
        rx: process image of the HAL.
        buffer: receive buffer.
        cycle: number of the cycle.
        delays: row -> delay of its answer [cycles]; -1 if the row does not answer. All other rows answer without delay.
    """
    count = 0
    for row in range(ROWS):
        delay = delays.get(row, 0)
        if delay >= 0:
            buffer[count] = tx.seal((cycle - delay) & 0xFF)[row]
            count += 1
    rx.accept(buffer, count, cycle & 0xFF)


class TestCycleTag:
    """The counter of a frame is the tag of the SYNC that it answers."""

    def test_answers_to_each_sync_are_fresh_across_the_counter_overflow(self):
        tx, rx, buffer = pair()
        for cycle in range(250, 262):
            answer(tx, rx, buffer, cycle, {})
            assert rx.all_fresh == (cycle > 250)
            assert (rx.check == Check.OK).all()
            assert (rx.age == 0).all()

    def test_answers_one_cycle_late_have_age_one(self):
        tx, rx, buffer = pair()
        for cycle in range(5):
            answer(tx, rx, buffer, cycle, dict.fromkeys(range(ROWS), 1))
            assert not rx.all_fresh
            assert (rx.check == Check.OK).all()
            assert (rx.age == 1).all()

    def test_late_answer_has_the_age_of_its_sync(self):
        tx, rx, buffer = pair()
        for cycle, delay, check, age in (
            (100, 0, Check.OK, 0),
            (101, -1, Check.NO_DATA, 1),
            (102, 1, Check.OK, 1),
            (103, 1, Check.OK, 1),
            (104, 0, Check.SOME_LOST, 0),
            (105, 1, Check.REPEATED, 1),
            (106, 3, Check.WRONG_SEQUENCE, 2),
            (107, 0, Check.SOME_LOST, 0),
        ):
            answer(tx, rx, buffer, cycle, {7: delay})
            assert (rx.check[7], rx.age[7]) == (check, age), cycle
            assert (np.delete(rx.age, 7) == 0).all()

    def test_first_frame_may_be_at_most_15_cycles_late(self):
        for delay, check in ((15, Check.OK), (16, Check.WRONG_SEQUENCE), (200, Check.WRONG_SEQUENCE)):
            tx, rx, buffer = pair()
            answer(tx, rx, buffer, 300, {7: delay})
            assert rx.check[7] == check
            assert rx.age[7] == (delay if check is Check.OK else NEVER + 1)
            # A rejected frame has no effect on the next frame.
            answer(tx, rx, buffer, 301, {7: 0})
            assert rx.check[7] == (Check.OK if check is not Check.OK else Check.WRONG_SEQUENCE)

    @pytest.mark.parametrize("cycles", [5, 100, 127, 128, 160, 200, 254, 255, 256, 260, 300, 400, 512])
    def test_second_frame_after_any_silence_is_accepted(self, cycles: int):
        tx, rx, buffer = pair()
        answer(tx, rx, buffer, 10, {})
        for cycle in range(11, 11 + cycles):
            answer(tx, rx, buffer, cycle, {7: -1})
        back = 11 + cycles
        # The first frame is rejected, unless its counter is one to five ahead.
        first = {0: Check.OK, 4: Check.SOME_LOST}.get(cycles & 0xFF, Check.WRONG_SEQUENCE)
        for cycle, check in ((back, first), (back + 1, Check.OK)):
            answer(tx, rx, buffer, cycle, {})
            assert rx.check[7] == check
        assert rx.all_fresh
        # The same happens to all rows at once. Before and after it, the fast path is used.
        for cycle in range(back + 2, back + 2 + cycles):
            answer(tx, rx, buffer, cycle, dict.fromkeys(range(ROWS), -1))
        back += 2 + cycles
        for cycle, check in ((back, first), (back + 1, Check.OK)):
            answer(tx, rx, buffer, cycle, {})
            assert (rx.check == check).all()

    def test_constant_counter_is_never_accepted(self):
        tx, rx, buffer = pair()
        answer(tx, rx, buffer, 10, {})
        stuck = tx.frames[7].copy()
        for cycle in range(11, 600):
            frames = tx.seal(cycle & 0xFF).copy()
            frames[7] = stuck
            buffer[:ROWS] = frames
            rx.accept(buffer, ROWS, cycle & 0xFF)
            assert rx.check[7] in (Check.REPEATED, Check.WRONG_SEQUENCE)
            assert rx.age[7] == cycle - 10

    def test_counter_half_a_range_ahead_is_rejected(self):
        for ahead, check in ((127, Check.WRONG_SEQUENCE), (128, Check.WRONG_SEQUENCE)):
            tx, rx, buffer = pair()
            answer(tx, rx, buffer, 50, {})
            answer(tx, rx, buffer, 50 + ahead, {})
            assert (rx.check == check).all()
            # A counter 127 ahead becomes the new expected counter; 128 ahead does not.
            answer(tx, rx, buffer, 51 + ahead, {})
            assert (rx.check == (Check.OK if ahead == 127 else Check.WRONG_SEQUENCE)).all()


def test_any_counter_is_accepted_if_senders_may_restart():
    status = [m for m in NETWORK.received_by("HAL") if m.name == "LEFT_FH_STATUS"]
    tx, buffer = TransmitImage(status), new_frames(4)
    rx = ReceiveImage(status, restarts=True)
    for counter, check in (
        (0, Check.OK),
        (1, Check.OK),
        (200, Check.SOME_LOST),
        (200, Check.REPEATED),
        (0, Check.SOME_LOST),
    ):
        buffer[:1] = tx.seal(counter)
        rx.accept(buffer, 1)
        assert rx.check[0] == check, counter


def test_rejected_row_keeps_its_values_and_ages():
    tx, rx, buffer = pair()
    own = rx.codec.row_of == 3
    tx.values[own[: tx.codec.size]] = 1.0
    deliver(tx, rx, buffer)
    deliver(tx, rx, buffer)
    assert rx.all_fresh
    kept = rx.values.copy()
    for age in range(1, 4):
        tx.values[own] = 2.0
        deliver(tx, rx, buffer)
        assert not np.array_equal(rx.values[own], kept[own])
        rx.refuse(3, np.flatnonzero(own))
        assert not rx.all_fresh
        assert (rx.check[3], rx.age[3]) == (Check.IMPLAUSIBLE, age)
        assert np.array_equal(rx.values[own], kept[own])
        assert (np.delete(rx.check, 3) == Check.OK).all()
    deliver(tx, rx, buffer, [r for r in range(ROWS) if r != 3])
    assert (rx.check[3], rx.age[3]) == (Check.NO_DATA, 4)
    deliver(tx, rx, buffer)
    assert (rx.check[3], rx.age[3]) == (Check.SOME_LOST, 0)
    deliver(tx, rx, buffer)
    rx.refuse(3, np.flatnonzero(own))
    assert rx.age[3] == 1


def test_rejected_frames_are_listed_with_their_reason():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    deliver(tx, rx, buffer)
    assert rx.refused == []
    tx.values[tx.codec.index("IMU_PELVIS_STATE", "GyroX")] = np.nan
    frames = tx.seal()
    buffer[:ROWS] = frames
    buffer[0]["len"] += 4
    buffer[1]["data"][9] ^= 1
    buffer[2]["flags"] = 0
    buffer[ROWS] = frames[4]
    rx.accept(buffer, ROWS + 1)
    pelvis = rx.codec.rows["IMU_PELVIS_STATE"]
    expected = [(0, Check.LENGTH), (1, Check.CRC), (2, Check.LENGTH), (pelvis, Check.INVALID), (4, Check.REPEATED)]
    assert rx.refused == expected
    assert rx.check[4] == Check.OK  # its first frame was accepted
    assert rx.crc_errors == 1
    tx.values[tx.codec.index("IMU_PELVIS_STATE", "GyroX")] = 0.0
    deliver(tx, rx, buffer)
    assert rx.refused == []
    deliver(tx, rx, buffer, [])
    assert rx.refused == []


def test_good_frame_is_accepted_before_or_after_a_damaged_one():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    for first, second in ((0, 1), (1, 0)):
        frame = tx.seal()[5]
        bad = frame.copy()
        bad["data"][8] ^= 1
        both = [frame, bad]
        buffer[0], buffer[1] = both[first], both[second]
        rx.accept(buffer, 2)
        assert (rx.check[5], rx.age[5]) == (Check.OK, 0)
        assert rx.refused == [(5, Check.CRC)]


def test_out_of_range_and_invalid_codes_are_distinguished():
    tx, _, buffer = pair()
    row, signal = tx.codec.rows["LEFT_FH_STATE"], tx.codec.index("LEFT_FH_STATE", "DriveState")
    message, drive_state = tx.codec.signals[signal]
    rx = ReceiveImage(CYCLIC, independent=("DriveState", "Temperature"))
    temperature = tx.codec.index("LEFT_FH_STATE", "Temperature")
    for code, check in ((64, Check.OK), (65, Check.RANGE), (drive_state.invalid_raw, Check.INVALID)):
        tx.values[temperature] = 30.0 + code
        frames = tx.seal()
        frames[row]["data"][drive_state.start // 8] = code
        payload = frames[row]["data"][: message.length].tobytes()
        crc = protection(payload[2:], message.data_id)
        frames[row]["data"][:2] = np.frombuffer(crc.to_bytes(2, "little"), np.uint8)
        buffer[:ROWS] = frames
        rx.accept(buffer, ROWS)
        assert rx.check[row] == check
        assert rx.values[temperature] == min(30.0 + code, 214.0)
    assert rx.values[signal] == 64


def test_cycle_is_complete_if_all_messages_are_first_and_in_order():
    tx, rx, buffer = pair()
    buffer[:ROWS] = tx.seal()
    assert rx.begins(buffer, ROWS)
    assert rx.begins(buffer, ROWS + 1)
    assert not rx.begins(buffer, ROWS - 1)
    buffer[[0, 1]] = buffer[[1, 0]]
    assert not rx.begins(buffer, ROWS)
    other = new_frames(64)
    other[:ROWS] = tx.frames
    assert rx.begins(other, ROWS)


def test_identifiers_are_expected_until_their_timeout():
    tx, rx, buffer = pair()
    assert rx.expected_ages() == {}
    deliver(tx, rx, buffer)
    everybody = {m.frame_id: 0 for m in CYCLIC}
    assert rx.expected_ages() == everybody
    silent = CYCLIC[3]
    for age in range(1, silent.timeout_ms + 1):
        deliver(tx, rx, buffer, [r for r in range(ROWS) if r != 3])
        assert rx.expected_ages() == everybody | {silent.frame_id: age}
    deliver(tx, rx, buffer, [r for r in range(ROWS) if r != 3])
    del everybody[silent.frame_id]
    assert rx.expected_ages() == everybody


def test_set_counter_continues_after_the_given_counter():
    tx = TransmitImage(CYCLIC)
    assert (tx.seal()["data"][:, 2] == 0).all()
    tx.set_counter(2, 9)
    counters = tx.seal()["data"][:, 2]
    assert counters[2] == 10
    assert (np.delete(counters, 2) == 1).all()


def test_messages_of_64_bytes_are_protected():
    """A frame of 64 bytes has no free bytes for the Data ID."""
    longest = [replace(m, length=64) for m in CYCLIC[:2]]
    tx, rx, buffer = TransmitImage(longest), ReceiveImage(longest), new_frames(4)
    for _ in range(3):
        frames = tx.seal()
        for frame, message in zip(frames, longest, strict=True):
            payload = frame["data"][:64].tobytes()
            assert int.from_bytes(payload[:2], "little") == protection(payload[2:], message.data_id)
        buffer[:2] = frames
        rx.accept(buffer, 2)
        assert (rx.check == Check.OK).all()
    assert rx.all_fresh


def test_refuse_affects_only_its_signals():
    tx, rx, buffer = pair()
    position = rx.codec.index("LEFT_SK_STATE", "Position")
    row = int(rx.codec.row_of[position])
    deliver(tx, rx, buffer)
    for _ in range(2):
        deliver(tx, rx, buffer)
        rx.refuse(row, np.array([position]))
    assert rx.age[row] == 2
    deliver(tx, rx, buffer)
    assert rx.all_fresh
    before = rx.values.copy()
    tx.values[:] = 1.0
    deliver(tx, rx, buffer)
    new = rx.values.copy()
    assert new[position] != before[position]
    rx.refuse(row, np.array([position]))
    assert (rx.age[row], rx.all_fresh) == (1, False)
    assert rx.values[position] == before[position]
    assert np.array_equal(np.delete(rx.values, position), np.delete(new, position))


def test_complete_cycle_in_any_order_is_fresh():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    deliver(tx, rx, buffer, list(reversed(range(ROWS))))
    assert rx.all_fresh
    frames = tx.seal()
    buffer[1 : ROWS + 1] = frames[::-1]
    buffer[0]["can_id"] = 0x7FF
    assert list(rx.accept(buffer, ROWS + 1)) == [0]
    assert rx.all_fresh


def test_repeated_frame_is_rejected_once():
    """Row 0 is a special case: its frame is first in the buffer."""
    for row in (0, 3):
        tx, rx, buffer = pair()
        deliver(tx, rx, buffer)
        frames = tx.seal()
        buffer[:ROWS], buffer[ROWS] = frames, frames[row]
        assert list(rx.accept(buffer, ROWS + 1)) == []
        assert rx.refused == [(row, Check.REPEATED)]
        assert not rx.all_fresh
        assert (rx.check == Check.OK).all()


def test_loss_is_reported_despite_a_later_repetition():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    tx.seal()
    frame = tx.seal()[5]
    buffer[0] = buffer[1] = frame
    rx.accept(buffer, 2)
    assert (rx.check[5], rx.refused) == (Check.SOME_LOST, [(5, Check.REPEATED)])


def test_damaged_frames_are_counted():
    tx, rx, buffer = pair()
    for damaged in range(1, 4):
        frames = tx.seal()
        frames[damaged]["data"][9] ^= 1
        buffer[:ROWS] = frames
        rx.accept(buffer, ROWS)
        assert rx.crc_errors == damaged


def test_new_process_image_has_no_data():
    rx = ReceiveImage(CYCLIC)
    assert (rx.check.dtype, rx.age.dtype) == (np.uint8, np.int64)
    assert rx.check.tolist() == [Check.NO_DATA] * ROWS
    assert rx.age.tolist() == [NEVER] * ROWS
    assert np.isnan(rx.values).all()
    assert np.isnan(rx.values_before).all()
    assert (rx.refused, rx.crc_errors, rx.all_fresh) == ([], 0, False)


def test_frame_after_a_loss_can_be_accepted_and_refused():
    tx, rx, buffer = pair()
    row, signal = rx.codec.rows["IMU_TORSO_STATE"], rx.codec.index("IMU_TORSO_STATE", "AccelX")
    deliver(tx, rx, buffer)
    for sent, check, kept in ((2.0, Check.SOME_LOST, 2.0), (np.nan, Check.INVALID, 2.0), (3.0, Check.OK, 3.0)):
        tx.seal()
        tx.values[signal] = sent
        before = rx.values.copy()
        deliver(tx, rx, buffer, [row])
        assert rx.check[row] == (Check.SOME_LOST if check is Check.OK else check)
        assert rx.values[signal] == pytest.approx(kept, abs=0.01)
        assert np.array_equal(rx.values_before, before, equal_nan=True)
        tx.values[signal] = 0.0
    rx.refuse(row, np.array([signal]))
    assert rx.values[signal] == pytest.approx(2.0, abs=0.01)


def test_independent_signals_are_committed_although_another_signal_is_invalid():
    tx, _, buffer = pair()
    rx = ReceiveImage(CYCLIC, independent=("DriveState", "Temperature"))
    row = rx.codec.rows["LEFT_SK_STATE"]
    state, temperature, torque, position, other = (
        rx.codec.index(message, signal)
        for message, signal in (
            ("LEFT_SK_STATE", "DriveState"),
            ("LEFT_SK_STATE", "Temperature"),
            ("LEFT_SK_STATE", "Torque"),
            ("LEFT_SK_STATE", "Position"),
            ("LEFT_FH_STATE", "Temperature"),
        )
    )
    tx.values[[state, temperature, torque, other]] = 39.0, 25.0, 10.0, 30.0
    deliver(tx, rx, buffer)
    tx.values[[state, temperature, torque, position, other]] = 64.0, 214.0, 20.0, np.nan, 31.0
    deliver(tx, rx, buffer)
    assert (rx.check[row], rx.age[row]) == (Check.INVALID, 1)
    assert rx.values[[state, temperature, torque, position, other]].tolist() == [64.0, 214.0, 10.0, 0.0, 31.0]
    tx.values[[state, temperature]] = 0.0, np.nan
    deliver(tx, rx, buffer)
    assert rx.values[[state, temperature]].tolist() == [0.0, 214.0]
    tx.values[[temperature]] = -40.0
    deliver(tx, rx, buffer)
    assert rx.values[temperature] == -40.0


@pytest.mark.parametrize("first", ["invalid", "valid"])
def test_accepted_frame_has_priority_over_an_invalid_frame_of_the_same_cycle(first: str):
    tx, _, buffer = pair()
    rx = ReceiveImage(CYCLIC, independent=("DriveState",))
    row = rx.codec.rows["LEFT_SK_STATE"]
    state, position = (rx.codec.index("LEFT_SK_STATE", signal) for signal in ("DriveState", "Position"))
    deliver(tx, rx, buffer)
    tx.seal()  # a lost frame, so the valid frame may have the result SOME_LOST
    for index, kind in enumerate((first, "valid" if first == "invalid" else "invalid")):
        tx.values[[state, position]] = (39.0, 1.0) if kind == "valid" else (8.0, np.nan)
        buffer[index] = tx.seal()[row]
    rx.accept(buffer, 2)
    assert rx.values[state] == 39.0


def test_newest_of_two_invalid_frames_gives_the_independent_signals():
    tx, _, buffer = pair()
    rx = ReceiveImage(CYCLIC, independent=("DriveState",))
    row = rx.codec.rows["LEFT_SK_STATE"]
    state, position = (rx.codec.index("LEFT_SK_STATE", signal) for signal in ("DriveState", "Position"))
    deliver(tx, rx, buffer)
    for index, value in enumerate((39.0, 8.0)):
        tx.values[[state, position]] = value, np.nan
        buffer[index] = tx.seal()[row]
    rx.accept(buffer, 2)
    assert rx.values[state] == 8.0


def test_given_array_is_used_for_the_values():
    values = np.zeros(ReceiveImage(CYCLIC).codec.size)
    rx = ReceiveImage(CYCLIC, values)
    assert rx.values is values


def test_last_good_frames_are_kept():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    deliver(tx, rx, buffer)
    assert rx.all_fresh
    assert rx.frames.tobytes() == tx.frames.tobytes()
    before = tx.frames.copy()
    tx.values[:] = 1.0
    deliver(tx, rx, buffer, [2])
    assert rx.frames[2] == tx.frames[2] != before[2]
    assert np.delete(rx.frames, 2).tobytes() == np.delete(before, 2).tobytes()


def test_sealed_row_is_one_frame():
    tx = TransmitImage(CYCLIC)
    assert (tx.counter, tx.frames["data"][0, 2]) == (0xFF, 0xFF)
    for row in range(ROWS):
        assert [frame["can_id"] for frame in tx.seal_row(row)] == [CYCLIC[row].frame_id]


def test_nan_without_an_invalid_code_cannot_be_sealed():
    tx = TransmitImage(CYCLIC)
    tx.values[tx.codec.index("PENDANT_STATE", "DeadMan")] = np.nan
    before = tx.frames.copy()
    with pytest.raises(
        ValueError,
        match=r"^PENDANT_STATE.DeadMan must be a number, because the DBC has no invalid code for it, got NaN$",
    ):
        tx.seal()
    assert tx.frames.tobytes() == before.tobytes()


class TestErrorPassiveSender:
    """A sender that is error passive sets the flag ESI in its frames."""

    def test_error_passive_sender_is_listed_and_its_frame_used(self):
        tx, rx, buffer = pair()
        assert rx.error_passive == []
        deliver(tx, rx, buffer)
        assert rx.error_passive == []
        tx.values[tx.codec.index("LEFT_SK_STATE", "Temperature")] = 41.0
        buffer[:ROWS] = tx.seal()
        buffer["flags"][1] |= FLAG_ESI
        buffer["flags"][4] |= FLAG_ESI
        assert list(rx.accept(buffer, ROWS)) == []
        assert rx.error_passive == [1, 4]
        assert rx.refused == []
        assert rx.values[rx.codec.index("LEFT_SK_STATE", "Temperature")] == 41.0
        assert (rx.check == Check.OK).all()
        assert not rx.all_fresh
        deliver(tx, rx, buffer)
        assert rx.error_passive == []
        assert rx.all_fresh

    def test_error_passive_sender_is_not_listed_after_a_cycle_without_frames(self):
        tx, rx, buffer = pair()
        buffer[:ROWS] = tx.seal()
        buffer["flags"][1] |= FLAG_ESI
        rx.accept(buffer, ROWS)
        rx.new_cycle()
        assert rx.error_passive == []

    def test_error_passive_sender_of_an_unknown_frame_is_not_listed(self):
        _, rx, buffer = pair()
        buffer["can_id"][0], buffer["flags"][0] = 0x7FF, FLAG_FDF | FLAG_BRS | FLAG_ESI
        assert list(rx.accept(buffer, 1)) == [0]
        assert rx.error_passive == []

    def test_frames_after_an_unknown_frame_are_reported(self):
        tx, rx, buffer = pair()
        buffer["can_id"][0], buffer["flags"][0] = 0x7FF, FLAG_FDF | FLAG_BRS
        buffer[1 : 1 + ROWS] = tx.seal()
        buffer["flags"][2] |= FLAG_ESI
        buffer["data"][3, 5] ^= 1
        assert list(rx.accept(buffer, 1 + ROWS)) == [0]
        assert rx.error_passive == [1]
        assert rx.refused == [(2, Check.CRC)]

    def test_error_passive_flag_outside_the_received_frames_is_ignored(self):
        tx, rx, buffer = pair()
        buffer[:ROWS] = tx.seal()
        buffer["flags"][1] |= FLAG_ESI
        rx.accept(buffer, 1)
        assert rx.error_passive == []
        assert buffer["flags"][1] & FLAG_ESI

    @pytest.mark.parametrize("flags", [0, FLAG_FDF, FLAG_FDF | FLAG_ESI, FLAG_ESI, FLAG_BRS | FLAG_ESI])
    def test_frame_with_another_wrong_flag_is_rejected(self, flags: int):
        tx, rx, buffer = pair()
        buffer[:ROWS] = tx.seal()
        buffer["flags"][1] = flags
        rx.accept(buffer, ROWS)
        assert rx.check[1] == Check.LENGTH
        assert rx.error_passive == ([1] if flags == FLAG_FDF | FLAG_ESI else [])
