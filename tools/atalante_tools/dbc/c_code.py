"""C of a network: pack and unpack by cantools' generator, E2E Profile 5 in the same style, and the files that prove both.

DBC -> Build -> NAME.h NAME.c (cantools)  NAME_e2e.h NAME_e2e.c (here)  host_test.c vectors.bin vectors.json Makefile
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cantools
from cantools.database.can import Database
from cantools.database.can.c_source import camel_to_snake_case, generate

import atalante_dbc
from atalante_dbc import Message, Network, Signal
from atalante_hal.e2e import CRC_BYTES, CRC_START, MAX_DELTA, Check
from atalante_tools.dbc.host_test import makefile, source
from atalante_tools.dbc.vectors import Vectors
from atalante_tools.names import find

#: Images in the vector file of the folder: enough for a test without Python.
_IMAGES: Final = 100
_HOST_TEST, _VECTORS, _EXAMPLES, _MAKEFILE = "host_test.c", "vectors.bin", "vectors.json", "Makefile"


@dataclass(frozen=True)
class Build:
    """What is generated: a whole network, or one node's share of it."""

    network: Network
    text: str  # of the DBC
    name: str  # prefix of every C name
    node: str | None

    @classmethod
    def of(cls, path: Path, node: str | None) -> Build:
        """Read a DBC.

        Raises:
            DbcError: the strict loader refuses it.
            click.UsageError: there is no such node.
        """
        network = atalante_dbc.load(path)
        names = [n.name for n in network.nodes]
        node = names[find(node, names, "node")] if node is not None else None
        return cls(network, path.read_text("cp1252"), camel_to_snake_case(path.stem), node)

    @property
    def messages(self) -> tuple[Message, ...]:
        """Messages with any C code, in DBC order."""
        return tuple(m for m in self.network.messages if self.sends(m) or self.received(m))

    def sends(self, message: Message) -> bool:
        """Whether there is a pack function."""
        return self.node in (None, message.sender)

    def received(self, message: Message) -> tuple[Signal, ...]:
        """Signals the unpack function fills; empty: there is none."""
        return tuple(s for s in message.signals if self.node is None or self.node in s.receivers)

    def c_name(self, message: Message) -> str:
        """What the C names of a message begin with, and behind an underscore the signal."""
        return f"{self.name}_{camel_to_snake_case(message.name)}"


def write(build: Build, folder: Path, seed: int) -> list[Path]:
    """Write every file of the build and return their paths. The same DBC gives the same bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    name = build.name
    header, code = _cantools(build)
    vectors = Vectors(build, seed)
    binary = b"".join([vectors.header(_IMAGES), *vectors.images(_IMAGES)])
    files: dict[str, bytes] = {
        f"{name}.h": header.encode(),
        f"{name}.c": code.encode(),
        f"{name}_e2e.h": e2e_header(build).encode(),
        f"{name}_e2e.c": e2e_source(build).encode(),
        _HOST_TEST: source(build).encode(),
        _VECTORS: binary,
        _EXAMPLES: (json.dumps(list(Vectors(build, seed).examples()), indent=1) + "\n").encode(),
        _MAKEFILE: makefile(build).encode(),
    }
    for file, content in files.items():
        (folder / file).write_bytes(content)
    return [folder / file for file in files]


def _cantools(build: Build) -> tuple[str, str]:
    # Not strict: cantools' own checks refuse less than the loader, which has already passed.
    database = cantools.database.load_string(build.text, database_format="dbc", strict=False)
    assert isinstance(database, Database)
    header, code, _, _ = generate(
        database,
        build.name,
        f"{build.name}.h",
        f"{build.name}.c",
        "",
        node_name=build.node,
        use_round=True,  # or the encoder truncates, and 0.0375 Nm leaves as 0.025
    )
    # The date of the day would make every run another file.
    header, code = (re.sub(r"(by cantools version \S+) .*", r"\1.", part) for part in (header, code))
    return header, code


def crc_table() -> list[int]:
    """CRC of each byte value: the step of CRC-16/CCITT (0x1021) a byte at a time. 256 entries."""
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
        table.append(value)
    return table


def e2e_header(build: Build) -> str:
    """Declarations of E2E protect and check."""
    name, upper = build.name, build.name.upper()
    states = "\n".join(f"    {upper}_E2E_{check.name} = {check.value}," for check in Check)
    data_ids = "\n".join(f"#define {build.c_name(m).upper()}_DATA_ID ({m.data_id:#06x}u)" for m in build.messages)
    codes = "\n".join(
        f"#define {invalid_name(build, m, s)} ({_signed(s)})"
        for m in build.messages
        for s in m.signals
        if s.invalid_raw is not None
    )
    functions = "\n".join(_declarations(build, m) for m in build.messages)
    return f"""\
/**
 * AUTOSAR E2E Profile 5 for {name}.h: a CRC over payload and Data ID, and an alive counter, in every frame.
 *
 * To send: encode, pack, protect. To receive: check, unpack, is_in_range; use the data only if check said
 * {upper}_E2E_OK or {upper}_E2E_SOME_LOST. One sender or receiver object a message.
 *
 * Generated by `atalante dbc c-code`; network hash {build.network.hash32:#010x}.
 */

#ifndef {upper}_E2E_H
#define {upper}_E2E_H

#ifdef __cplusplus
extern "C" {{
#endif

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "{name}.h"

/* What a node reports as DbcHash. */
#define {upper}_DBC_HASH ({build.network.hash32:#010x}u)

/* E2E Data IDs. */
{data_ids}

/* Raw codes that say "no value", to be packed instead of an encoded one. */
{codes}

/**
 * Result of a check. NO_DATA and RANGE are for the caller: nothing came; is_in_range() says no.
 */
enum {name}_e2e_status_t {{
{states}
}};

/**
 * Sender of one message. Begin with {{ 0 }}.
 */
struct {name}_e2e_sender_t {{
    /* Counter of the next frame. */
    uint8_t counter;
}};

/**
 * Receiver of one message. Begin with {{ 0 }}.
 */
struct {name}_e2e_receiver_t {{
    /* Counter of the last intact frame. */
    uint8_t counter;
    /* There was one. */
    bool heard;
}};

/**
 * CRC of a payload: over what follows its first {CRC_BYTES} bytes, then the Data ID, low byte first.
 *
 * @param[in] payload_p Payload of at least {CRC_BYTES + 1} bytes.
 * @param[in] size Size of the payload.
 * @param[in] data_id E2E Data ID.
 */
uint16_t {name}_e2e_crc(const uint8_t *payload_p, size_t size, uint16_t data_id);

/**
 * Protect a packed payload: next counter and CRC.
 *
 * @param[in,out] sender_p Sender of this message.
 * @param[in,out] payload_p Packed payload.
 * @param[in] size Size of the payload.
 * @param[in] length Length of the message.
 * @param[in] data_id E2E Data ID.
 *
 * @return zero(0), or negative error code if the payload is shorter than the message.
 */
int {name}_e2e_protect(
    struct {name}_e2e_sender_t *sender_p,
    uint8_t *payload_p,
    size_t size,
    size_t length,
    uint16_t data_id);

/**
 * Judge a received payload.
 *
 * @param[in,out] receiver_p Receiver of this message.
 * @param[in] payload_p Payload as received.
 * @param[in] size Length of the frame.
 * @param[in] length Length of the message.
 * @param[in] data_id E2E Data ID.
 */
enum {name}_e2e_status_t {name}_e2e_check(
    struct {name}_e2e_receiver_t *receiver_p,
    const uint8_t *payload_p,
    size_t size,
    size_t length,
    uint16_t data_id);

{functions}
#ifdef __cplusplus
}}
#endif

#endif
"""


def invalid_name(build: Build, message: Message, signal: Signal) -> str:
    """Macro of a signal's invalid code."""
    return f"{build.c_name(message)}_{camel_to_snake_case(signal.name)}".upper() + "_INVALID"


def _signed(signal: Signal) -> str:
    """Invalid code as a number of the signal's C type."""
    raw = signal.invalid_raw or 0
    return str(raw - (1 << signal.length)) if signal.signed and raw >> signal.length - 1 else f"{raw:#x}u"


def _declarations(build: Build, message: Message) -> str:
    prefix, parts = build.c_name(message), []
    if build.sends(message):
        parts.append(f"""\
/**
 * Protect a packed {message.name}; see {build.name}_e2e_protect().
 */
{_protect(build, prefix)};
""")
    if build.received(message):
        parts.append(f"""\
/**
 * Judge a received {message.name}; see {build.name}_e2e_check().
 */
{_check(build, prefix)};

/**
 * Every signal of an unpacked {message.name} is in its range; an invalid code is not.
 */
{_in_range(prefix)};
""")
    return "\n".join(parts)


def e2e_source(build: Build) -> str:
    """Definitions of E2E protect and check."""
    name, upper, entries = build.name, build.name.upper(), [f"{value:#06x}u" for value in crc_table()]
    table = "\n".join(f"    {', '.join(entries[at : at + 8])}," for at in range(0, len(entries), 8))
    functions = "\n".join(_definitions(build, m) for m in build.messages)
    return f"""\
/**
 * AUTOSAR E2E Profile 5 for {name}.c; see {name}_e2e.h. Generated by `atalante dbc c-code`.
 */

#include "{name}_e2e.h"

/* Largest step of the counter that is still fresh data. */
#define MAX_DELTA ({MAX_DELTA}u)
/* Where the counter is, behind the CRC. */
#define COUNTER ({CRC_BYTES}u)

/* CRC-16/CCITT, polynomial 0x1021, a byte at a time. */
static const uint16_t crc_table[256] = {{
{table}
}};

static uint16_t crc_step(uint16_t crc, uint8_t byte)
{{
    return (uint16_t)((uint16_t)(crc << 8) ^ crc_table[(uint8_t)((uint8_t)(crc >> 8) ^ byte)]);
}}

uint16_t {name}_e2e_crc(const uint8_t *payload_p, size_t size, uint16_t data_id)
{{
    uint16_t crc = {CRC_START:#06x}u;

    for (size_t i = COUNTER; i < size; i++) {{
        crc = crc_step(crc, payload_p[i]);
    }}

    crc = crc_step(crc, (uint8_t)(data_id & 0xffu));

    return crc_step(crc, (uint8_t)(data_id >> 8));
}}

int {name}_e2e_protect(
    struct {name}_e2e_sender_t *sender_p,
    uint8_t *payload_p,
    size_t size,
    size_t length,
    uint16_t data_id)
{{
    uint16_t crc;

    if (size < length) {{
        return (-EINVAL);
    }}

    payload_p[COUNTER] = sender_p->counter;
    sender_p->counter++;
    crc = {name}_e2e_crc(payload_p, length, data_id);
    payload_p[0] = (uint8_t)(crc & 0xffu);
    payload_p[1] = (uint8_t)(crc >> 8);

    return (0);
}}

enum {name}_e2e_status_t {name}_e2e_check(
    struct {name}_e2e_receiver_t *receiver_p,
    const uint8_t *payload_p,
    size_t size,
    size_t length,
    uint16_t data_id)
{{
    uint8_t delta;
    bool heard;

    if (size != length) {{
        return {upper}_E2E_LENGTH;
    }}

    if ({name}_e2e_crc(payload_p, size, data_id) != (uint16_t)(payload_p[0] | (uint16_t)(payload_p[1] << 8))) {{
        return {upper}_E2E_CRC;
    }}

    delta = (uint8_t)(payload_p[COUNTER] - receiver_p->counter);
    heard = receiver_p->heard;
    receiver_p->counter = payload_p[COUNTER];
    receiver_p->heard = true;

    if (!heard || delta == 1u) {{
        return {upper}_E2E_OK;
    }}

    if (delta == 0u) {{
        return {upper}_E2E_REPEATED;
    }}

    return (delta <= MAX_DELTA) ? {upper}_E2E_SOME_LOST : {upper}_E2E_WRONG_SEQUENCE;
}}

{functions}"""


def _definitions(build: Build, message: Message) -> str:
    prefix, parts = build.c_name(message), []
    length, data_id = f"{prefix.upper()}_LENGTH", f"{prefix.upper()}_DATA_ID"
    if build.sends(message):
        parts.append(f"""\
{_protect(build, prefix)}
{{
    return {build.name}_e2e_protect(sender_p, payload_p, size, {length}, {data_id});
}}
""")
    if received := build.received(message):
        signals = [camel_to_snake_case(s.name) for s in received]
        checks = "\n        && ".join(f"{prefix}_{signal}_is_in_range(msg_p->{signal})" for signal in signals)
        parts.append(f"""\
{_check(build, prefix)}
{{
    return {build.name}_e2e_check(receiver_p, payload_p, size, {length}, {data_id});
}}

{_in_range(prefix)}
{{
    return {checks};
}}
""")
    return "\n".join(parts)


def _protect(build: Build, prefix: str) -> str:
    return f"int {prefix}_protect(struct {build.name}_e2e_sender_t *sender_p, uint8_t *payload_p, size_t size)"


def _check(build: Build, prefix: str) -> str:
    return f"""\
enum {build.name}_e2e_status_t {prefix}_check(
    struct {build.name}_e2e_receiver_t *receiver_p,
    const uint8_t *payload_p,
    size_t size)"""


def _in_range(prefix: str) -> str:
    return f"bool {prefix}_is_in_range(const struct {prefix}_t *msg_p)"
