"""An independent judge of what a HAL sent: cantools and the limits file say what is allowed, no line of the stack does.

`frames of a HAL, or a CAN log -> CommandLimits -> violations`. What holds of any frame a HAL ever sends:

- its identifier, length and format are those of a message whose sender is the HAL in the DBC;
- no target torque and no torque limit in it is beyond the joint's `torque_max`, whatever the controlword;
- from one frame that enables operation to the next the target moves by `torque_rate_max` times a cycle at most. The first
  such frame takes over what the drive holds with, and may be anything within the limit.

    python tests/witness/command_limits.py LOG...      judges CAN logs of any format python-can reads
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

#: `struct canfd_frame` of linux/can.h, written down again on purpose.
RECORD = np.dtype([("id", "<u4"), ("length", "u1"), ("flags", "u1"), ("pad", "u1", 2), ("payload", "u1", 64)])
FD = 0x04
PERIOD = 1e-3  # s
ENABLE_OPERATION = 0x0F  # CiA 402
#: Violations told in full; a run that breaks a limit breaks it often.
TOLD = 5

Records = npt.NDArray[Any]


@cache
def database() -> Any:
    """The network as cantools reads it."""
    return cantools.database.load_file(DBC_FILE)


class CommandLimits:
    """Judges the frames of one HAL in the order in which it sent them, in as many pieces as one likes."""

    def __init__(self) -> None:
        self.joints = tomllib.loads(LIMITS_FILE.read_text())["joints"]
        self.messages = {m.frame_id: m for m in database().messages if m.senders == ["HAL"]}
        self.commands = {m.frame_id: m for m in self.messages.values() if m.name.startswith("COMMAND_")}
        self.frames = 0  # judged so far
        self.command_frames = 0
        self.violations: list[str] = []
        self._last: dict[str, tuple[bool, float]] = {}  # signal -> (enabled, target) of the frame before

    def judge(self, records: Records) -> list[str]:
        """Judge frames, shape (n,) of `RECORD`; the violations found in them."""
        known = len(self.violations)
        self._judge_table(records)
        for frame_id, message in self.commands.items():
            rows = records[(records["id"] == frame_id) & (records["length"] == message.length)]
            if len(rows):
                self._judge_leg(message, rows)
                self.command_frames += len(rows)
        self.frames += len(records)
        return self.violations[known:]

    def _judge_table(self, records: Records) -> None:
        for frame_id, length, flags in {*zip(*(records[n].tolist() for n in ("id", "length", "flags")), strict=True)}:
            message = self.messages.get(frame_id)
            if message is None:
                self._tell(f"the HAL sent the identifier {frame_id:#x}, which is none of its messages")
            elif length != message.length or not flags & FD:
                self._tell(f"the HAL sent {message.name} with {length} bytes and flags {flags:#x}")

    def _judge_leg(self, message: Any, rows: Records) -> None:
        signals = {signal.name: values(signal, rows["payload"]) for signal in message.signals}
        self._confirm(message, rows, signals)
        for joint, limits in self.joints.items():
            target, largest = signals[f"{joint}_TargetTorque"], signals[f"{joint}_MaxTorque"]
            enabled = signals[f"{joint}_Controlword"] == ENABLE_OPERATION
            # Half a step of the wire: a limit need not be a whole number of steps.
            step = float(message.get_signal_by_name(f"{joint}_TargetTorque").scale)
            allowed = limits["torque_max"] + 0.5 * step
            name = f"{message.name}.{joint}"
            for row in np.flatnonzero((np.abs(target) > allowed) | (largest > allowed)).tolist():
                self._tell(
                    f"{name}: target {target[row]:.4f} Nm with limit {largest[row]:.4f} Nm, "
                    f"allowed is {limits['torque_max']} Nm (command frame {self.command_frames + row})"
                )
            before_enabled, before = self._last.get(name, (False, 0.0))
            change = np.abs(np.diff(target, prepend=before))
            both = enabled & np.concatenate([[before_enabled], enabled[:-1]])
            most = limits["torque_rate_max"] * PERIOD + 1.01 * step  # each of the two targets is rounded
            for row in np.flatnonzero(both & (change > most)).tolist():
                self._tell(
                    f"{name}: target moves by {change[row]:.4f} Nm in a cycle, allowed is "
                    f"{limits['torque_rate_max'] * PERIOD} Nm (command frame {self.command_frames + row})"
                )
            self._last[name] = bool(enabled[-1]), float(target[-1])

    @staticmethod
    def _confirm(message: Any, rows: Records, signals: dict[str, npt.NDArray[np.float64]]) -> None:
        """What was decoded in bulk is what cantools decodes, in the first and in the last frame."""
        for row in (0, -1):
            oracle = message.decode(rows["payload"][row, : message.length].tobytes(), decode_choices=False)
            for name, column in signals.items():
                if abs(float(oracle[name]) - column[row]) > 1e-9:
                    raise AssertionError(f"{message.name}.{name}: cantools reads {oracle[name]}, this {column[row]}")

    def _tell(self, violation: str) -> None:
        self.violations.append(violation)

    def told(self) -> str:
        """The first violations, one a line, and how many there are."""
        more = f"\n... {len(self.violations)} in all" if len(self.violations) > TOLD else ""
        return "\n".join(self.violations[:TOLD]) + more


def values(signal: Any, payloads: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    """Physical values of a little-endian signal, bit by bit. Shapes (n, 64) -> (n,)."""
    first, last = signal.start // 8, (signal.start + signal.length - 1) // 8
    bits = np.unpackbits(payloads[:, first : last + 1], axis=1, bitorder="little")
    bits = bits[:, signal.start - 8 * first :][:, : signal.length]
    weights = 2.0 ** np.arange(signal.length)
    if signal.is_signed:
        weights[-1] *= -1.0
    return bits @ weights * float(signal.scale) + float(signal.offset)


def read_log(path: Path, of: CommandLimits) -> Records:
    """The HAL's frames of a CAN log: those with the identifiers of its messages. Shape (n,)."""
    found = [m for m in can.LogReader(path) if m.arbitration_id in of.messages and not m.is_extended_id]
    records = np.zeros(len(found), RECORD)
    for record, message in zip(records, found, strict=True):
        record["id"], record["length"], record["flags"] = message.arbitration_id, message.dlc, FD * message.is_fd
        record["payload"][: len(message.data)] = np.frombuffer(bytes(message.data), np.uint8)
    return records


def main(paths: list[str]) -> int:
    """Judge CAN logs; 1 when a frame is outside the limits, or when there was none to judge."""
    worst = 0
    for path in paths:
        judge = CommandLimits()
        judge.judge(read_log(Path(path), judge))
        verdict = "ok" if judge.command_frames and not judge.violations else judge.told() or "no command frame in it"
        print(f"{path}: {judge.command_frames} command frames: {verdict}")
        worst |= verdict != "ok"
    return worst


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
