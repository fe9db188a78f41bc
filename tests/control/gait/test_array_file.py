"""Damaged .npz files: 2,000 random corruptions of the shipped network raise one error or change nothing, in little memory."""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from atalante_control.dynamics.gait_network import DEFAULT_NETWORK, GaitNetwork, NetworkError, load_network
from atalante_control.gait.array_file import ArrayFileError, read_arrays, write_arrays

SHIPPED = DEFAULT_NETWORK.read_bytes()
SEEDS = 400  # number of files for each of the five kinds of corruption
#: Memory that a load may allocate [bytes]. The largest valid file has 0.4 MB.
MEMORY_MAX = 4_000_000
BOMB_SIZE = 256_000_000  # bytes after decompression
STORED, DEFLATED = 0, 8


@dataclass(frozen=True)
class Member:
    """A member of a zip archive: the fields of its headers, correct or not, and its compressed bytes."""

    name: str
    packed: bytes
    size: int
    crc: int
    method: int = DEFLATED
    flags: int = 0


def member(name: str, content: bytes) -> Member:
    compressor = zlib.compressobj(wbits=-15)
    return Member(name, compressor.compress(content) + compressor.flush(), len(content), zlib.crc32(content))


def archive(members: list[Member]) -> bytes:
    """Return a zip file. The module zipfile writes only correct headers, so this function writes the bytes itself."""
    body, directory = b"", b""
    for m in members:
        name = m.name.encode()
        common = struct.pack("<HHHHHLLLHH", 20, m.flags, m.method, 0, 33, m.crc, len(m.packed), m.size, len(name), 0)
        directory += b"PK\1\2" + struct.pack("<H", 20) + common + struct.pack("<HHHLL", 0, 0, 0, 0, len(body)) + name
        body += b"PK\3\4" + common + name + m.packed
    count = len(members) % 65536
    return body + directory + b"PK\5\6" + struct.pack("<HHHHLLH", 0, 0, count, count, len(directory), len(body), 0)


@cache
def members() -> tuple[tuple[str, bytes], ...]:
    with zipfile.ZipFile(io.BytesIO(SHIPPED)) as file:
        return tuple((name, file.read(name)) for name in file.namelist())


@cache
def packed() -> tuple[Member, ...]:
    return tuple(member(*item) for item in members())


@cache
def bomb() -> Member:
    """Return a valid array of zeros that expands to `BOMB_SIZE`."""
    compressor = zlib.compressobj(wbits=-15)
    zeros, head = bytes(1_000_000), header("<f8", (BOMB_SIZE // 8,))
    content, crc = compressor.compress(head), zlib.crc32(head)
    for _ in range(BOMB_SIZE // len(zeros)):
        content, crc = content + compressor.compress(zeros), zlib.crc32(zeros, crc)
    return Member("", content + compressor.flush(), len(head) + BOMB_SIZE, crc)


def header(descr: object, shape: object, *, fortran: object = False) -> bytes:
    text = f"{{'descr': {descr!r}, 'fortran_order': {fortran!r}, 'shape': {shape!r}, }}".encode()
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text) + 1) + text + b"\n"


def flipped(rng: random.Random) -> bytes:
    """Flip one to three bits. In half of the files, the flipped bits are in the directory at the end of the file."""
    content = bytearray(SHIPPED)
    first = rng.choice((0, len(content) - 900))
    for _ in range(rng.randint(1, 3)):
        content[rng.randrange(first, len(content))] ^= 1 << rng.randrange(8)
    return bytes(content)


def cut(rng: random.Random) -> bytes:
    """Remove bytes at the end or in the middle, or repeat some bytes."""
    a, b = sorted(rng.randrange(len(SHIPPED)) for _ in range(2))
    return rng.choice((SHIPPED[:a], SHIPPED[:a] + SHIPPED[b:], SHIPPED[:b] + SHIPPED[a:], SHIPPED[a:], bytes(a)))


def swapped(rng: random.Random) -> bytes:
    """Swap, duplicate, remove or rename valid members."""
    found = list(packed())
    kind, (i, j) = rng.randrange(4), rng.sample(range(len(found)), 2)
    if kind == 0:
        found[i], found[j] = replace(found[i], name=found[j].name), replace(found[j], name=found[i].name)
    elif kind == 1:
        found.insert(j, found[i])
    elif kind == 2:
        del found[i]
    else:
        name = rng.choice(
            ("", "x.npy", "../low.npy", "low", "weights_99.npy", "low.npy/", "file.npy", "\N{BLACK STAR}")
        )
        found[i] = replace(found[i], name=name)
    return archive(found)


def misdescribed(rng: random.Random) -> bytes:
    """Change type or size in a .npy header; the CRC-32 is correct."""
    items = list(members())
    i = rng.randrange(len(items))
    name, content = items[i]
    data = content[content.index(b"\n") + 1 :]
    floats = len(data) // 8
    descr = rng.choice(
        ("<f8", "|O", ">f8", "<c16", "<i8", "<f4", "<U1", "<U9999999", "V8", "|S8", "<M8[s]", [("a", "<f8")], 3)
    )
    shape = rng.choice((
        (10**9,), (floats + 1,), (10**6, 10**6), (2**62, 4), (2**64,), (-1,), (-8, -1), (-floats,), (0,), (), "x", None,
        (floats, 1, 1), (1.5,), (True,), (floats * 10**400,), (1,) * 70,
    ))  # fmt: skip
    head = rng.choice((
        header(descr, shape), header(descr, shape, fortran=True), header("<f8", (floats,), fortran="maybe"),
        b"\x93NUMPY\2\0" + content[8:], b"\x93NUMPY\1\0\xff\xff" + b"(" * 65535, b"\x93NUMPY\1\0\x90\x01" + b"[" * 400,
        b"\x93NUMPY\1\0\4\0'''\n", b"\x93NUMPY\1\0\2\0L\n", b"PICKLE", b"\x80\x04",
    ))  # fmt: skip
    items[i] = name, head + data
    return archive([member(*item) for item in items])


def oversized(rng: random.Random) -> bytes:
    """Let a member expand to 256 MB or have a false size, or add thousands of members."""
    found = list(packed())
    i = rng.randrange(len(found))
    name, valid = found[i].name, found[i]
    found[i] = rng.choice((
        replace(bomb(), name=name), replace(bomb(), name=name, size=valid.size), replace(bomb(), name=name, size=300_000),
        replace(bomb(), name=name, size=0), replace(bomb(), name=name, method=STORED), replace(valid, size=2**32 - 1),
        replace(valid, size=valid.size - 1), replace(valid, size=valid.size + 1), replace(valid, size=0),
        replace(valid, method=rng.choice((STORED, 12, 14, 93, 99))), replace(valid, flags=1), replace(valid, flags=32),
    ))  # fmt: skip
    if not rng.randrange(8):
        found += [replace(valid, packed=b"", name=f"{n:x}") for n in range(rng.choice((100, 3_000)))]
    return archive(found)


def same(network: GaitNetwork, other: GaitNetwork) -> bool:
    arrays = [[n.low, n.high, *(array for layer in n.layers for array in layer)] for n in (network, other)]
    return network.version == other.version and all(
        a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in zip(*arrays, strict=True)
    )


@contextmanager
def little_memory() -> Iterator[None]:
    tracemalloc.reset_peak()
    before, _ = tracemalloc.get_traced_memory()
    yield
    assert tracemalloc.get_traced_memory()[1] - before < MEMORY_MAX


@pytest.mark.parametrize("corrupt", [flipped, cut, swapped, misdescribed, oversized])
@pytest.mark.long
def test_corrupted_network_is_rejected_or_unchanged(corrupt: Callable[[random.Random], bytes], tmp_path: Path) -> None:
    intact, path, rejected = load_network(), tmp_path / "network.npz", 0
    contents = [corrupt(random.Random(seed)) for seed in range(SEEDS)]
    tracemalloc.start()
    try:
        for seed, content in enumerate(contents):
            path.write_bytes(content)
            with little_memory():
                try:
                    assert same(load_network(path), intact), seed
                except NetworkError as error:
                    rejected += 1
                    message = str(error)
                    assert message.startswith(f"{path} is not a valid gait network: "), seed
                    assert message.endswith("; make it with `atalante gait fit`"), seed
                    assert "\n" not in message, seed
    finally:
        tracemalloc.stop()
    # Flipped bits of a date or a comment have no effect; every other corruption is found.
    assert rejected > (0.7 * SEEDS if corrupt is flipped else 0.98 * SEEDS)


def test_repacked_network_is_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "network.npz"
    path.write_bytes(archive(list(packed())))
    assert same(load_network(path), load_network())


def test_swapped_biases_are_found_by_the_checksum(tmp_path: Path) -> None:
    names = {"bias_0.npy": "bias_1.npy", "bias_1.npy": "bias_0.npy"}
    path = tmp_path / "network.npz"
    path.write_bytes(archive([replace(m, name=names.get(m.name, m.name)) for m in packed()]))
    with pytest.raises(NetworkError, match=r"sha256 must be \w+, the checksum of the other arrays"):
        load_network(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_bzip2_and_lzma_archives_are_rejected(tmp_path: Path, method: int) -> None:
    path = tmp_path / "network.npz"
    with zipfile.ZipFile(path, "w", method) as file:
        for name, content in members():
            file.writestr(name, content)
    with pytest.raises(
        NetworkError, match=rf"compression method of low must be 0 \(stored\) or 8 \(deflated\), got {method}"
    ):
        load_network(path)


def test_file_above_the_size_limit_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "arrays.npz"
    write_arrays(path, {"a": np.zeros(4)})
    size = path.stat().st_size
    with path.open("ab") as file:
        file.truncate(10**12)  # sparse
    with pytest.raises(ArrayFileError, match=f"at most {size} bytes"):
        read_arrays(path, ["a"], size)
    with pytest.raises(NetworkError, match="the file must have at most"):
        load_network(Path("/dev/zero"))


def test_arrays_are_read_back_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "arrays.npz"
    arrays = {"a": np.array([[1.0, -0.0], [np.nan, np.inf]]).T, "text": np.array(["e", "\N{GREEK SMALL LETTER XI}"])}
    write_arrays(path, arrays)
    back = read_arrays(path, arrays, 10_000)
    assert {name: array.tobytes() for name, array in back.items()} == {
        name: array.tobytes() for name, array in arrays.items()
    }
    assert all(not array.flags.writeable for array in back.values())
    first = path.read_bytes()
    write_arrays(path, arrays)
    assert path.read_bytes() == first
    assert [entry.name for entry in tmp_path.iterdir()] == ["arrays.npz"]
