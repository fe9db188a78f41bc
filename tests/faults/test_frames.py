"""Frames that must not be believed, exhaustively where the space is finite: bits flipped, wrong identifier, length, range.

F08 to F12 of the matrix, on every message the HAL receives. The CRC is affine: what an error pattern does to it depends on the
pattern alone, so one bit's syndrome each is enough to know what any pattern does, and a rank says that none of 2^16 is missed.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from atalante_dbc import Message, Network
from atalante_hal.wire.e2e import CRC_BYTES, Check, crc, data_id_bytes
from atalante_hal.wire.frame import FD_LENGTHS, FLAG_BRS, FLAG_FDF, ID_EXTENDED, Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage


@pytest.fixture(scope="module")
def received(network: Network) -> list[Message]:
    return list(network.received_by("HAL"))


@pytest.fixture(scope="module")
def lengths(received: list[Message]) -> list[Message]:
    """One message of each length."""
    return list({message.length: message for message in received}.values())


def valid_frame(message: Message) -> Frames:
    """A frame with every signal somewhere inside its range, sealed."""
    image = TransmitImage([message])
    for place, (_, signal) in enumerate(image.codec.signals):
        image.values[place] = signal.minimum + 0.25 * (signal.maximum - signal.minimum)
    return image.seal().copy()


def listening(message: Message) -> tuple[ReceiveImage, Frames]:
    """An image that has believed one frame of a message, and that frame."""
    image, frame = ReceiveImage([message]), valid_frame(message)
    image.new_cycle()
    image.accept_each(frame, 1)
    assert image.check[0] == Check.OK
    return image, frame


def refused(image: ReceiveImage, frames: Frames) -> list[int]:
    """Offer a frame: nothing of it may be taken over. Returns the places of frames that are nobody's."""
    before = image.values.tobytes(), image.age.tolist()
    image.new_cycle()
    foreign = list(image.accept_each(frames, len(frames)))
    assert image.values.tobytes() == before[0]
    assert image.age.tolist() == [age + 1 for age in before[1]]
    return foreign


def following(frame: Frames, message: Message) -> Frames:
    """The frame after this one, right in everything."""
    after = frame.copy()
    after["data"][0, 2] += 1
    return sealed(after, message)


def sealed(frame: Frames, message: Message) -> Frames:
    """With the CRC that belongs to the payload."""
    payload = frame["data"][0, : message.length].tobytes()
    checksum = crc(payload[CRC_BYTES:], data_id_bytes(message.data_id))
    frame["data"][0, :CRC_BYTES] = list(checksum.to_bytes(2, "little"))
    return frame


def syndromes(message: Message) -> np.ndarray:
    """What flipping each bit of the payload does to CRC received xor CRC computed, in the order of the wire. Shape (8 n,)."""
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
    """Over GF(2)."""
    basis: list[int] = []
    for vector in vectors:
        for element in basis:
            vector = min(vector, vector ^ element)
        if vector:
            basis.append(vector)
    return len(basis)


def test_f08_one_two_and_any_odd_number_of_bits_flipped_are_noticed(lengths: list[Message]) -> None:
    for message in lengths:
        found = syndromes(message).tolist()
        assert 0 not in found
        assert len(set(found)) == len(found), f"two bits of {message.name} cancel"
        assert {syndrome.bit_count() % 2 for syndrome in found} == {1}


def test_f08_bursts_up_to_sixteen_bits_are_noticed(lengths: list[Message]) -> None:
    """Profile 5 sends the CRC first and its low byte before the high one, so a burst over an edge of that field is no burst
    of the code: of the 65535 patterns in such a window up to three pass, and CAN FD's own CRC has to find them."""
    for message in lengths:
        found = syndromes(message).tolist()
        for start in range(len(found) - 15):
            least = 16 if start >= 8 * CRC_BYTES else 14
            assert rank(found[start : start + 16]) >= least, f"a burst from bit {start} of {message.name}"


def test_f08_of_random_even_weights_fewer_than_six_in_a_hundred_thousand_pass(lengths: list[Message]) -> None:
    random = np.random.default_rng(8)
    for message in lengths:
        found = syndromes(message)
        passed = tried = 0
        for weight in (4, 6, 8, 16, 32):
            places = random.random((20_000, len(found))).argpartition(weight, axis=1)[:, :weight]
            passed += int((np.bitwise_xor.reduce(found[places], axis=1) == 0).sum())
            tried += len(places)
        assert passed / tried <= 6e-5, message.name


def test_f08_a_damaged_frame_changes_nothing(received: list[Message]) -> None:
    for message in received:
        image, frame = listening(message)
        for bit in range(8 * message.length):
            damaged = following(frame, message)
            damaged["data"][0, bit // 8] ^= 1 << bit % 8
            refused(image, damaged)
            assert image.check[0] == Check.CRC


def test_f09_no_message_passes_under_the_identifier_of_another(received: list[Message]) -> None:
    for claimed, true in itertools.permutations(received, 2):
        if claimed.length != true.length:
            continue
        image, _ = listening(claimed)
        frame = following(valid_frame(true), true)
        frame["can_id"] = claimed.frame_id
        refused(image, frame)
        assert image.check[0] == Check.CRC, f"{true.name} as {claimed.name}"


def test_f10_every_other_length_and_format_is_refused(received: list[Message]) -> None:
    for message in received:
        image, frame = listening(message)
        for length in (n for n in range(65) if n != message.length):
            wrong = following(frame, message)
            wrong["len"] = length
            refused(image, wrong)
            assert image.check[0] == Check.LENGTH
        for flags in (0, FLAG_BRS, FLAG_FDF):
            wrong = following(frame, message)
            wrong["flags"] = flags
            if flags != frame["flags"][0]:
                refused(image, wrong)
                assert image.check[0] == Check.LENGTH
        image.accept_each(following(frame, message), 1)
        assert image.check[0] == Check.OK


def test_f11_every_other_identifier_is_nobodys(received: list[Message]) -> None:
    image = ReceiveImage(received)
    known = set(image.frame_ids)
    for can_id in (*range(2048), *(ID_EXTENDED | bit for bit in (0, *(1 << n for n in range(29)), *known))):
        if can_id not in known:
            for length in (0, 8, 12, 64):
                frame = new_frames(1)
                frame["can_id"], frame["len"], frame["flags"] = can_id, length, FLAG_FDF | FLAG_BRS
                assert refused(image, frame) == [0]


def test_f12_every_code_outside_the_range_of_a_signal_is_refused(received: list[Message]) -> None:
    tried = 0
    for message in received:
        image, frame = listening(message)
        for signal in message.signals:
            for raw in codes_outside(signal):
                frame = wrong = following(frame, message)  # a refused frame moves the counter on all the same
                word, shift = divmod(signal.start, 64)
                words = wrong["data"].view("<u8")[0]
                mask = (1 << signal.length) - 1
                right = int(words[word])
                words[word] = right & ~(mask << shift) & (1 << 64) - 1 | raw << shift
                refused(image, sealed(wrong, message))
                words[word] = right
                expected = Check.INVALID if raw == signal.invalid_raw else Check.RANGE
                assert image.check[0] == expected, f"{message.name}.{signal.name} = {raw:#x}"
                tried += 1
    assert tried > 200


def codes_outside(signal) -> list[int]:
    """Raw codes, as unsigned bits, just outside the range, at the end of the code space, and the invalid code."""
    low, high = (round((limit - signal.offset) / signal.factor) for limit in (signal.minimum, signal.maximum))
    first, last = (
        (-(1 << signal.length - 1), (1 << signal.length - 1) - 1) if signal.signed else (0, (1 << signal.length) - 1)
    )
    codes = {code for code in (first, low - 1, high + 1, last) if first <= code <= last and not low <= code <= high}
    unsigned = {code & (1 << signal.length) - 1 for code in codes}
    return sorted(unsigned | ({signal.invalid_raw} if signal.invalid_raw is not None else set()))


def test_lengths_are_those_of_can_fd(received: list[Message]) -> None:
    assert {message.length for message in received} <= set(FD_LENGTHS)
