"""Baseline of the codec benchmarks: C code that cantools generates from the DBC, compiled with gcc -O2.

The codec benchmarks are `wire.decode_cycle` and `wire.encode_cycle`.

`network -> cantools generate_c_source -> driver -> gcc -> ctypes`. The driver is a C function that does the work of the codec.
To decode, the driver unpacks the payload of each message, checks the range of every signal and converts every signal to a double.
To encode, the driver converts every double to a signal, checks its range and packs the payload. As in the HAL, received messages
are decoded and sent messages are encoded. The clock is read inside the C code, so the measured time excludes all Python code.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from atalante_dbc import DBC_FILE, Message
from atalante_hal.types import Vector
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.frame import FRAME_BYTES, HEADER_BYTES, Frames

COMPILER = "gcc"
_NODE = "HAL"
OPTIONS = ("-O2", "-fPIC")
#: Linker options. With -Bsymbolic, calls inside the library are direct, as in a standalone program.
LINK_OPTIONS = ("-shared", "-Wl,-Bsymbolic")

_TIMED = """
int64_t {name}({parameters}, int64_t repetitions)
{{
    struct timespec begin, end;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &begin);
    for (int64_t i = 0; i < repetitions; i++) {{
        {body}
    }}
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &end);
    return (int64_t)(end.tv_sec - begin.tv_sec) * 1000000000 + (end.tv_nsec - begin.tv_nsec);
}}
"""


def available() -> bool:
    """Return whether the compiler is installed."""
    return shutil.which(COMPILER) is not None


class GeneratedC:
    """Generated C code that decodes or encodes the messages of a codec.

    Row i of the frames contains message i of the codec. The values are in the order of `codec.signals`.

    Raises:
        subprocess.CalledProcessError: If the generator or the compiler fails.
    """

    def __init__(self, codec: Codec) -> None:
        header, objects = _network()
        with tempfile.TemporaryDirectory(prefix="atalante-bench-") as folder:
            driver, network, library = (Path(folder, name) for name in ("driver.c", "net.o", "driver.so"))
            Path(folder, "net.h").write_bytes(header)
            network.write_bytes(objects)
            driver.write_text(_driver(codec))
            _run([COMPILER, *OPTIONS, *LINK_OPTIONS, "-o", str(library), str(driver), str(network)])
            loaded = ctypes.CDLL(str(library))
        self._decode, self._encode = loaded.decode, loaded.encode
        self._inside = ctypes.c_bool.in_dll(loaded, "all_inside")
        for function in (self._decode, self._encode):
            function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64]
            function.restype = ctypes.c_int64

    @property
    def inside(self) -> bool:
        """Return whether the last call found all signals inside their DBC ranges."""
        return self._inside.value

    def decode(self, frames: Frames, out: Vector, repetitions: int) -> float:
        """Decode all frames into `out`, `repetitions` times. Return the mean time to decode all frames once [s]."""
        return _seconds(self._decode, frames, out, repetitions)

    def encode(self, values: Vector, frames: Frames, repetitions: int) -> float:
        """Encode `values` into all frames, `repetitions` times. Return the mean time to encode all frames once [s]."""
        return _seconds(self._encode, frames, values, repetitions)


@cache
def _network() -> tuple[bytes, bytes]:
    """Return the generated C header and the compiled functions. The result is cached to save compilation time."""
    with tempfile.TemporaryDirectory(prefix="atalante-bench-") as folder:
        generate = [sys.executable, "-m", "cantools", "generate_c_source", "--database-name", "net", "--node", _NODE]
        _run([*generate, "-o", folder, str(DBC_FILE)])
        source, objects = Path(folder, "net.c"), Path(folder, "net.o")
        _run([COMPILER, *OPTIONS, "-c", "-o", str(objects), str(source)])
        return Path(folder, "net.h").read_bytes(), objects.read_bytes()


def _seconds(function: Any, frames: Frames, values: Vector, repetitions: int) -> float:
    nanoseconds: int = function(frames.ctypes.data, values.ctypes.data, repetitions)
    return nanoseconds * 1e-9 / repetitions


def _run(command: Sequence[str]) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)


def _driver(codec: Codec) -> str:
    lines = ["#define _POSIX_C_SOURCE 199309L", "#include <stdint.h>", "#include <time.h>", '#include "net.h"']
    lines.append("volatile bool all_inside;")
    for direction, parameters, one, sent in (
        ("decode", "const uint8_t *frames, double *values", _decode_one, False),
        ("encode", "uint8_t *frames, const double *values", _encode_one, True),
    ):
        lines += [f"static void {direction}_cycle({parameters})", "{", "bool inside = true;"]
        lines += [one(codec, row, m) for row, m in enumerate(codec.messages) if (m.sender == _NODE) is sent]
        lines += ["all_inside = inside;", "}"]
        body = f"{direction}_cycle(frames, values);"
        lines.append(_TIMED.format(name=direction, parameters=parameters, body=body))
    return "\n".join(lines)


def _decode_one(codec: Codec, row: int, message: Message) -> str:
    name, body = f"net_{_c_name(message.name)}", ""
    for signal in message.signals:
        field = _c_name(signal.name)
        body += f"  inside &= {name}_{field}_is_in_range(m.{field});\n"
        body += f"  values[{codec.index(message.name, signal.name)}] = {name}_{field}_decode(m.{field});\n"
    return f"{{ struct {name}_t m; {name}_unpack(&m, frames + {_payload(row)}, {message.length}u);\n{body}}}"


def _encode_one(codec: Codec, row: int, message: Message) -> str:
    name, body = f"net_{_c_name(message.name)}", ""
    for signal in message.signals:
        field = _c_name(signal.name)
        body += f"  m.{field} = {name}_{field}_encode(values[{codec.index(message.name, signal.name)}]);\n"
        body += f"  inside &= {name}_{field}_is_in_range(m.{field});\n"
    return f"{{ struct {name}_t m;\n{body}  {name}_pack(frames + {_payload(row)}, &m, {message.length}u); }}"


def _payload(row: int) -> int:
    return row * FRAME_BYTES + HEADER_BYTES


def _c_name(name: str) -> str:
    """Convert a CamelCase name to snake_case in the same way as cantools."""
    name = re.sub(r"(.)([A-Z][a-z]+)", r"\1_\2", name)
    name = re.sub(r"(_+)", "_", name)
    return re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name).lower()
