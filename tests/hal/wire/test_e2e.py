"""E2E Profile 5 compared with the AUTOSAR reference package, and its detection of damaged frames."""

from __future__ import annotations

import random

import e2e as oracle
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_dbc import load
from atalante_hal.wire.e2e import (
    FULL,
    MAX_DELTA,
    REQUALIFY,
    SETTLED,
    Check,
    Qualification,
    check_counter,
    checksum,
    crc,
    data_id_bytes,
    intact,
    protect,
    protected_spans,
    qualify,
    suspect,
)
from atalante_hal.wire.frame import FRAME_BYTES, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

NETWORK = load()
CYCLIC = [m for m in NETWORK.received_by("HAL") if m.cycle_ms == 1]
SENT = [m for m in NETWORK.sent_by("HAL") if m.cycle_ms == 1]


@pytest.mark.parametrize("message", NETWORK.messages, ids=lambda m: m.name)
def test_crc_and_counter_bytes_equal_the_reference(message):
    rng = np.random.default_rng(message.frame_id)
    for counter in (0, 1, 127, 254, 255):
        payload = bytearray(rng.bytes(message.length))
        payload[2] = (counter - 1) & 0xFF
        ours = bytearray(payload)
        ours[2] = counter
        ours[:2] = crc(bytes(ours[2:]), data_id_bytes(message.data_id)).to_bytes(2, "little")
        oracle.p05.e2e_p05_protect(payload, message.data_id, increment_counter=True)
        assert ours == payload
        assert oracle.p05.e2e_p05_check(bytes(ours), message.data_id)


@pytest.mark.exhaustive
@pytest.mark.parametrize("messages", [CYCLIC, SENT], ids=["to the HAL", "from the HAL"])
def test_sealed_cycle_of_all_messages_equals_the_reference(messages):
    image = TransmitImage(messages)
    rng = np.random.default_rng(4)
    low = np.array([s.minimum for _, s in image.codec.signals])
    high = np.array([s.maximum for _, s in image.codec.signals])
    for cycle in range(300):
        image.values[:] = rng.uniform(low, high)
        frames = image.seal()
        for message, frame in zip(messages, frames, strict=True):
            payload = frame["data"][: message.length].tobytes()
            assert payload[2] == cycle & 0xFF
            assert oracle.p05.e2e_p05_check(payload, message.data_id)


# -- functions for several frames at once ------------------------------------------------------------------------------

SHORT, LONG = NETWORK.message("LEFT_SK_STATE"), NETWORK.message("FOOT_LEFT_STATE")


def rows_of_frames() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return two frames of random bytes, their spans, and the counters 7 and 250."""
    octets = np.random.default_rng(3).integers(0, 256, 2 * FRAME_BYTES).astype(np.uint8)
    return octets, protected_spans([SHORT, LONG]), np.array([7, 250])


def test_spans_give_the_payload_of_each_row():
    spans = protected_spans([SHORT, LONG])
    assert spans.dtype == np.int64
    assert spans.tolist() == [[8, 8 + SHORT.length, SHORT.data_id], [80, 80 + LONG.length, LONG.data_id]]
    frames = new_frames(2)
    frames["data"][1, 0] = 99
    assert frames.view(np.uint8)[spans[1, 0]] == 99


def test_checksum_covers_only_the_payload():
    octets, spans, _ = rows_of_frames()
    for begin, end, data_id in spans.tolist():
        for ours in (data_id, 0, 0xFFFF, 0x0102):
            expected = crc(octets[begin + 2 : end].tobytes(), data_id_bytes(ours))
            assert checksum(octets, begin, end, ours) == expected
    assert checksum(octets, 0, 2, 0x1234) == crc(b"", data_id_bytes(0x1234))


def test_protect_changes_only_crc_and_counter_bytes():
    octets, spans, counters = rows_of_frames()
    before = octets.copy()
    protect(octets, spans, counters)
    changed = np.flatnonzero(octets != before)
    assert set(changed) <= {8, 9, 10, 80, 81, 82}
    for message, counter, (begin, end, _) in zip((SHORT, LONG), (7, 250), spans.tolist(), strict=True):
        payload = octets[begin:end].tobytes()
        assert payload[2] == counter
        assert oracle.p05.e2e_p05_check(payload, message.data_id)


def test_every_changed_byte_makes_its_row_damaged():
    octets, spans, counters = rows_of_frames()
    assert not intact(octets, spans, counters)
    protect(octets, spans, counters)
    assert intact(octets, spans, counters) is True
    payloads = {index for begin, end, _ in spans.tolist() for index in range(begin, end)}
    for index in range(len(octets)):
        octets[index] ^= 0x10
        assert intact(octets, spans, counters) is (index not in payloads)
        octets[index] ^= 0x10
    for other in ([8, 250], [7, 249]):
        assert intact(octets, spans, np.array(other)) is False


def test_every_counter_step_has_a_check_result():
    for last in (0, 1, 200, 255):
        for delta in range(256):
            result = check_counter(last, (last + delta) & 0xFF)
            expected = (
                Check.REPEATED if delta == 0
                else Check.OK if delta == 1
                else Check.SOME_LOST if delta <= MAX_DELTA
                else Check.WRONG_SEQUENCE
            )  # fmt: skip
            assert result is expected
    assert check_counter(None, 77) is Check.OK
    assert [c for c in Check if c.fresh] == [Check.OK, Check.SOME_LOST]


def _received(messages):
    """Return a transmit and a receive process image after one cycle, and the frames of this cycle."""
    tx, rx = TransmitImage(messages), ReceiveImage(messages)
    buffer = tx.seal().copy()
    assert list(rx.accept(buffer, len(buffer))) == []
    return tx, rx, buffer


def flips(chance: random.Random, kind: int, bits: int) -> int:
    """Return a mask of flipped bits: one bit for kind 0, two bits for kind 1, else any odd number of bits."""
    if kind < 2:
        return sum(1 << bit for bit in chance.sample(range(bits), kind + 1))
    pattern = chance.getrandbits(bits)
    return pattern if pattern.bit_count() % 2 else pattern ^ 1


@pytest.mark.exhaustive
def test_one_two_or_odd_numbers_of_flipped_bits_are_rejected():
    """The test checks 100,000 damaged frames of the cyclic messages that the HAL receives."""
    tx, _, _ = _received(CYCLIC)
    good = tx.seal().copy()
    payloads = [
        int.from_bytes(good["data"][row, : message.length].tobytes(), "little") for row, message in enumerate(CYCLIC)
    ]
    chance = random.Random(5)
    rejected = 0
    for i in range(100_000):
        row = i % len(CYCLIC)
        message = CYCLIC[row]
        payload = payloads[row] ^ flips(chance, i % 3, 8 * message.length)
        damaged = payload.to_bytes(message.length, "little")
        rejected += crc(damaged[2:], data_id_bytes(message.data_id)) != int.from_bytes(damaged[:2], "little")
    assert rejected == 100_000


@pytest.mark.exhaustive
@pytest.mark.parametrize("row", range(len(CYCLIC)), ids=[m.name for m in CYCLIC])
def test_rejected_frames_leave_the_values_unchanged(row):
    for kind, expected in (
        ("damaged", Check.CRC), ("replayed", Check.WRONG_SEQUENCE), ("repeated", Check.REPEATED),
        ("swapped", Check.CRC), ("shortened", Check.LENGTH), ("lengthened", Check.LENGTH), ("classic", Check.LENGTH),
    ):  # fmt: skip
        tx, rx, buffer = _received(CYCLIC)
        oldest = buffer.copy()
        for _ in range(20):
            buffer[:] = tx.seal()
            rx.accept(buffer, len(buffer))
        newest = buffer.copy()
        values, age = rx.values.copy(), rx.age[row]
        tx.values[:] = np.array([s.maximum for _, s in tx.codec.signals])
        buffer[:] = tx.seal()
        if kind == "damaged":
            buffer["data"][row, 5] ^= 0x10
        elif kind == "replayed":
            buffer[row] = oldest[row]
        elif kind == "repeated":
            buffer[row] = newest[row]
        elif kind == "swapped":
            other = next(
                r for r, m in enumerate(CYCLIC) if (r != row and m.length >= CYCLIC[row].length) or r == len(CYCLIC) - 1
            )
            buffer["data"][row] = buffer["data"][other]
        elif kind == "shortened":
            buffer["len"][row] -= 4
        elif kind == "lengthened":
            buffer["len"][row] += 4
        elif kind == "classic":
            buffer["flags"][row] = 0
        rx.accept(buffer, len(buffer))
        own = rx.codec.row_of == row
        assert rx.check[row] == expected, kind
        assert np.array_equal(rx.values[own], values[own]), kind
        assert rx.age[row] == age + 1
        others = np.delete(np.arange(len(CYCLIC)), row)
        assert (rx.check[others] == Check.OK).all()
        assert (rx.age[others] == 0).all()


def test_frame_with_the_identifier_of_another_message_is_rejected():
    for sender in NETWORK.messages:
        payload = bytes(range(3, 3 + sender.length - 2))
        value = crc(payload, data_id_bytes(sender.data_id))
        for receiver in NETWORK.messages:
            accepted = crc(payload, data_id_bytes(receiver.data_id)) == value
            assert accepted == (receiver is sender)


# -- two senders ---------------------------------------------------------------------------------------------------------


def evidence_after(history: str, evidence: int = 0) -> int:
    """Return the counter that detects two senders, after a sequence of cycles.

    Args:
        history: one letter per cycle: r if there is a frame of a second sender, c if not.
        evidence: counter before the first cycle.
    """
    for cycle in history:
        evidence = suspect(evidence, rival=cycle == "r")
    return evidence


def test_four_cycles_with_two_senders_confirm_two_senders():
    assert [evidence_after("r" * n) for n in range(6)] == [0, 16, 32, 48, 64, 64]
    assert [evidence_after("c" * n, 64) for n in (1, 63, 64, 65)] == [63, 1, 0, 0]
    assert evidence_after("r" + "c" * 16) == 0


def test_second_sender_in_every_other_cycle_is_confirmed():
    assert evidence_after("rc" * 4) == 60
    assert evidence_after("rc" * 4 + "r") == FULL
    assert evidence_after(("r" + "c" * 16) * 50) == 0


# -- trust in a sender -------------------------------------------------------------------------------------------------


def after(history: str, start: Qualification | None = None) -> Qualification:
    """Return the qualification after a sequence of cycles.

    Args:
        history: one letter per cycle: g good, b bad, t bad and timed out, T good and timed out.
        start: qualification before the first cycle.
    """
    now = start or Qualification()
    for cycle in history:
        now = qualify(now, good=cycle in "gT", timed_out=cycle in "tT")
    return now


def test_trust_requires_16_good_cycles_in_a_row():
    assert not after("g" * 15).trusted
    assert after("g" * 16).trusted
    assert not after("g" * 15 + "b" + "g" * 15).trusted
    assert after("g" * 15 + "b" + "g" * 16).trusted


def test_good_cycle_of_a_settled_sender_returns_the_same_object():
    assert after("g" * 16) is SETTLED
    assert after("g" * 40) is SETTLED
    assert after("g" * 16) == (0, 16, True)


def test_bad_cycle_fills_the_bucket_by_4_good_cycle_empties_by_1():
    now = after("b", SETTLED)
    assert now == (4, 0, True)
    assert after("ggg", now) == (1, 3, True)
    assert after("g" * 4, now) == (0, 4, True)
    assert after("g" * 15, now) is not SETTLED
    assert after("g" * 16, now) is SETTLED


def test_trust_ends_exactly_when_the_bucket_is_full():
    assert after("b" * 15, SETTLED) == (60, 0, True)
    assert after("b" * 16, SETTLED) == (64, 0, False)
    assert after("b" * 40, SETTLED) == (64, 0, False)


def test_sender_with_a_full_bucket_is_trusted_again_after_16_good_cycles():
    assert after("b" * 16 + "g" * 15, SETTLED) == (49, 15, False)
    assert after("b" * 16 + "g" * 16, SETTLED) == (48, 16, True)
    assert after("b" * 16 + "g" * 16 + "b" * 3, SETTLED).trusted
    assert not after("b" * 16 + "g" * 16 + "b" * 4, SETTLED).trusted


@pytest.mark.parametrize("cycle", "tT")
def test_timeout_clears_the_trust_and_keeps_the_bucket(cycle: str):
    assert after("bb" + cycle, SETTLED) == (8, 0, False)
    assert after(cycle + "g" * 15, SETTLED).trusted is False
    assert after(cycle + "g" * 16, SETTLED) is SETTLED


def test_steady_loss_ends_the_trust_only_above_20_percent():
    assert after("bgggg" * 500, SETTLED).trusted
    assert not after("bggg" * 500, SETTLED).trusted


@given(st.text("gbtT", max_size=80))
def test_qualification_keeps_its_invariants_for_any_history(history: str):
    now = Qualification()
    for index, cycle in enumerate(history):
        before, now = now, after(cycle, now)
        assert 0 <= now.bucket <= FULL
        assert 0 <= now.good <= REQUALIFY
        if now.trusted and not before.trusted:
            assert history[index - REQUALIFY + 1 : index + 1] == "g" * REQUALIFY
        if before.trusted and not now.trusted:
            assert cycle in "tT" or now.bucket == FULL


def test_message_has_not_timed_out_by_default():
    before = Qualification(8, 3, True)
    assert qualify(before, good=True) == Qualification(7, 4, True)
    assert qualify(before, good=True, timed_out=True) == Qualification(8, 0, False)
