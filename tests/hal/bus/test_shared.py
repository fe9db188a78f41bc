"""Special behaviour of the shared-memory bus: lock-step of two processes, waiting, and loss of the other process.

`test_bus` tests the behaviour that is common to all buses.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from atalante_hal.bus import BusDown, BusFull
from atalante_hal.bus.shared import SharedBus, descriptors, shared_pair
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames, new_frames

#: Timeout of the tests [s]. A test that reaches it fails.
LONG = 60.0


def frames_of(payload: int, count: int = 1) -> Frames:
    frames = new_frames(count)
    frames["can_id"], frames["len"], frames["flags"] = 0x181, 12, FLAG_FDF | FLAG_BRS
    frames["data"][:, 0] = payload
    return frames


@pytest.fixture
def ends() -> Iterator[tuple[SharedBus, SharedBus]]:
    one, other = shared_pair(capacity=10)
    yield one, other
    one.close()
    other.close()


class Answering:
    """The other end, in a thread: it echoes frames with a payload below 100 and ignores all other frames."""

    def __init__(self, bus: SharedBus) -> None:
        self.received: list[list[int]] = []
        self.pause = 0.0
        self._bus = bus
        self._block = new_frames(8)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with pytest.raises(BusDown):
            self._bus.serve(self._step)

    def _step(self) -> None:
        count = self._bus.receive(self._block, LONG)  # does not wait within a step
        self.received.append(self._block["data"][:count, 0].tolist())
        time.sleep(self.pause)
        if count and self._block["data"][0, 0] < 100:
            self._bus.send(self._block[:count].copy())

    def join(self) -> None:
        self._thread.join(LONG)
        assert not self._thread.is_alive()


@pytest.fixture
def asker(ends: tuple[SharedBus, SharedBus]) -> Iterator[tuple[SharedBus, Answering]]:
    ours, theirs = ends
    ours.patience = LONG
    answering = Answering(theirs)
    ours.wait_until_served(LONG)
    yield ours, answering
    ours.close()
    answering.join()


def test_receive_passes_all_sent_frames_and_returns_the_answer(asker: tuple[SharedBus, Answering]) -> None:
    ours, answering = asker
    block = new_frames(8)
    for cycle in range(50):
        ours.send(frames_of(cycle, 3))
        ours.send(frames_of(cycle + 1))
        assert ours.receive(block) == 4
        assert block["data"][:4, 0].tolist() == [cycle] * 3 + [cycle + 1]
    assert answering.received == [[cycle] * 3 + [cycle + 1] for cycle in range(50)]


def test_each_receive_without_queued_frames_runs_one_step(asker: tuple[SharedBus, Answering]) -> None:
    ours, answering = asker
    block = new_frames(8)
    assert ours.receive(block) == 0
    ours.send(frames_of(100))
    assert ours.receive(block) == 0
    ours.send(frames_of(7))
    assert ours.receive(block) == 1
    assert ours.receive(block) == 0
    assert answering.received == [[], [100], [7], []]


def test_run_step_waits_for_the_end_of_the_step_and_keeps_its_frames(asker: tuple[SharedBus, Answering]) -> None:
    ours, answering = asker
    answering.pause = 0.02
    ours.send(frames_of(7))
    ours.run_step()
    assert answering.received == [[7]]
    block = new_frames(8)
    assert ours.receive(block) == 1  # the frame of the step; no further step
    assert answering.received == [[7]]


def test_run_step_raises_bus_down_if_the_step_does_not_end(asker: tuple[SharedBus, Answering]) -> None:
    ours, answering = asker
    answering.pause, ours.patience = 0.2, 0.01
    with pytest.raises(BusDown, match=r"did not complete a step within 0\.01 s"):
        ours.run_step()


def test_function_before_a_request_runs_once_per_step(asker: tuple[SharedBus, Answering]) -> None:
    ours, answering = asker
    steps: list[int] = []
    ours.before_request = lambda: steps.append(len(answering.received))
    block = new_frames(8)
    for cycle in range(3):
        ours.send(frames_of(cycle))
        assert ours.receive(block) == 1
    ours.run_step()  # no cycle, so the function is not called
    assert steps == [0, 1, 2]


def test_frames_beyond_the_buffer_are_returned_without_another_step(asker: tuple[SharedBus, Answering]) -> None:
    ours, answering = asker
    ours.send(frames_of(1, 5))
    assert [ours.receive(new_frames(2)) for _ in range(3)] == [2, 2, 1]
    assert len(answering.received) == 1


def test_both_ends_wake_up_when_frames_arrive_late(asker: tuple[SharedBus, Answering]) -> None:
    """Both ends sleep while they wait, as on a machine with one core."""
    ours, answering = asker
    answering.pause = 0.01
    block = new_frames(4)
    for cycle in range(3):
        time.sleep(0.01)
        ours.send(frames_of(cycle))
        assert ours.receive(block) == 1
        assert block["data"][0, 0] == cycle


def assert_times_out(waiting: SharedBus, timeout: float = 0.0) -> None:
    """Check that the bus waits at least 0.03 s, and receives nothing."""
    begun = time.monotonic()
    assert waiting.receive(new_frames(1), timeout) == 0
    assert time.monotonic() - begun >= 0.03


def test_wait_for_an_end_that_never_serves_times_out(ends: tuple[SharedBus, SharedBus]) -> None:
    ours, _ = ends
    ours.patience = 0.03
    ours.send(frames_of(1))
    assert_times_out(ours)
    with pytest.raises(BusDown, match="the other end did not call `serve` within 0 s"):
        ours.wait_until_served(0.03)


@pytest.mark.parametrize("closes", [False, True])
def test_error_of_a_step_ends_serve(ends: tuple[SharedBus, SharedBus], closes: bool) -> None:
    ours, theirs = ends
    ours.patience = 0.01
    ours.receive(new_frames(1))  # requests a step

    def step() -> None:
        if closes:
            theirs.close()
        raise RuntimeError("the step failed")

    with pytest.raises(RuntimeError, match="the step failed"):
        theirs.serve(step)
    if not closes:
        assert_times_out(theirs, 0.03)
        with pytest.raises(BusDown, match="did not call `serve`"):
            ours.wait_until_served(0.0)


def test_full_queue_rejects_whole_batches(ends: tuple[SharedBus, SharedBus]) -> None:
    one, other = ends
    received = []
    for batch in range(20):
        one.send(frames_of(batch, 4))
        one.send(frames_of(100 + batch, 3))
        with pytest.raises(BusFull, match="the receive queue of the other end is full, with 7 frames") as refusal:
            one.send(frames_of(0, 4))
        assert refusal.value.sent == 0
        block = new_frames(7)
        assert other.receive(block) == 7
        received += block["data"][:, 0].tolist()
    assert received == [value for batch in range(20) for value in [batch] * 4 + [100 + batch] * 3]


def test_time_stamps_are_the_time_of_the_receive(ends: tuple[SharedBus, SharedBus]) -> None:
    one, other = ends
    one.send(frames_of(0, 2))
    before = time.time_ns()
    other.receive(new_frames(2))
    assert before <= other.stamps[0] == other.stamps[1] <= time.time_ns()
    assert other.stamps.dtype == np.int64


@pytest.mark.parametrize("timeout", [0.0, LONG])
def test_frames_sent_before_closing_arrive_then_the_closing_reason(
    ends: tuple[SharedBus, SharedBus], timeout: float
) -> None:
    one, other = ends
    other.send(frames_of(1))  # an unread wake-up, because of which the kernel reports a broken connection first
    one.send(frames_of(5))
    one.close("the simulation failed")
    block = new_frames(1)
    assert other.receive(block, timeout) == 1
    for _ in range(2):
        with pytest.raises(BusDown, match=r"^embedded peer: the simulation failed$"):
            other.receive(block, timeout)
    other.send(frames_of(2))  # the other end is closed: the frames are discarded


@pytest.mark.parametrize(("patience", "timeout"), [(0.0, 0.0), (0.0, LONG), (LONG, LONG)])
def test_killed_process_at_the_other_end_raises_bus_down(patience: float, timeout: float) -> None:
    memory, bell, theirs = descriptors()
    program = (
        "import sys\n"
        "from atalante_hal.bus.shared import SharedBus\n"
        "bus = SharedBus('other', int(sys.argv[1]), int(sys.argv[2]), 1)\n"
        "bus.serve(lambda: None)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", program, str(memory), str(theirs)], pass_fds=(memory, theirs))
    os.close(theirs)
    bus = SharedBus("embedded", memory, bell, 0)
    bus.patience = patience
    bus.wait_until_served(LONG)
    child.send_signal(signal.SIGKILL)
    child.wait()
    bus.send(frames_of(1))
    with pytest.raises(BusDown, match=r"^embedded: the other end is closed$"):
        bus.receive(new_frames(1), timeout)
    bus.close()
