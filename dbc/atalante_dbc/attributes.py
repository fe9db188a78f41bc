"""Check of the attribute values in a DBC text, before cantools parses the text.

cantools does not check whether a value has the type that its attribute requires. Without this check, an invalid value causes
an error later or remains undetected.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

#: Attributes that the parser requires. Each attribute needs a definition (`BA_DEF_`) and a default (`BA_DEF_DEF_`).
_REQUIRED = (
    "NominalBitrate", "DataBitrate", "NodeKind", "NodeNumber", "VFrameFormat", "Bus", "GenMsgSendType", "GenMsgCycleTime",
    "GenMsgDelayTime", "TimeoutTime", "E2EDataId", "InvalidRaw",
)  # fmt: skip
_DEFINITION = re.compile(r'BA_DEF_\s+(?:(?:BU_|BO_|SG_|EV_)\s+)?"(\w+)"\s+(\w+)\s*(.*?)\s*;')
_VALUE = re.compile(r'(BA_|BA_DEF_DEF_)\s+"(\w+)"\s+(.*?)("[^"]*"|\S+)\s*;')
_INTEGER = re.compile(r"[+-]?\d{1,18}")
_RAW = re.compile(r"(0[xX][0-9a-fA-F]{1,16}|\d{1,20})?")


def wrong_values(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line number, problem) for each attribute value that is invalid or has no definition above its line."""
    definitions: dict[str, tuple[str, str]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.lstrip()
        if match := _DEFINITION.match(line):
            definitions[match[1]] = match[2], match[3]
        elif match := _VALUE.match(line):
            name, owner, value = match[2], match[3].strip() or "the network", match[4]
            if name not in definitions:
                yield number, f"the attribute {name} has no definition (BA_DEF_) above this line"
            elif valid := _valid_values(name, *definitions[name], value, by_name=match[1] == "BA_DEF_DEF_"):
                yield number, f"{name} of {owner} must be {valid}, got {value}"


def missing(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line number, problem) for each required attribute without a definition or a default. The line number is always 1."""
    for name in _REQUIRED:
        for keyword, part in (("BA_DEF_", "definition"), ("BA_DEF_DEF_", "default")):
            if not re.search(rf'^\s*{keyword}\s+[^"]*"{name}"', text, re.MULTILINE):
                yield 1, f"the attribute {name} has no {part} ({keyword})"


def _valid_values(name: str, kind: str, domain: str, value: str, *, by_name: bool) -> str:
    """Return the valid values as text if `value` is invalid. If `value` is valid, return an empty text.

    Args:
        name: name of the attribute.
        kind: type in the definition of the attribute, for example INT or ENUM.
        domain: rest of the definition, which is the range of a number or the names of an enumeration.
        value: value as written in the DBC, with its quotes if it has any.
        by_name: True if an enumeration value must be given by name, as in a default. False if its index is also valid.
    """
    if kind == "INT":
        low, high = [*domain.split(), "0", "0"][:2]
        valid = _INTEGER.fullmatch(value) and int(low) <= int(value) <= int(high)
        return "" if valid else f"a whole number from {low} to {high}"
    if kind == "ENUM":
        names = re.findall(r'"([^"]*)"', domain)
        valid = value.strip('"') in names if value.startswith('"') else value.isdecimal() and int(value) < len(names)
        return "" if valid and (value.startswith('"') or not by_name) else f"one of {', '.join(names)}"
    if name == "InvalidRaw":
        return "" if _RAW.fullmatch(value.strip('"')) else 'a raw code such as "0x8000", or ""'
    return ""
