"""The process image: what is committed, what ages, and that both paths judge alike."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from atalante_dbc import load
from atalante_hal.e2e import Check
from atalante_hal.frame import new_frames
from atalante_hal.image import NEVER, ReceiveImage, TransmitImage

NETWORK = load()
CYCLIC = [m for m in NETWORK.received_by("HAL") if m.cycle_ms == 1]
ROWS = len(CYCLIC)


def pair() -> tuple[TransmitImage, ReceiveImage, np.ndarray]:
    return TransmitImage(CYCLIC), ReceiveImage(CYCLIC), new_frames(64)


def deliver(tx: TransmitImage, rx: ReceiveImage, buffer: np.ndarray, order: list[int] | None = None) -> list[int]:
    frames = tx.seal()
    order = list(range(ROWS)) if order is None else order
    buffer[: len(order)] = frames[order]
    return list(rx.accept(buffer, len(order)))


def test_nothing_received_is_nothing_known():
    _, rx, buffer = pair()
    rx.accept(buffer, 0)
    assert (rx.check == Check.NO_DATA).all()
    assert (rx.age >= NEVER).all()
    assert not rx.all_fresh


def test_values_arrive():
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


def test_the_frames_of_a_missing_node_age_and_keep_their_values():
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


def test_more_than_four_lost_frames_need_one_more_to_be_believed():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    for _ in range(5):
        deliver(tx, rx, buffer, [r for r in range(ROWS) if r != 3])
    deliver(tx, rx, buffer)
    assert rx.check[3] == Check.WRONG_SEQUENCE
    deliver(tx, rx, buffer)
    assert rx.check[3] == Check.OK


def test_an_invalid_code_leaves_the_last_good_values():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    before = rx.values.copy()
    tx.values[tx.codec.index("IMU_PELVIS_STATE", "GyroX")] = np.nan
    deliver(tx, rx, buffer)
    row = rx.codec.rows["IMU_PELVIS_STATE"]
    assert rx.check[row] == Check.INVALID
    assert rx.age[row] == 1
    mine = rx.codec.row_of == row
    assert np.array_equal(rx.values[mine], before[mine])
    assert (np.delete(rx.check, row) == Check.OK).all()


def test_frames_can_be_sealed_under_a_counter_of_ones_own():
    tx, rx, buffer = pair()
    deliver(tx, rx, buffer)
    tx.seal_row(2)
    for counter in (1, 1, 2, 255, 255):
        frames = tx.seal(counter)
        assert (frames["data"][:, 2] == counter).all()
        assert tx.counter == counter
    assert (tx.seal()["data"][:, 2] == 0).all()


def test_prepared_payloads_are_sealed_with_the_next_counter_whatever_the_values_are():
    tx, rx, buffer = pair()
    tx.values[:] = 1.0
    prepared = tx.prepare()
    deliver(tx, rx, buffer)
    tx.values.fill(np.nan)
    buffer[:ROWS] = tx.seal_prepared(prepared)
    rx.accept(buffer, ROWS)
    assert rx.all_fresh
    assert np.allclose(rx.values[rx.codec.slice("Force")], 1.0)


def test_foreign_frames_are_named_wherever_they_stand():
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


CHANGES = ("none", "flip", "drop", "twice", "old", "range", "foreign", "length", "swap")


@settings(max_examples=80, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(CHANGES), st.integers(0, ROWS - 1), st.integers(0, 63)), min_size=1, max_size=12
    ),
    st.randoms(use_true_random=False),
)
def test_fast_and_slow_path_give_equal_results_for_any_history(history, shuffler):
    """One image may take its fast path, the other is made to judge frame by frame; nothing may differ."""
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
        elif change == "old":
            frames[row] = old[row]
        elif change == "foreign":
            frames.insert(row, new_frames(1)[0])
        elif change == "length":
            frames[row]["len"] = byte
        elif change == "swap":
            shuffler.shuffle(frames)
        for place, frame in enumerate(frames):
            buffer[place] = frame
        foreign_fast = list(fast.accept(buffer, len(frames)))
        slow.new_cycle()
        foreign_slow = slow.accept_each(buffer, len(frames))
        assert foreign_fast == foreign_slow
        assert np.array_equal(fast.check, slow.check)
        assert np.array_equal(fast.age, slow.age)
        assert np.array_equal(fast.values, slow.values, equal_nan=True)
        assert fast.crc_errors == slow.crc_errors


def test_a_single_row_can_be_sealed_alone():
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
