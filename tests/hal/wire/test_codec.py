"""Codec compared with cantools, an independent implementation."""

from __future__ import annotations

from dataclasses import replace

import cantools
import numpy as np
import pytest

from atalante_dbc import DBC_FILE, load
from atalante_hal.robot import JOINTS
from atalante_hal.wire.codec import INSIDE, MARKED_INVALID, OUTSIDE, Codec, group_of, read_row, scale_row
from atalante_hal.wire.frame import WORDS

NETWORK = load()
MESSAGES = NETWORK.messages
ORACLE = cantools.database.load_file(str(DBC_FILE))
IMAGES = 10_000


def limits(codec: Codec) -> tuple[np.ndarray, np.ndarray]:
    return np.array([s.minimum for _, s in codec.signals]), np.array([s.maximum for _, s in codec.signals])


def layouts() -> list[list[int]]:
    """Return the rows of the messages, grouped by layout: 68 messages have ten different layouts."""
    rows: dict[object, list[int]] = {}
    for row, message in enumerate(MESSAGES):
        signals = tuple((s.start, s.length, s.signed, s.factor, s.offset) for s in message.signals)
        rows.setdefault((message.length, signals), []).append(row)
    return list(rows.values())


def compared_rows(image: int) -> list[int]:
    """Return one row of every layout, in turn. Only these rows are compared with cantools, because cantools is slow."""
    return [rows[image % len(rows)] for rows in LAYOUTS]


LAYOUTS = layouts()


def test_decode_agrees_with_cantools_on_random_images():
    codec = Codec(MESSAGES)
    frames = codec.template()
    rng = np.random.default_rng(1)
    decoders = [ORACLE.get_message_by_name(m.name) for m in MESSAGES]
    out = np.empty(codec.size)
    positions = [[codec.index(m.name, s.name) for s in m.signals] for m in MESSAGES]
    worst = 0.0
    for image in range(IMAGES):
        frames["data"] = rng.integers(0, 256, (len(MESSAGES), 64), dtype=np.uint8)
        codec.decode(frames, out)
        for row in compared_rows(image):
            message = MESSAGES[row]
            decoded = decoders[row].decode(frames["data"][row, : message.length].tobytes(), decode_choices=False)
            for position, signal in zip(positions[row], message.signals, strict=True):
                expected = float(decoded[signal.name])
                worst = max(worst, abs(out.item(position) - expected) / max(abs(expected), 1e-6))
    assert worst <= 1e-9


def test_encode_agrees_with_cantools_bit_for_bit_on_random_images():
    codec = Codec(MESSAGES)
    low, high = limits(codec)
    rng = np.random.default_rng(2)
    encoders = [ORACLE.get_message_by_name(m.name) for m in MESSAGES]
    names = [[(s.name, codec.index(m.name, s.name)) for s in m.signals] for m in MESSAGES]
    frames = codec.template()
    for image in range(IMAGES):
        values = rng.uniform(low, high)
        codec.encode(values, frames)
        numbers = values.tolist()
        for row in compared_rows(image):
            expected = encoders[row].encode({name: numbers[i] for name, i in names[row]}, strict=False)
            assert frames["data"][row, : MESSAGES[row].length].tobytes() == expected


def test_values_are_unchanged_by_encode_and_decode():
    codec = Codec(MESSAGES)
    frames, out, again = codec.template(), np.empty(codec.size), np.empty(codec.size)
    values = np.random.default_rng(3).uniform(*limits(codec))
    codec.encode(values, frames)
    assert codec.decode(frames, out)
    codec.encode(out, frames)
    codec.decode(frames, again)
    assert np.array_equal(out, again)
    resolution = np.array([s.factor for _, s in codec.signals])
    assert np.all(np.abs(out - values) <= 0.5 * resolution * (1 + 1e-6))


def test_values_out_of_range_are_sent_as_the_nearest_valid_value():
    codec = Codec(MESSAGES)
    low, high = limits(codec)
    frames, out = codec.template(), np.empty(codec.size)
    for values, expected in ((low - 1e6, low), (high + 1e6, high), (np.full(codec.size, np.inf), high)):
        codec.encode(values, frames)
        assert codec.decode(frames, out)
        assert np.allclose(out, expected, rtol=1e-12)


def test_nan_is_sent_as_invalid_code_and_received_as_invalid():
    for message in MESSAGES:
        codec = Codec([message])
        for signal in message.signals:
            values = np.array([s.minimum for _, s in codec.signals])
            values[codec.index(message.name, signal.name)] = np.nan
            frames = codec.template()
            if signal.invalid_raw is None:
                with pytest.raises(ValueError, match=rf"{message.name}\.{signal.name}"):
                    codec.encode(values, frames)
                continue
            codec.encode(values, frames)
            raw = int.from_bytes(frames["data"][0].tobytes(), "little") >> signal.start & (1 << signal.length) - 1
            assert raw == signal.invalid_raw
            assert not codec.decode(frames, np.empty(codec.size))
            assert codec.rows_outside() == [0]


def test_raw_codes_just_outside_their_range_are_reported():
    for message in MESSAGES:
        codec = Codec([message])
        for signal in message.signals:
            low, high = (round((v - signal.offset) / signal.factor) for v in (signal.minimum, signal.maximum))
            for raw in (low - 1, high + 1):
                floor = -(1 << signal.length - 1) if signal.signed else 0
                if not floor <= raw < floor + (1 << signal.length):
                    continue
                values = np.array([s.minimum for _, s in codec.signals])
                frames = codec.template()
                codec.encode(values, frames)
                payload = int.from_bytes(frames["data"][0].tobytes(), "little")
                mask = (1 << signal.length) - 1
                payload = payload & ~(mask << signal.start) | (raw & mask) << signal.start
                frames["data"][0] = np.frombuffer(payload.to_bytes(64, "little"), np.uint8)
                assert not codec.decode(frames, np.empty(codec.size)), (message.name, signal.name, raw)


def test_unused_bits_are_sent_as_zero():
    codec = Codec(MESSAGES)
    frames = codec.template()
    frames["data"] = 0xFF
    owned = np.zeros((len(MESSAGES), 512), bool)
    for message, signal in codec.signals:
        owned[codec.rows[message.name], signal.start : signal.start + signal.length] = True
    frames["data"] = np.packbits(~owned, axis=1, bitorder="little") * 0  # a fresh image
    codec.encode(limits(codec)[1], frames)
    bits = np.unpackbits(frames["data"], axis=1, bitorder="little").astype(bool)
    assert not bits[~owned].any()


def test_quantity_of_all_joints_is_one_slice_in_order():
    states = [m for m in NETWORK.received_by("HAL") if m.cycle_ms == 1]
    codec = Codec(states)
    positions = codec.signals[codec.slice("Position")]
    assert [m.sender.lower() for m, _ in positions] == [joint.lower() for joint in JOINTS]
    torque = Codec(NETWORK.sent_by("HAL")).slice("TargetTorque")
    assert torque.stop - torque.start == 12
    force = codec.signals[codec.slice("Force")]
    assert [s.name for _, s in force[:4]] == ["FL_ForceX", "FL_ForceY", "FL_ForceZ", "FR_ForceX"]
    assert force[12][0].sender == "FOOT_RIGHT"


def test_group_of_a_signal_is_its_quantity():
    assert [group_of(n) for n in ("FH_TargetTorque", "QuaternionW", "FL_ForceX", "Velocity")] == [
        "TargetTorque", "Quaternion", "Force", "Velocity",
    ]  # fmt: skip


def test_unknown_name_error_lists_the_valid_names():
    codec = Codec(MESSAGES)
    with pytest.raises(KeyError, match="SYNC_LEFT_LEG"):
        codec.index("LEFT_KNEE", "Position")
    with pytest.raises(KeyError, match=r"the quantity must be one of TargetTorque, Position, .*Angle"):
        codec.slice("Angle")


def test_quantity_with_and_without_sign_is_rejected_if_it_is_not_contiguous():
    message = next(m for m in NETWORK.messages if m.name == "LEFT_FH_STATE")
    signals = tuple(replace(s, signed=s.name != "Position") for s in message.signals)
    codec = Codec([message, replace(message, signals=signals)])
    assert codec.slice("Velocity").stop - codec.slice("Velocity").start == 2
    with pytest.raises(KeyError, match="the signals of the quantity 'Position' must be all signed or all unsigned"):
        codec.slice("Position")


def read_one(codec: Codec, row: int, frames, offset: int = 0) -> int:
    return read_row(frames.view(np.int64), offset, row, codec.table)


def test_invalid_code_and_value_out_of_range_are_distinguished():
    message = load().message("LEFT_FH_STATE")
    codec = Codec([message])
    drive_state = next(s for s in message.signals if s.name == "DriveState")
    outside = 65 << drive_state.start  # neither in range nor its invalid code
    frames = codec.template()
    for signal in message.signals:
        invalid = 0 if signal.invalid_raw is None else signal.invalid_raw << signal.start
        for payload in (invalid, invalid if signal is drive_state else invalid | outside):
            frames["data"][0] = np.frombuffer(payload.to_bytes(64, "little"), np.uint8)
            expected = MARKED_INVALID if invalid else OUTSIDE if payload else INSIDE
            assert read_one(codec, 0, frames) == expected, signal.name


def test_single_row_is_decoded_without_changing_other_rows():
    codec = Codec(MESSAGES)
    rng = np.random.default_rng(5)
    low, high = limits(codec)
    frames, whole = codec.template(), np.zeros(codec.size)
    codec.encode(rng.uniform(low, high), frames)
    assert codec.decode(frames, whole)
    codes = codec.table.codes.copy()
    shuffled = rng.permutation(len(MESSAGES))
    single = frames[shuffled].copy()
    for position, row in enumerate(shuffled.tolist()):
        codec.table.codes.fill(-7)
        values = np.full(codec.size, np.nan)
        assert read_one(codec, row, single, (position - row) * WORDS) == INSIDE
        scale_row(row, codec.table, values)
        own = codec.row_of == row
        assert np.array_equal(values[own], whole[own])
        assert np.array_equal(codec.table.codes[own], codes[own])
        assert np.isnan(values[~own]).all()
        assert (codec.table.codes[~own] == -7).all()
