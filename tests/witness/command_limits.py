"""Check the frames that a HAL sent, with cantools and the limits file but without any code of the stack.

`frames of a HAL, or a CAN log -> CommandLimits -> violations`. The rules for every frame that a HAL sends:

- its identifier, length and format are those of a message whose sender is the HAL in the DBC;
- the magnitude of each target torque and torque limit is at most the `torque_max` of the joint, for every controlword;
- between two consecutive frames that enable operation, the target torque changes by at most `torque_rate_max` times 1 ms. The
  first such frame may have any torque within the limit, because it takes over the torque of the position hold.

    python tests/witness/command_limits.py LOG...      checks CAN logs of any format python-can reads
"""

from __future__ import annotations

import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import numpy.typing as npt

ROOT = Path(__file__).resolve().parents[2]
DBC_FILE = ROOT / "dbc" / "atalante_dbc" / "atalante.dbc"
LIMITS_FILE = ROOT / "atalante_hal" / "robot.toml"

#: `struct canfd_frame` of linux/can.h, defined again to be independent of the stack.
RECORD = np.dtype([("id", "<u4"), ("length", "u1"), ("flags", "u1"), ("pad", "u1", 2), ("payload", "u1", 64)])
FD = 0x04
PERIOD = 1e-3  # s
ENABLE_OPERATION = 0x0F  # CiA 402
#: Largest number of violations in a summary. A run that violates a limit usually does so in many frames.
LISTED = 5

Records = npt.NDArray[Any]


@cache
def database() -> Any:
    """Return the DBC as parsed by cantools."""
    return cantools.database.load_file(DBC_FILE)


class CommandLimits:
    """Check the frames of one HAL in the order in which it sent them, in any number of batches."""

    def __init__(self) -> None:
        self.joints = tomllib.loads(LIMITS_FILE.read_text())["joints"]
        self.messages = {m.frame_id: m for m in database().messages if m.senders == ["HAL"]}
        self.commands = {m.frame_id: m for m in self.messages.values() if m.name.startswith("COMMAND_")}
        self.frames = 0  # checked so far
        self.command_frames = 0
        self.violations: list[str] = []
        self._last: dict[str, tuple[bool, float]] = {}  # joint -> (enabled, target) of the last frame

    def check(self, records: Records) -> list[str]:
        """Check frames, shape (n,) of `RECORD`; return the violations found in them."""
        known = len(self.violations)
        self._check_table(records)
        for frame_id, message in self.commands.items():
            rows = records[(records["id"] == frame_id) & (records["length"] == message.length)]
            if len(rows):
                self._check_leg(message, rows)
                self.command_frames += len(rows)
        self.frames += len(records)
        return self.violations[known:]

    def _check_table(self, records: Records) -> None:
        for frame_id, length, flags in {*zip(*(records[n].tolist() for n in ("id", "length", "flags")), strict=True)}:
            message = self.messages.get(frame_id)
            if message is None:
                self._report(f"the HAL sent the identifier {frame_id:#x}, which is none of its messages")
            elif length != message.length or not flags & FD:
                self._report(f"the HAL sent {message.name} with {length} bytes and flags {flags:#x}")

    def _check_leg(self, message: Any, rows: Records) -> None:
        signals = {signal.name: values(signal, rows["payload"]) for signal in message.signals}
        self._confirm(message, rows, signals)
        for joint, limits in self.joints.items():
            target, largest = signals[f"{joint}_TargetTorque"], signals[f"{joint}_MaxTorque"]
            enabled = signals[f"{joint}_Controlword"] == ENABLE_OPERATION
            # Half a resolution step is tolerated, because a limit need not be a multiple of the resolution.
            step = float(message.get_signal_by_name(f"{joint}_TargetTorque").scale)
            allowed = limits["torque_max"] + 0.5 * step
            name = f"{message.name}.{joint}"
            for row in np.flatnonzero((np.abs(target) > allowed) | (largest > allowed)).tolist():
                self._report(
                    f"{name}: target {target[row]:.4f} Nm with limit {largest[row]:.4f} Nm, "
                    f"allowed is {limits['torque_max']} Nm (command frame {self.command_frames + row})"
                )
            before_enabled, before = self._last.get(name, (False, 0.0))
            change = np.abs(np.diff(target, prepend=before))
            both = enabled & np.concatenate([[before_enabled], enabled[:-1]])
            most = limits["torque_rate_max"] * PERIOD + 1.01 * step  # each of the two targets is rounded
            for row in np.flatnonzero(both & (change > most)).tolist():
                self._report(
                    f"{name}: target moves by {change[row]:.4f} Nm in a cycle, allowed is "
                    f"{limits['torque_rate_max'] * PERIOD} Nm (command frame {self.command_frames + row})"
                )
            self._last[name] = bool(enabled[-1]), float(target[-1])

    @staticmethod
    def _confirm(message: Any, rows: Records, signals: dict[str, npt.NDArray[np.float64]]) -> None:
        """Raise AssertionError if cantools decodes the first or the last frame to other values."""
        for row in (0, -1):
            oracle = message.decode(rows["payload"][row, : message.length].tobytes(), decode_choices=False)
            for name, column in signals.items():
                if abs(float(oracle[name]) - column[row]) > 1e-9:
                    raise AssertionError(f"{message.name}.{name}: cantools reads {oracle[name]}, this {column[row]}")

    def _report(self, violation: str) -> None:
        self.violations.append(violation)

    def summary(self) -> str:
        """Return the first violations, one per line, and the total number of violations if more were found."""
        more = f"\n... {len(self.violations)} in all" if len(self.violations) > LISTED else ""
        return "\n".join(self.violations[:LISTED]) + more


def values(signal: Any, payloads: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    """Return the physical values of a little-endian signal, bit by bit. Shapes (n, 64) -> (n,)."""
    first, last = signal.start // 8, (signal.start + signal.length - 1) // 8
    bits = np.unpackbits(payloads[:, first : last + 1], axis=1, bitorder="little")
    bits = bits[:, signal.start - 8 * first :][:, : signal.length]
    weights = 2.0 ** np.arange(signal.length)
    if signal.is_signed:
        weights[-1] *= -1.0
    return bits @ weights * float(signal.scale) + float(signal.offset)


def read_log(path: Path, of: CommandLimits) -> Records:
    """Return the frames of a CAN log with the identifiers of the HAL. Shape (n,)."""
    with can.LogReader(path) as log:
        found = [m for m in log if m.arbitration_id in of.messages and not m.is_extended_id]
    records = np.zeros(len(found), RECORD)
    for record, message in zip(records, found, strict=True):
        record["id"], record["length"], record["flags"] = message.arbitration_id, message.dlc, FD * message.is_fd
        record["payload"][: len(message.data)] = np.frombuffer(bytes(message.data), np.uint8)
    return records


def main(paths: list[str]) -> int:
    """Check CAN logs; return 1 if a log is unreadable, violates the limits or has no command frame, and 2 if there is no log."""
    if not paths:
        print("usage: python tests/witness/command_limits.py LOG...", file=sys.stderr)
        return 2
    worst = 0
    for path in paths:
        check = CommandLimits()
        try:
            check.check(read_log(Path(path), check))
        except (OSError, ValueError) as error:  # a missing file, an unknown suffix, a line of another format
            print(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}")
            worst = 1
            continue
        verdict = "ok" if check.command_frames and not check.violations else check.summary() or "no command frame in it"
        print(f"{path}: {check.command_frames} command frames: {verdict}")
        worst |= verdict != "ok"
    return worst


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
