"""Reader and writer of small .npz files with strict checks: `file -> directory -> checksums -> headers -> named arrays`.

A damaged or hostile file cannot cause a large memory allocation. Before a member is read, the directory of the zip archive is
checked against the names and the size that the caller expects. Decompression stops at the declared size. The CRC-32 of the zip
format covers the bytes of each member but not the name. An additional member therefore contains a SHA-256 over all names, types,
shapes and bytes.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

CHECKSUM: Final = "sha256"
_SUFFIX: Final = ".npy"
_FLOAT: Final = np.dtype("<f8")


class ArrayFileError(ValueError):
    """Invalid content of an array file. The caller must add the path of the file to the message."""


def write_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write arrays to a file atomically. `read_arrays` returns the same arrays bit for bit.

    Args:
        path: path of the file, replaced if it exists.
        arrays: name -> array of 64-bit floats or text.
    """
    content = {**arrays, CHECKSUM: np.array(_checksum(arrays))}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, array in content.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array, order="C"), version=(1, 0), allow_pickle=False)
            # The default date of a ZipInfo is a constant, so the same arrays give the same file.
            archive.writestr(zipfile.ZipInfo(name + _SUFFIX), member.getvalue(), zipfile.ZIP_DEFLATED)
    unfinished = path.with_name(f"{path.name}.new")
    unfinished.write_bytes(packed.getvalue())
    unfinished.replace(path)


def read_arrays(path: Path, allowed: Collection[str], size_max: int) -> dict[str, Array]:
    """Read and check the arrays of a file written by `write_arrays`.

    Args:
        path: path of the file.
        allowed: valid names of arrays.
        size_max: largest size of the file, and largest total size of its members after decompression, in bytes.

    Returns:
        The arrays by name, read-only, each 64-bit floats or text.

    Raises:
        OSError: If the file cannot be read.
        ArrayFileError: If the content of the file is not valid.
    """
    with path.open("rb") as stream:
        packed = stream.read(size_max + 1)
    if len(packed) > size_max:
        raise ArrayFileError(f"the file must have at most {size_max} bytes, got at least {len(packed)} bytes")
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            members = _checked_directory(archive, allowed, size_max)
            arrays = {name: _array(name, _member(archive, member)) for name, member in members.items()}
    except ArrayFileError:
        raise
    except Exception as error:  # zipfile and numpy raise exceptions of many types for damaged bytes
        raise ArrayFileError(f"the zip archive or one of its arrays is damaged ({type(error).__name__})") from error
    expected = _checksum(arrays | {CHECKSUM: None})
    if (received := str(arrays.pop(CHECKSUM))) != expected:
        raise ArrayFileError(f"{CHECKSUM} must be {expected}, the checksum of the other arrays, got {received!r:.80}")
    return arrays


def _checked_directory(archive: zipfile.ZipFile, allowed: Collection[str], size_max: int) -> dict[str, zipfile.ZipInfo]:
    """Check names, compression and declared sizes of the zip members. Return a dict that maps each array name to its member."""
    members: dict[str, zipfile.ZipInfo] = {}
    for member in archive.infolist():
        name = member.filename.removesuffix(_SUFFIX)
        if member.filename != name + _SUFFIX or name not in (CHECKSUM, *allowed):
            raise ArrayFileError(
                f"each member of the archive must be one of {', '.join(n + _SUFFIX for n in sorted(allowed))}, "
                f"got {member.filename[:40]!r}"
            )
        if name in members:
            raise ArrayFileError(f"member {member.filename!r} must occur once in the archive, got it twice")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ArrayFileError(
                f"compression method of {name} must be {zipfile.ZIP_STORED} (stored) or {zipfile.ZIP_DEFLATED} (deflated), "
                f"got {member.compress_type}"
            )
        members[name] = member
    if CHECKSUM not in members:
        raise ArrayFileError(f"the archive must contain the member {CHECKSUM + _SUFFIX}, got none")
    if (declared := sum(member.file_size for member in members.values())) > size_max:
        raise ArrayFileError(f"the declared sizes of the arrays must sum to at most {size_max} bytes, got {declared}")
    return members


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Return the content of one file in the zip archive, and check that the content has the declared size.

    zipfile checks the CRC-32 of the content.
    """
    with archive.open(member) as stream:
        # `read()` without a limit would decompress the whole member, even if it is larger than declared.
        content = stream.read(member.file_size + 1)
    if len(content) != member.file_size:
        raise ArrayFileError(
            f"{member.filename} must have the declared size of {member.file_size} bytes, got {len(content)} bytes"
        )
    return content


def _array(name: str, content: bytes) -> Array:
    """Convert .npy bytes to a read-only array, and check that the number of bytes matches the shape."""
    stream = io.BytesIO(content)
    if (version := np.lib.format.read_magic(stream)) != (1, 0):
        raise ArrayFileError(f"{name} must have .npy version 1.0, got {version[0]}.{version[1]}")
    shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype != _FLOAT and not (dtype.kind == "U" and dtype.isnative):
        raise ArrayFileError(f"{name} must be an array of 64-bit floats or text, got {dtype}")
    if fortran_order:
        raise ArrayFileError(f"{name} must be in C order")
    data = content[stream.tell() :]
    # The size is computed with Python integers, because a NumPy product can overflow.
    size = dtype.itemsize
    for length in shape:
        size *= length
    if len(data) != size:
        raise ArrayFileError(f"{name} with shape {shape} must have {size} bytes, got {len(data)}")
    if dtype.kind == "U":
        # For invalid text, `decode` raises an exception here. NumPy would raise an exception only when the text is used.
        data.decode("utf-32")
    array = np.frombuffer(data, dtype).reshape(shape).copy()
    array.setflags(write=False)
    return array


def _checksum(arrays: Mapping[str, Array | None]) -> str:
    """Return the hexadecimal SHA-256 of names, types, shapes and bytes of all arrays. Arrays that are None are skipped."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        if array is not None:
            digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
