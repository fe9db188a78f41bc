"""Fuzzer of the HAL and every emulated node. It checks that no frame raises an exception, and no invalid frame has an effect.

There are four kinds of fuzzed frames:

- sweep: every combination of identifier, length and flags;
- random: random frames, including headers that no bus would deliver;
- damaged: frames of the robot with inverted bits;
- resealed: frames of the robot with changed content and a correct CRC, as a defective node would send.

The fuzzed frames are mixed with the frames of the robot in each batch that a bus delivers.

    python tests/fuzz/frame_fuzzer.py --frames 10000000     or `make fuzz`
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import e2e
import numpy as np

import atalante_dbc
from atalante_control.model import ExoskeletonParameters, urdf
from atalante_dbc import Message, Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus import Bus
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot, load_robot
from atalante_hal.types import Command, SupervisorState
from atalante_hal.wire.frame import FLAG_FDF, FRAME_BYTES, Frames, as_words, header_word, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage
from atalante_tools.console.terminal import Progress, print_message

SWEEP = 2048 * 65 * 8  # number of combinations of identifier, length and flags (BRS, ESI, FDF)
#: Largest number of frames that one `receive` of the HAL or the emulator returns.
RECEIVE_BUDGET = 128
#: Share of the frames that the complete HAL and the emulated robot receive. Single process images receive all other frames.
ROBOT_SHARE = 0.1
SHARES = (0.2, 0.2, 0.45, 0.15)  # shares of the four kinds: sweep, random, damaged, resealed


class Fuzzer:
    """Generator of fuzzed frames. Equal seeds give equal frames."""

    def __init__(self, seed: int, messages: Sequence[Message]) -> None:
        self._rng = np.random.default_rng(seed)
        self._data_ids = {m.frame_id: m.data_id for m in messages}
        self._swept = int(self._rng.integers(SWEEP))

    def frames(self, count: int, genuine: Frames) -> Frames:
        """Return frames of every kind in random order; mutated frames are made from `genuine`. Shape (count,)."""
        rng = self._rng
        sweep, anything, damaged, sealed = rng.multinomial(count, SHARES).tolist()
        made = new_frames(count)
        parts = np.split(made, np.cumsum([sweep, anything, damaged]))
        made["data"] = rng.integers(0, 256, (count, 64), np.uint8)
        self._sweep(parts[0], sweep)
        parts[1]["can_id"] = rng.integers(0, 1 << 32, anything) & rng.choice(
            [0x7FF, 0x7FF, 0x9FFFFFFF, 0xFFFFFFFF], anything
        )
        parts[1]["len"], parts[1]["flags"] = rng.integers(0, 256, (2, anything))
        if len(genuine):
            parts[2][:] = genuine[rng.integers(0, len(genuine), damaged)]
            self._damage(parts[2])
            parts[3][:] = genuine[rng.integers(0, len(genuine), sealed)]
            self._seal_again(parts[3])
        return made[rng.permutation(count)]

    def _sweep(self, frames: Frames, count: int) -> None:
        index = np.arange(self._swept, self._swept + count) % SWEEP
        self._swept += count
        frames["can_id"], rest = index % 2048, index // 2048
        frames["len"], frames["flags"] = rest % 65, rest // 65

    def _damage(self, frames: Frames) -> None:
        """Change one to three bits of the payload, or a byte of the header."""
        rng, rows = self._rng, np.arange(len(frames))
        octets = frames.view(np.uint8).reshape(-1, FRAME_BYTES)
        for _ in range(int(rng.integers(1, 4))):
            bit = rng.integers(0, 8 * np.maximum(frames["len"].astype(np.int64), 1))
            octets[rows, 8 + bit // 8 % 64] ^= (1 << bit % 8).astype(np.uint8)
        header = rng.random(len(frames)) < 0.3
        octets[rows[header], rng.integers(0, 6, header.sum())] = rng.integers(0, 256, header.sum())

    def _seal_again(self, frames: Frames) -> None:
        """Replace the content after the counter, set a counter that may be the next, and reseal the frame."""
        rng = self._rng
        steps = rng.integers(-2, 8, len(frames)).tolist()
        for frame, step in zip(frames, steps, strict=True):
            length = int(frame["len"])
            payload = bytearray(frame["data"][:length].tobytes())
            payload[2] = (payload[2] + step) & 0xFF
            first, last = sorted(rng.integers(3, length + 1, 2).tolist())
            payload[first:last] = rng.bytes(last - first)
            e2e.p05.e2e_p05_protect(payload, self._data_ids[int(frame["can_id"])], increment_counter=False)
            frame["data"][:length] = np.frombuffer(payload, np.uint8)


class Oracle:
    """Reference that decides which frames are intact. It computes the CRC with autosar-e2e, not with the code under test."""

    def __init__(self, messages: Sequence[Message]) -> None:
        flags = FLAG_FDF | 1
        self._messages = {header_word(m.frame_id, m.length, flags): m for m in messages}

    def intact(self, frames: Frames) -> dict[int, set[bytes]]:
        """Return, by identifier, the payloads of the frames with a valid header and CRC."""
        found: dict[int, set[bytes]] = {}
        for index, header in enumerate(as_words(frames)[:, 0].tolist()):
            message = self._messages.get(header & 0xFFFF_FFFF_FFFF)
            if message is None or header >> 48:
                continue
            payload = frames["data"][index, : message.length].tobytes()
            if e2e.p05.e2e_p05_check(payload, message.data_id):
                found.setdefault(message.frame_id, set()).add(payload)
        return found


class Finding(AssertionError):  # noqa: N818
    """Error that reports a defect that the fuzzer found."""


@dataclass
class Tally:
    """Counts of a fuzz run."""

    frames: int = 0  # number of fuzzed frames
    intact: int = 0  # fuzzed frames that are intact, by chance or because they were resealed
    cycles: int = 0


# -- a process image alone ---------------------------------------------------------------------------------------------


def fuzz_image(messages: Sequence[Message], frames: int, seed: int, per_cycle: int = 100) -> Iterator[Tally]:
    """Fuzz a process image, and check that each committed value is in range and from an intact frame of this cycle.

    Yield the tally every 200 cycles and at the end.

    Raises:
        Finding: If the process image committed a value that is out of range, or not from an intact frame of this cycle.
    """
    fuzzer, oracle, tally = Fuzzer(seed, messages), Oracle(messages), Tally()
    tx, rx = TransmitImage(messages), ReceiveImage(messages)
    rng = np.random.default_rng(seed)
    buffer = new_frames(RECEIVE_BUDGET)
    signals = [signal for _, signal in tx.codec.signals]
    low, high = np.array([s.minimum for s in signals]), np.array([s.maximum for s in signals])
    slack = 1e-6 * (high - low)
    drawn = rng.uniform(low, high, (64, len(signals)))
    before = rx.frames["data"].copy()
    # The receive image and the transmit image have the same signals in the same order.
    while tally.frames < frames:
        tx.values[:] = drawn[tally.cycles % len(drawn)]
        genuine = tx.seal()
        count = min(per_cycle, RECEIVE_BUDGET - len(genuine), frames - tally.frames)
        fuzzed = fuzzer.frames(count, genuine)
        mixed = np.concatenate([genuine, fuzzed])
        if tally.cycles % 2:
            mixed = mixed[rng.permutation(len(mixed))]
        buffer[: len(mixed)] = mixed
        rx.accept(buffer, len(mixed))
        tally.frames, tally.cycles = tally.frames + count, tally.cycles + 1
        _check_committed(rx, before, genuine, oracle.intact(fuzzed), tally)
        before[:] = rx.frames["data"]
        outside = ~((rx.values >= low - slack) & (rx.values <= high + slack) | np.isnan(rx.values))
        if outside.any():
            name = signals[int(np.argmax(outside))].name
            raise Finding(f"cycle {tally.cycles}: {name} left its range and was committed (seed {seed})")
        if tally.cycles % 200 == 0:
            yield tally
    yield tally


def _check_committed(
    rx: ReceiveImage, before: Any, genuine: Frames, intact: dict[int, set[bytes]], tally: Tally
) -> None:
    tally.intact += sum(map(len, intact.values()))
    committed = rx.frames["data"]
    same = (committed == genuine["data"]).all(axis=1) | (committed == before).all(axis=1)
    for row in np.flatnonzero(~same).tolist():
        message = rx.codec.messages[row]
        payload = committed[row, : message.length].tobytes()
        # The bytes after the payload are undefined.
        known = {genuine["data"][row, : message.length].tobytes(), before[row, : message.length].tobytes()}
        if payload not in known | intact.get(message.frame_id, set()):
            raise Finding(f"cycle {tally.cycles}: {message.name} accepted a frame that is not intact: {payload.hex()}")


# -- the HAL and the emulated robot ------------------------------------------------------------------------------------


class FuzzedBus(WrappedBus):
    """Bus that mixes fuzzed frames into a received batch. The batches keep their order, and no frame is lost."""

    def __init__(self, bus: Bus, fuzzer: Fuzzer) -> None:
        super().__init__(bus)
        self._fuzzer = fuzzer
        self.per_receive = 0  # number of frames to add in the next `receive`, which resets it to 0
        self.fuzzed = 0
        self.most = 0  # largest number of frames that one call returned
        self._waiting: deque[Frames] = deque()
        self._scratch = new_frames(1024)
        self._shuffle = np.random.default_rng(0)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive a batch and mix in the fuzzed frames, see `Bus.receive`."""
        count = self.bus.receive(self._scratch, timeout)
        if self.per_receive:
            genuine = self._scratch[:count].copy()
            fuzzed = self._fuzzer.frames(self.per_receive, genuine)
            self.fuzzed += self.per_receive
            self.per_receive = 0
            mixed = np.concatenate([genuine, fuzzed])
            self._waiting.append(mixed[self._shuffle.permutation(len(mixed))])
        elif count:
            self._waiting.append(self._scratch[:count].copy())
        taken = 0
        while self._waiting and taken < len(frames):
            head = self._waiting.popleft()
            fits = min(len(head), len(frames) - taken)
            frames[taken : taken + fits] = head[:fits]
            if fits < len(head):
                self._waiting.appendleft(head[fits:])
            taken += fits
        self.most = max(self.most, taken)
        return taken


class FuzzedRobot:
    """HAL and emulated robot in lock-step, both with fuzzed frames at their end of the bus."""

    #: In the first `QUIET` cycles, there are no fuzzed frames, and the operator starts the robot.
    #: In the next `FUZZED` cycles, fuzzed frames are added. Then the sequence is repeated.
    QUIET, FUZZED = 1150, 60
    #: Cycles of the sequence in which the operator presses START.
    PRESSES = (150, 1050, 1080, 1110)

    def __init__(self, network: Network, robot: Robot, body: PyBulletBody, seed: int) -> None:
        ours, theirs = lockstep_pair(capacity=4096)
        self.robot, self.tally = robot, Tally()
        self._rng = np.random.default_rng(seed)
        nodes = FuzzedBus(theirs, Fuzzer(seed, network.messages))
        hal = FuzzedBus(ours, Fuzzer(seed + 1, network.messages))
        self.ends = (hal, nodes)
        self.operator = Operator()
        self.emulator = Emulator(network, robot, body, nodes, seed=seed, operator=self.operator)
        ours.step = self.emulator.poll
        self.hal = Hal(network, robot, hal, patience=0.0)
        self.states_seen: set[SupervisorState] = set()

    def run(self, frames: int) -> None:
        """Run cycles until `frames` fuzzed frames were added at each end."""
        while self.tally.frames < frames:
            self.cycle(100)

    def cycle(self, per_end: int) -> None:
        """Run one cycle. In the cycles with fuzzing, add `per_end` or more fuzzed frames at each end."""
        phase = self.tally.cycles % (self.QUIET + self.FUZZED)
        self.tally.cycles += 1
        if phase >= self.QUIET:
            for end in self.ends:
                # In 2 % of the cases, send a flood of frames, which the receive budget must limit.
                end.per_receive = per_end if self._rng.random() < 0.98 else 8 * RECEIVE_BUDGET
        elif phase in self.PRESSES:
            self.operator.start()
        hal = self.hal
        state = hal.read()
        self.states_seen.add(state.supervisor)
        if state.supervisor is SupervisorState.ACTIVE:
            hal.write(Command(100.0 * self._rng.standard_normal(12), np.zeros(8)))
        else:
            hal.hold()
        self._check()
        self.tally.frames = min(end.fuzzed for end in self.ends)

    def _check(self) -> None:
        hal, robot, emulator = self.hal, self.robot, self.emulator
        state = hal.state
        for name, values in (("position", state.position), ("velocity", state.velocity), ("torque", state.torque)):
            if not np.isfinite(values).all() and self.tally.cycles > 1:
                raise Finding(f"cycle {self.tally.cycles}: the HAL's {name} is not finite: {values}")
        torque = emulator.drives.signals.torque
        if not (np.abs(torque) <= robot.torque_max * 1.001).all():
            raise Finding(f"cycle {self.tally.cycles}: a drive exerts {torque} Nm")
        if not np.isfinite(emulator.body.position).all():
            raise Finding(f"cycle {self.tally.cycles}: the body is at {emulator.body.position}")
        for end in self.ends:
            if end.most > RECEIVE_BUDGET:
                raise Finding(f"cycle {self.tally.cycles}: {end.most} frames were received in one call")


@contextmanager
def fuzzed_robot(seed: int) -> Iterator[FuzzedRobot]:
    """Yield a robot with fuzzed frames at both ends of its bus."""
    robot = load_robot()
    body = PyBulletBody(urdf(ExoskeletonParameters(), robot))
    try:
        yield FuzzedRobot(atalante_dbc.load(), robot, body, seed)
    finally:
        body.close()


def images(network: Network) -> dict[str, tuple[list[Message], float]]:
    """Return the messages of each process image of the stack, and the share of all fuzzed frames that the image receives."""
    received = network.received_by("HAL")
    whole = 1.0 - ROBOT_SHARE
    return {
        "HAL, every cycle": ([m for m in received if m.cycle_ms == 1], 0.5 * whole),
        "HAL, slow": ([m for m in received if m.cycle_ms != 1], 0.5 * whole),
        "nodes": ([m for m in network.sent_by("HAL") if m.cycle_ms == 1], whole),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Fuzz the process images, then the HAL with the emulated robot. The exit code is 1 after a finding."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "--frames", type=int, default=10_000_000, help="frames for each of HAL and nodes [default: 10 million]"
    )
    parser.add_argument("--seed", type=int, default=0)
    wanted = parser.parse_args(arguments)
    progress = Progress()
    begun = time.monotonic()

    def show(what: str, tally: Tally, frames: int) -> None:
        if progress.due():
            progress.show(f"{what}: {tally.frames:,} of {frames:,} frames, {time.monotonic() - begun:.0f} s")

    def report(what: str, tally: Tally, more: str = "") -> None:
        progress.clear()
        print_message(
            f"{what}: {tally.frames:,} frames in {tally.cycles:,} cycles, {time.monotonic() - begun:.0f} s{more}"
        )

    try:
        for name, (messages, share) in images(atalante_dbc.load()).items():
            frames = round(share * wanted.frames)
            for tally in fuzz_image(messages, frames, wanted.seed, min(100, RECEIVE_BUDGET - len(messages))):
                show(f"image {name}", tally, frames)
            report(f"image {name}", tally, f", {tally.intact:,} of them intact")
        with fuzzed_robot(wanted.seed) as robot:
            while robot.tally.frames < ROBOT_SHARE * wanted.frames:
                robot.cycle(100)
                show("HAL and nodes", robot.tally, round(ROBOT_SHARE * wanted.frames))
            seen = ", ".join(state.name for state in sorted(robot.states_seen))
            report("HAL and nodes, at each end", robot.tally, f"; the HAL was in {seen}")
    except Finding as finding:
        progress.clear()
        print_message(str(finding))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
