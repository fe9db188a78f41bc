"""Invalid frames are rejected, exhaustively where the space is finite: flipped bits, wrong identifier, length, range.

These tests prove F08 to F12 of the fault matrix for every message that the HAL receives. The CRC is affine: flipped bits change
it by a syndrome that depends only on the positions of these bits. So the syndromes of single bits give the syndrome of every
pattern. If 16 such syndromes have rank 16, all patterns of these 16 bits are detected.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from atalante_dbc import Message, Network
from atalante_dbc.network import FD_LENGTHS
from atalante_hal.wire.e2e import CRC_BYTES, Check, crc, data_id_bytes
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_EXTENDED, Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage


@pytest.fixture(scope="module")
def received(network: Network) -> list[Message]:
    return list(network.received_by("HAL"))


@pytest.fixture(scope="module")
def lengths(received: list[Message]) -> list[Message]:
    """Return one message of each length."""
    return list({message.length: message for message in received}.values())


def valid_frame(message: Message) -> Frames:
    """Return a sealed frame with every signal inside its range."""
    image = TransmitImage([message])
    for index, (_, signal) in enumerate(image.codec.signals):
        image.values[index] = signal.minimum + 0.25 * (signal.maximum - signal.minimum)
    return image.seal().copy()


def receiving(message: Message) -> tuple[ReceiveImage, Frames]:
    """Return a receive image that has accepted one frame of a message, and this frame."""
    image, frame = ReceiveImage([message]), valid_frame(message)
    image.new_cycle()
    image.accept_each(frame, 1)
    assert image.check[0] == Check.OK
    return image, frame


def assert_rejected(image: ReceiveImage, frames: Frames) -> list[int]:
    """Assert that the process image accepts no value of a frame; return the indices of unknown frames."""
    before = image.values.tobytes(), image.age.tolist()
    image.new_cycle()
    unknown_rows = list(image.accept_each(frames, len(frames)))
    assert image.values.tobytes() == before[0]
    assert image.age.tolist() == [age + 1 for age in before[1]]
    return unknown_rows


def following(frame: Frames, message: Message) -> Frames:
    """Return the valid frame that follows this one."""
    after = frame.copy()
    after["data"][0, 2] += 1
    return sealed(after, message)


def sealed(frame: Frames, message: Message) -> Frames:
    """Return the frame with the CRC of its payload."""
    payload = frame["data"][0, : message.length].tobytes()
    checksum = crc(payload[CRC_BYTES:], data_id_bytes(message.data_id))
    frame["data"][0, :CRC_BYTES] = list(checksum.to_bytes(2, "little"))
    return frame


def syndromes(message: Message) -> np.ndarray:
    """Return the change of (received CRC xor computed CRC) by each flipped bit, in the order of the wire. Shape (8 n,)."""
    payload, data_id = valid_frame(message)["data"][0, : message.length].tobytes(), data_id_bytes(message.data_id)

    def difference(data: bytes) -> int:
        return crc(data[CRC_BYTES:], data_id) ^ int.from_bytes(data[:CRC_BYTES], "little")

    assert difference(payload) == 0
    found = []
    for bit in range(8 * len(payload)):  # bytes in order, the highest bit of each first
        flipped = bytearray(payload)
        flipped[bit // 8] ^= 0x80 >> bit % 8
        found.append(difference(bytes(flipped)))
    pattern = np.random.default_rng(0).integers(0, 2, len(found))
    together = bytes(a ^ b for a, b in zip(payload, np.packbits(pattern).tobytes(), strict=True))
    assert difference(together) == np.bitwise_xor.reduce(np.array(found)[pattern == 1])
    return np.array(found)


def rank(vectors: list[int]) -> int:
    """Return the rank over GF(2)."""
    basis: list[int] = []
    for vector in vectors:
        for element in basis:
            vector = min(vector, vector ^ element)
        if vector:
            basis.append(vector)
    return len(basis)


def test_f08_one_two_or_an_odd_number_of_flipped_bits_are_detected(lengths: list[Message]) -> None:
    for message in lengths:
        found = syndromes(message).tolist()
        assert 0 not in found
        assert len(set(found)) == len(found), f"two bits of {message.name} cancel"
        assert {syndrome.bit_count() % 2 for syndrome in found} == {1}


def test_f08_bursts_up_to_sixteen_bits_are_detected(lengths: list[Message]) -> None:
    """Every burst after the CRC field is detected, and all but three patterns of a burst that overlaps this field.

    Profile 5 sends the CRC field first, with its low byte before its high byte. At the edges of this field, bits that are
    adjacent on the wire are therefore not adjacent in the code word. Of the 65535 patterns of such a burst, Profile 5 misses at
    most three. The CRC of CAN FD detects them."""
    for message in lengths:
        found = syndromes(message).tolist()
        for start in range(len(found) - 15):
            least = 16 if start >= 8 * CRC_BYTES else 14
            assert rank(found[start : start + 16]) >= least, f"a burst from bit {start} of {message.name}"


def test_f08_at_most_six_in_a_hundred_thousand_even_patterns_pass(lengths: list[Message]) -> None:
    random = np.random.default_rng(8)
    for message in lengths:
        found = syndromes(message)
        passed = tried = 0
        for weight in (4, 6, 8, 16, 32):
            places = random.random((20_000, len(found))).argpartition(weight, axis=1)[:, :weight]
            passed += int((np.bitwise_xor.reduce(found[places], axis=1) == 0).sum())
            tried += len(places)
        assert passed / tried <= 6e-5, message.name


def test_f08_damaged_frame_does_not_change_any_value(received: list[Message]) -> None:
    for message in received:
        image, frame = receiving(message)
        for bit in range(8 * message.length):
            damaged = following(frame, message)
            damaged["data"][0, bit // 8] ^= 1 << bit % 8
            assert_rejected(image, damaged)
            assert image.check[0] == Check.CRC


def test_f09_frame_with_the_identifier_of_another_message_is_rejected(received: list[Message]) -> None:
    for claimed, true in itertools.permutations(received, 2):
        if claimed.length != true.length:
            continue
        image, _ = receiving(claimed)
        frame = following(valid_frame(true), true)
        frame["can_id"] = claimed.frame_id
        assert_rejected(image, frame)
        assert image.check[0] == Check.CRC, f"{true.name} as {claimed.name}"


def test_f10_every_wrong_length_and_format_is_rejected(received: list[Message]) -> None:
    for message in received:
        image, frame = receiving(message)
        for length in (n for n in range(65) if n != message.length):
            wrong = following(frame, message)
            wrong["len"] = length
            assert_rejected(image, wrong)
            assert image.check[0] == Check.LENGTH
        for flags in (0, FLAG_BRS, FLAG_FDF):
            wrong = following(frame, message)
            wrong["flags"] = flags
            if flags != frame["flags"][0]:
                assert_rejected(image, wrong)
                assert image.check[0] == Check.LENGTH
        image.accept_each(following(frame, message), 1)
        assert image.check[0] == Check.OK


def test_f11_unknown_identifiers_are_ignored(received: list[Message]) -> None:
    image = ReceiveImage(received)
    known = set(image.frame_ids)
    for can_id in (*range(2048), *(ID_EXTENDED | bit for bit in (0, *(1 << n for n in range(29)), *known))):
        if can_id not in known:
            for length in (0, 8, 12, 64):
                frame = new_frames(1)
                frame["can_id"], frame["len"], frame["flags"] = can_id, length, FLAG_FDF | FLAG_BRS
                assert assert_rejected(image, frame) == [0]


def test_f12_codes_outside_the_range_of_a_signal_are_rejected(received: list[Message]) -> None:
    tried = 0
    for message in received:
        image, frame = receiving(message)
        for signal in message.signals:
            for raw in codes_outside(signal):
                frame = wrong = following(frame, message)  # a rejected frame also advances the counter
                word, shift = divmod(signal.start, 64)
                words = wrong["data"].view("<u8")[0]
                mask = (1 << signal.length) - 1
                right = int(words[word])
                words[word] = right & ~(mask << shift) & (1 << 64) - 1 | raw << shift
                assert_rejected(image, sealed(wrong, message))
                words[word] = right
                expected = Check.INVALID if raw == signal.invalid_raw else Check.RANGE
                assert image.check[0] == expected, f"{message.name}.{signal.name} = {raw:#x}"
                tried += 1
    assert tried > 200


def codes_outside(signal) -> list[int]:
    """Return raw codes that must be rejected: just outside the range, at the ends of the code space, and the invalid code."""
    low, high = (round((limit - signal.offset) / signal.factor) for limit in (signal.minimum, signal.maximum))
    first, last = (
        (-(1 << signal.length - 1), (1 << signal.length - 1) - 1) if signal.signed else (0, (1 << signal.length) - 1)
    )
    codes = {code for code in (first, low - 1, high + 1, last) if first <= code <= last and not low <= code <= high}
    unsigned = {code & (1 << signal.length) - 1 for code in codes}
    return sorted(unsigned | ({signal.invalid_raw} if signal.invalid_raw is not None else set()))


def test_every_received_message_has_a_can_fd_length(received: list[Message]) -> None:
    assert {message.length for message in received} <= set(FD_LENGTHS)
