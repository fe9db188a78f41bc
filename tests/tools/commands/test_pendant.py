"""`atalante pendant`: node on the bus, takeover, messages to the operator, commands."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest
from click.testing import CliRunner, Result

from atalante_dbc import Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus import BusDown, BusFull
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot
from atalante_hal.safety.direction import pose_gains
from atalante_hal.types import Command, SupervisorState
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.frame import FRAME, FRAME_BYTES, Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.cli import cli
from atalante_tools.commands import pendant
from atalante_tools.commands.emulator_line import Line
from atalante_tools.console.options import Target
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import StopRequest
from atalante_tools.session import pendant_session
from atalante_tools.session.pendant_node import PendantNode, Request
from atalante_tools.session.pendant_session import Keyboard, Session
from atalante_tools.session.takeover import DRAW_CYCLES, PRESENT_FRAMES, QUIET_CYCLES, TAKEOVER_CYCLES

OFF, READY, ACTIVE, HOLD = (SupervisorState[name] for name in ("OFF", "READY", "ACTIVE", "HOLD"))
#: Longest time from the start of the newest pendant until only one pendant sends [cycles].
TAKEOVER_SETTLED = 300
TARGET = Target("pcan", "test", lockstep=False)


class Wire:
    """Lock-step bus with any number of ends: every end receives the frames of all others."""

    def __init__(self) -> None:
        self.ends: list[WireEnd] = []

    def end(self, empty: Callable[[], object] = lambda: None) -> WireEnd:
        self.ends.append(WireEnd(self, empty))
        return self.ends[-1]


class WireEnd:
    """End of the bus; `empty` is called by a receive without pending frames."""

    name = "wire"
    dropped = 0
    stamps = np.zeros(256, np.int64)

    def __init__(self, wire: Wire, empty: Callable[[], object]) -> None:
        self.wire, self.empty = wire, empty
        self.queue = bytearray()
        self.closed = self.full = False

    def send(self, frames: Frames) -> None:
        if self.closed:
            raise BusDown("the wire is closed")
        if self.full:
            raise BusFull("the transmit queue is full")
        data = frames.tobytes()
        for end in self.wire.ends:
            if end is not self and not end.closed:
                end.queue += data

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        if not self.queue:
            self.empty()
        size = min(frames.nbytes, len(self.queue))
        frames.view(np.uint8)[:size] = np.frombuffer(self.queue[:size], np.uint8)
        del self.queue[:size]
        return size // FRAME_BYTES

    def close(self) -> None:
        self.closed = True
        self.queue.clear()


class World:
    """HAL, emulated robot without an operator, and bus ends for pendants; a pendant that listens advances the time."""

    def __init__(self, network: Network, robot: Robot, body: PyBulletBody, operator: Operator | None = None) -> None:
        self.network, self.wire = network, Wire()
        self.now = 0.0
        self.nodes: list[PendantNode] = []
        line = Line(self.wire.end(), network)
        self.emulator = Emulator(network, robot, body, line, operator=operator)
        self.hal = Hal(network, robot, self.wire.end(self.emulator.poll))
        self.running = True
        self.states: list[SupervisorState] = []
        self.anchor = np.zeros(12)

    def cycle(self) -> None:
        """Advance the time by 1 ms."""
        self.now += 1e-3
        if self.running:
            self._hal_cycle()
        for node in self.nodes:
            while node._bus.queue:  # type: ignore[attr-defined]
                node.poll()

    def _hal_cycle(self) -> None:
        hal = self.hal
        state = hal.read()
        self.states.append(state.supervisor)
        if state.supervisor is ACTIVE:
            stiffness, damping = pose_gains(hal.robot)
            torque = stiffness * (self.anchor - state.position) - damping * state.velocity
            hal.write(Command(torque, np.zeros(8)))
        else:
            self.anchor = state.position.copy()
            hal.hold()

    def run(self, cycles: int) -> SupervisorState:
        for _ in range(cycles):
            self.cycle()
        return self.hal.state.supervisor

    def node(self, seed: int | None = None) -> PendantNode:
        self.nodes.append(PendantNode(self.network, self.wire.end(), seed=seed))
        return self.nodes[-1]

    def sending(self) -> PendantNode:
        node = self.node()
        node.dead_man = True
        node.start_sending()
        return node

    def active(self) -> PendantNode:
        node = self.sending()
        assert self.run(200) is READY
        node.press(Request.START)
        assert self.run(150) is ACTIVE
        return node

    def session(self, stop: StopRequest | None = None, keyboard: Keyboard | None = None) -> Session:
        node = PendantNode(self.network, self.wire.end(self.cycle))
        return Session(node, TARGET, stop or StopRequest(), keyboard or Keyboard(None), now=lambda: self.now)


@pytest.fixture
def make_world(network: Network, robot: Robot, urdf_text: str) -> Iterator[Callable[..., World]]:
    bodies: list[PyBulletBody] = []

    def make(operator: Operator | None = None) -> World:
        bodies.append(PyBulletBody(urdf_text))
        return World(network, robot, bodies[-1], operator)

    yield make
    for body in bodies:
        body.close()


@pytest.fixture
def world(make_world: Callable[..., World]) -> World:
    return make_world()


# -- the node --------------------------------------------------------------------------------------------------------


def test_pendant_answers_every_sync_with_a_protected_frame(world: World) -> None:
    world.sending()
    ids = {m.name: m.frame_id for m in world.network.messages}
    tap = world.wire.end()
    world.run(300)
    frames = np.frombuffer(tap.queue, FRAME)
    state = frames[frames["can_id"] == ids["PENDANT_STATE"]]
    assert len(state) == 300
    assert state["data"][:, 2].tolist() == [cycle & 0xFF for cycle in range(1, 301)]
    assert (frames["can_id"] == ids["PENDANT_STATUS"]).sum() == 3
    assert world.hal.crc_errors == 0


def test_start_needs_a_press_and_the_dead_man(world: World) -> None:
    node = world.sending()
    assert world.run(200) is READY
    node.dead_man = False
    node.press(Request.START)
    assert world.run(250) is READY
    node.dead_man = True
    assert world.run(50) is READY
    node.press(Request.START)
    assert world.run(150) is ACTIVE
    assert node.hal is ACTIVE


@pytest.mark.parametrize("request_", [Request.STOP, Request.HOLD])
def test_stop_and_hold_end_in_hold(world: World, request_: Request) -> None:
    node = world.active()
    node.press(request_)
    assert world.run(3) is HOLD


def test_a_lost_pendant_ends_in_hold(world: World) -> None:
    world.active()
    world.nodes.clear()
    assert world.run(10) is HOLD


def test_the_assistance_factor_changes_only_when_the_pendant_sets_it(world: World) -> None:
    node = world.active()
    assert world.hal.state.assistance_factor == 1.0
    node.assist(0.3)
    world.run(3)
    assert world.hal.state.assistance_factor == pytest.approx(0.3, abs=1e-4)


def test_a_damaged_sync_is_not_answered(world: World, network: Network) -> None:
    node = PendantNode(network, world.wire.end())
    node.start_sending()
    world.run(2)
    frames = np.frombuffer(node._bus.queue, FRAME)  # type: ignore[attr-defined]
    damaged = frames[frames["can_id"] == network.message("SYNC_RIGHT_SENSE").frame_id][:1].copy()
    damaged["data"][0, 4] ^= 1
    node._bus.queue = bytearray(damaged.tobytes())  # type: ignore[attr-defined]
    assert not node.poll()
    assert node.cycles == 0


def test_keyboard_of_a_terminal_that_does_not_control_the_process_returns_no_lines() -> None:
    """A terminal stops controlling a process when the shell of the terminal ends."""
    terminal, end = os.openpty()
    os.write(terminal, b"hold\n")
    keyboard = Keyboard(end)
    assert [keyboard.lines(), keyboard.lines()] == [[], []]
    os.close(terminal)
    os.close(end)


# -- taking over -----------------------------------------------------------------------------------------------------


def test_a_takeover_by_a_new_pendant_does_not_disturb_the_hal(world: World) -> None:
    old = world.active()
    old.assist(0.4)
    world.run(1600)  # until the uptime of the old pendant is above that of the new one
    events = world.hal.events.count
    new = world.node()
    world.run(50)
    assert new.found_another
    assert new.dead_man
    new.start_sending()
    assert world.run(400) is ACTIVE
    assert old.displaced
    assert not new.takeover_failed
    assert not new.displaced
    assert new.answered == 400
    assert old.answered + new.answered == world.hal.state.cycle + PRESENT_FRAMES
    assert world.hal.state.assistance_factor == pytest.approx(0.4, abs=1e-4)
    assert {event.code for event in world.hal.events.since(events)} <= {"E2E_REPEATED"}
    assert world.hal.crc_errors == 0


def test_press_of_a_new_pendant_takes_effect_once(world: World) -> None:
    world.active()
    new = world.node()
    world.run(50)
    new.press(Request.STOP)
    new.start_sending()
    assert world.run(20) is HOLD
    new.press(Request.START)
    assert world.run(150) is ACTIVE


def test_a_pendant_that_keeps_sending_prevents_the_takeover_and_the_repeated_frames_lead_to_hold(world: World) -> None:
    hardware, events = world.active(), world.hal.events.count
    hardware._takeover.answer = lambda counter: False  # type: ignore[method-assign]
    new = world.node()
    world.run(50)
    new.start_sending()
    assert world.run(200) is HOLD
    assert "E2E_REPEAT_RATE" in {event.code for event in world.hal.events.since(events)}
    assert new.takeover_failed
    assert TAKEOVER_CYCLES <= new.answered < TAKEOVER_CYCLES + DRAW_CYCLES
    assert not hardware.displaced
    assert hardware.answered == world.hal.state.cycle


@pytest.mark.sample(2)
@pytest.mark.parametrize("request_", [Request.STOP, Request.HOLD])
def test_stop_and_hold_work_against_a_replay_that_displaced_the_pendant(world: World, request_: Request) -> None:
    pendant, replay = world.active(), world.node()
    replay._takeover.answer = lambda counter: False  # type: ignore[method-assign]
    replay.dead_man = True
    replay.start_sending()
    assert world.run(200) is ACTIVE
    assert pendant.displaced
    new = world.node()
    world.run(50)
    new.start_sending()
    new.press(request_)
    assert world.run(5) is HOLD


def test_the_emulated_pendant_yields_to_a_pendant_process(make_world: Callable[..., World]) -> None:
    world = make_world(Operator())
    for _ in range(400):
        world.run(1)
    assert world.hal.state.supervisor is ACTIVE
    new = world.node()
    world.run(50)
    new.press(Request.HOLD)
    new.start_sending()
    world.run(100)
    assert world.emulator.bus.pendant_displaced  # type: ignore[attr-defined]
    assert not new.takeover_failed
    assert world.hal.state.supervisor is HOLD
    new.press(Request.START)
    assert world.run(150) is ACTIVE


def replayed(world: World, counter_of: Callable[[int], int], request: Request = Request.NONE) -> Callable[[], None]:
    """Return a function that sends one intact PENDANT_STATE with the dead-man switch pressed.

    Args:
        world: World whose bus receives the frame.
        counter_of: Counter of the frame for the cycle of the HAL.
        request: Request of the frame, with the request counter 77.
    """
    image = TransmitImage([world.network.message("PENDANT_STATE")])
    for signal, value in (("DeadMan", 1), ("Request", request), ("RequestCounter", 77)):
        image.values[image.codec.index("PENDANT_STATE", signal)] = value
    end = world.wire.end()
    return lambda: end.send(image.seal(counter_of(world.hal.state.cycle) & 0xFF))


def garbage(world: World) -> Callable[[], None]:
    """Return a function that sends a frame with the identifier of the pendant and random bytes."""
    end, random = world.wire.end(), np.random.default_rng(1)

    def send() -> None:
        frames = new_frames(1)
        frames["can_id"], frames["len"], frames["flags"] = 0x194, 8, 4
        frames["data"][:, :8] = random.integers(0, 256, 8)
        end.send(frames)

    return send


@pytest.mark.sample(3)
@pytest.mark.parametrize("age", [0, 1, 2, 100, 128, 255])
def test_one_replayed_frame_does_not_stop_a_pendant(world: World, age: int) -> None:
    node = world.active()
    world.run(100)
    send = replayed(world, lambda cycle: cycle - age)
    for _ in range(3):
        send()
        assert world.run(20) is ACTIVE
    assert not node.displaced
    assert node.answered == world.hal.state.cycle


def test_one_replayed_or_garbage_frame_does_not_stop_the_emulated_pendant(make_world: Callable[..., World]) -> None:
    world = make_world(Operator())
    world.run(400)
    for send in (replayed(world, lambda cycle: cycle), replayed(world, lambda cycle: cycle - 40), garbage(world)):
        send()
        assert world.run(20) is ACTIVE
    assert not world.emulator.bus.pendant_displaced  # type: ignore[attr-defined]


def test_garbage_in_every_cycle_does_not_stop_a_pendant(world: World) -> None:
    node, send = world.active(), garbage(world)
    for _ in range(300):
        send()
        world.run(1)
    assert not node.displaced
    assert node.answered == world.hal.state.cycle


@pytest.mark.sample(3)
@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("offset", [0, 1, 2, 5, 30, 49, 77, 120])
def test_one_pendant_is_left_and_motion_requires_its_dead_man(world: World, offset: int, older: bool) -> None:
    if older:
        world.active()
        allowed = {ACTIVE, HOLD}
    else:
        world.run(200)
        allowed = {OFF, READY}
    newcomers = [world.node(seed=10 * offset + number) for number in range(2 + offset % 2)]
    for number, node in enumerate(newcomers):
        world.run(50 if number == 0 else offset)
        node.dead_man = (offset + number) % 3 != 0
        node.start_sending()
    released, started = 0, world.hal.state.cycle
    while world.hal.state.cycle < started + TAKEOVER_SETTLED:
        before = [(node, node.answered) for node in world.nodes]
        state = world.run(1)
        assert state in allowed
        if state is HOLD:
            allowed = {HOLD}  # only a press ends HOLD
        held = any(node.dead_man and node.answered > answered for node, answered in before)
        released = 0 if held else released + 1
        assert state is not ACTIVE or released < 8
    left = [node for node in world.nodes if not (node.displaced or node.takeover_failed)]
    assert len(left) == 1
    left[0].dead_man, answered = True, left[0].answered
    assert world.run(100) is not ACTIVE or older
    assert left[0].answered == answered + 100
    left[0].press(Request.START)
    assert world.run(150) is ACTIVE


def test_a_short_silence_does_not_end_the_motion(world: World) -> None:
    node, send = world.active(), replayed(world, lambda cycle: cycle)
    for _ in range(PRESENT_FRAMES):
        send()
        world.run(1)
    assert world.run(200) is ACTIVE
    assert not node.displaced
    assert node.answered == world.hal.state.cycle - QUIET_CYCLES


def test_start_pressed_before_a_silence_has_no_effect_again(world: World) -> None:
    node, send = world.active(), replayed(world, lambda cycle: cycle, Request.HOLD)
    for _ in range(PRESENT_FRAMES + 1):
        send()
        world.run(1)
    assert world.run(200) is HOLD
    assert not node.displaced
    node.press(Request.START)
    assert world.run(150) is ACTIVE


# -- two robots ------------------------------------------------------------------------------------------------------


@pytest.mark.sample(4)
@pytest.mark.parametrize(("seed", "head_start"), [(0, 0), (1, 0), (0, 120), (1, 120)])
def test_the_hal_never_starts_while_two_emulators_answer(
    make_world: Callable[..., World], urdf_text: str, robot: Robot, seed: int, head_start: int
) -> None:
    world = make_world(Operator())
    body = PyBulletBody(urdf_text)
    line = Line(world.wire.end(), world.network)
    second = Emulator(world.network, robot, body, line, seed=seed)
    try:
        world.run(head_start)
        line.bus.queue.clear()  # type: ignore[attr-defined]
        for _ in range(700):
            world.run(1)
            while line.bus.queue:  # type: ignore[attr-defined]
                second.poll()
    finally:
        body.close()
    assert ACTIVE not in world.states
    assert world.hal.state.supervisor is OFF
    assert line.other_robot
    assert world.emulator.bus.other_robot  # type: ignore[attr-defined]


# -- the session -----------------------------------------------------------------------------------------------------


def test_start_is_pressed_when_the_hal_is_ready_and_printed(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    operator = world.session()
    operator.take_over()
    operator.start_wanted = True
    operator.run(0.6)
    printed = capsys.readouterr().err
    assert printed.splitlines() == [
        "the pendant is active",
        "the HAL is OFF",
        "the HAL is READY",
        "START pressed",
        "the HAL is ACTIVE",
        "STOP: the HAL is HOLD",
    ]


HEAD_STARTS = (1, 5, 10, 15, 16, 17, 50, 100)


def started_once(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    """Check that `pendant start` leads to ACTIVE with one press, within 250 cycles after pendant and HAL are running."""
    operator = world.session()
    operator.take_over()
    operator.start_wanted = True
    operator.run(0.35)
    assert ACTIVE in world.states[-250:]
    assert world.hal.state.supervisor is HOLD
    printed = capsys.readouterr().err.splitlines()
    assert printed[-3:] == ["START pressed", "the HAL is ACTIVE", "STOP: the HAL is HOLD"]
    assert printed.count("START pressed") == 1


@pytest.mark.sample(8)
@pytest.mark.parametrize("cycles", HEAD_STARTS)
def test_a_hal_started_after_the_pendant_becomes_active(
    world: World, cycles: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    world.running = False
    cycle = world.cycle

    def late() -> None:
        world.running |= world.now >= cycles * 1e-3
        cycle()

    monkeypatch.setattr(world, "cycle", late)
    started_once(world, capsys)


@pytest.mark.sample(8)
@pytest.mark.parametrize("cycles", HEAD_STARTS)
def test_a_hal_started_before_the_pendant_becomes_active(
    world: World, cycles: int, capsys: pytest.CaptureFixture[str]
) -> None:
    world.run(cycles)
    started_once(world, capsys)


@pytest.mark.sample(8)
@pytest.mark.parametrize("cycles", HEAD_STARTS)
@pytest.mark.parametrize("state", [READY, HOLD])
def test_a_start_of_a_late_pendant_makes_the_hal_active(
    world: World, state: SupervisorState, cycles: int, capsys: pytest.CaptureFixture[str]
) -> None:
    if state is HOLD:
        world.active()
        world.nodes.clear()
        assert world.run(10) is HOLD
    else:
        assert world.run(200) is READY
    assert world.run(cycles) is state
    started_once(world, capsys)


@pytest.mark.sample(8)
@pytest.mark.parametrize("frames", HEAD_STARTS)
@pytest.mark.parametrize("state", [READY, HOLD])
def test_press_of_a_late_pendant_is_accepted_from_its_second_frame(
    world: World, state: SupervisorState, frames: int
) -> None:
    assert world.run(200) is READY
    if state is HOLD:
        world.active()
        world.nodes.clear()
        assert world.run(10) is HOLD
        frames += 1  # the first frame after a loss is rejected
    node = world.sending()
    assert world.run(frames) is state
    node.press(Request.START)
    assert world.run(150) is ACTIVE
    node.press(Request.HOLD)
    assert world.run(300) is HOLD


def test_one_start_in_fault_leads_to_hold_with_a_message(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    operator = world.session()
    operator.take_over()
    operator.start_wanted = True
    operator.run(0.5)
    operator.node.dead_man = True
    world.emulator.drives.state[7] = DriveState.FAULT
    world.emulator.drives._states_changed()
    operator.answer_syncs(10)
    assert world.hal.state.supervisor is SupervisorState.FAULT

    class TypesStart(Keyboard):
        def lines(self) -> list[str]:
            return ["start"] if operator.node.answered in presses else []

    capsys.readouterr()
    begun = operator.node.answered
    presses = {begun + 10, begun + 400}
    operator._keyboard = TypesStart(None)
    operator.run(begun * 1e-3 + 0.6)
    assert capsys.readouterr().err.splitlines() == [
        "the HAL is FAULT",
        "START pressed",
        "the HAL is HOLD",
        "each START changes the state once; type start to press START again",
        "START pressed",
        "the HAL is ACTIVE",
        "STOP: the HAL is HOLD",
    ]


def test_a_refused_start_is_printed_and_its_reason_logged(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.active()
    world.nodes.clear()
    world.run(10)
    temperature = world.emulator.signals.slice("Temperature").start
    world.emulator.before_send.append(lambda cycle, values: values.__setitem__(temperature, 115.0))
    operator = world.session()
    operator.take_over()
    operator.start_wanted = True
    operator.run(0.6)
    printed = capsys.readouterr().err
    assert "the HAL did not become ACTIVE, see its event log; type start to press START again" in printed
    assert [event.text for event in world.hal.events if event.code == "START_REFUSED"] == [world.hal.reason]
    assert world.hal.reason.startswith("START refused: LEFT_FH: its torque limit is")


def test_typed_commands_are_executed(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    operator = world.session()
    operator.take_over()
    operator.start_wanted = True
    operator.run(0.5)
    capsys.readouterr()
    operator.node.dead_man = True
    for line, state in (("start", ACTIVE), (" XI 0.25 ", ACTIVE), ("hold", HOLD), ("start", ACTIVE), ("stop", HOLD)):
        operator.execute(line)
        operator.answer_syncs(150)
        assert operator.node.hal is state, line
    assert world.hal.state.assistance_factor == pytest.approx(0.25, abs=1e-4)
    for line in ("xi 1.5", "xi", "run", "start now", "", "xi nan"):
        operator.execute(line)
    operator.answer_syncs(20)
    assert operator.node.hal is HOLD
    assert world.hal.state.assistance_factor == pytest.approx(0.25, abs=1e-4)
    assert capsys.readouterr().err.count("a command must be start, stop, hold or xi X") == 5


def test_ctrl_c_sends_stop_before_the_dead_man_is_released(world: World) -> None:
    stop = StopRequest()
    operator = world.session(stop)
    operator.take_over()
    operator.start_wanted = True
    operator.run(0.5)
    before = world.hal.state.cycle
    operator.node.dead_man = True
    operator.execute("start")
    operator.answer_syncs(150)
    assert world.hal.state.supervisor is ACTIVE
    stop.ask(2)
    operator.run(None)
    assert world.hal.state.supervisor is HOLD
    codes = [event.code for event in world.hal.events if event.cycle > before]
    assert "OPERATOR_STOP" in codes
    assert "DEAD_MAN" not in codes
    assert not operator.node.dead_man
    assert stop.exit_code == 130


def test_displaced_session_ends_with_a_message(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    older = world.session()
    older.take_over()
    older.start_wanted = True
    newer = world.node()

    class TakesOver(Keyboard):
        def lines(self) -> list[str]:
            if older.node.answered > 2 * TAKEOVER_CYCLES + 100:  # the HAL is ACTIVE
                newer.start_sending()
            return []

    older._keyboard = TakesOver(None)
    older.run(None)
    assert capsys.readouterr().err.endswith("the HAL is ACTIVE\nanother pendant has taken over\n")
    assert world.hal.state.supervisor is ACTIVE


def test_failed_takeover_states_the_state_of_the_hal(world: World) -> None:
    hardware = world.active()
    hardware._takeover.answer = lambda counter: False  # type: ignore[method-assign]
    newer = world.session()
    newer.node.press(Request.STOP)
    newer.take_over()
    newer.answer_syncs(200)
    with pytest.raises(Failed, match="in use on this bus, and the HAL is in HOLD: operate the robot with that pendant"):
        newer.check_takeover()


def test_missing_hal_is_reported_once_while_the_pendant_waits(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.running = False
    operator = world.session()
    operator.take_over()
    operator.run(3.0)
    assert capsys.readouterr().err.splitlines() == [
        "the pendant is active",
        "no SYNC received on pcan test: waiting for a HAL",
    ]


@pytest.mark.parametrize("returns", [1.5, 10.0])
def test_duration_includes_the_time_without_a_hal(world: World, returns: float) -> None:
    operator = world.session()
    operator.take_over()
    begun = world.now

    class Gone(Keyboard):
        def lines(self) -> list[str]:
            world.running = world.now - begun < 0.5 or world.now - begun > returns
            return []

    operator._keyboard = Gone(None)
    operator.run(3.0)
    # At the end, the command presses STOP. Without a HAL, it waits twice for a SYNC.
    assert 2.5 < world.now - begun < 3.2 + 2.0 * pendant_session.HAL_TIMEOUT


def test_duration_includes_the_time_without_a_hal_that_vanished_after_the_takeover(world: World) -> None:
    world.sending()
    world.run(100)
    operator = world.session()
    operator.take_over()
    assert operator.node.answered
    world.running, begun = False, world.now

    class Returns(Keyboard):
        def lines(self) -> list[str]:
            world.running = world.now - begun > 2.0
            return []

    operator._keyboard = Returns(None)
    operator.run(3.0)
    assert 2.5 < world.now - begun < 3.2


def test_a_start_without_effect_is_reported(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    operator = world.session()
    operator.take_over()
    operator.answer_syncs(200)
    world.emulator.before_send.append(
        lambda cycle, values: values.__setitem__(world.emulator.signals.slice("DriveState"), 0x40)
    )
    operator.start_wanted = True
    operator.run(1.0)
    assert (
        "the HAL did not become ACTIVE, see its event log; type start to press START again" in capsys.readouterr().err
    )


def test_the_keyboard_returns_complete_lines_until_end_of_file() -> None:
    reading, writing = os.pipe()
    keyboard = Keyboard(reading)
    assert keyboard.lines() == []
    os.write(writing, b"sta")
    assert keyboard.lines() == []
    os.write(writing, b"rt\nxi 0.3\nho")
    assert keyboard.lines() == ["start", "xi 0.3"]
    os.close(writing)
    assert keyboard.lines() == []
    os.close(reading)
    assert keyboard.lines() == []


# -- the commands ----------------------------------------------------------------------------------------------------


def invoke(world: World, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> Result:
    monkeypatch.setattr(pendant, "open_pendant_bus", lambda target: (world.network, world.wire.end(world.cycle)))
    monkeypatch.setattr(pendant_session, "Session", partial(Session, now=lambda: world.now))
    return CliRunner().invoke(cli, ["pendant", *arguments, "-i", "pcan", "-c", "test"])


@pytest.mark.parametrize("button", ["stop", "hold"])
def test_stop_and_hold_print_the_state_before_and_after(
    world: World, monkeypatch: pytest.MonkeyPatch, button: str
) -> None:
    world.active()
    result = invoke(world, monkeypatch, button)
    assert (result.exit_code, result.stdout) == (0, f"{button.upper()}: the HAL was ACTIVE and is HOLD\n")


def test_stop_without_a_hal_fails_with_a_sentence(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.running = False
    result = invoke(world, monkeypatch, "stop")
    assert result.exit_code == 1
    assert "no SYNC received on pcan test: start a HAL first, because STOP has no effect without a HAL" in result.stderr


def test_start_runs_for_a_time_and_ends_in_hold(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    result = invoke(world, monkeypatch, "start", "--for", "0.5")
    assert result.exit_code == 0
    assert ACTIVE in world.states
    assert world.hal.state.supervisor is HOLD


def test_xi_takes_over_without_a_conflict_and_sets_the_factor(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.active()
    begin = world.hal.state.cycle
    result = invoke(world, monkeypatch, "xi", "0.7", "--for", "0.1")
    assert result.exit_code == 0
    assert result.stderr.startswith("taking over from another pendant on pcan test\nassistance factor 0.7\n")
    assert world.hal.state.assistance_factor == pytest.approx(0.7, abs=1e-4)
    codes = [event.code for event in world.hal.events if event.cycle > begin]
    assert codes[-2:] == ["OPERATOR_STOP", "HOLD"]
    assert set(codes[:-2]) <= {"E2E_REPEATED"}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["xi", "1.2", "-i", "pcan", "-c", "x"], "1.2 is not in the range 0.0<=x<=1.0"),
        (["start"], "socketcan requires a channel: -c vcan0"),
        (
            ["stop", "-i", "embedded"],
            "this command requires a CAN bus, got -i embedded: use for example -i socketcan -c vcan0",
        ),
        (["stop", "-c", "left_leg=a,b"], "must be BUS=CHANNEL, got 'b'"),
    ],
)
def test_invalid_command_line_prints_one_sentence_and_exits_with_2(arguments: list[str], sentence: str) -> None:
    result = CliRunner().invoke(cli, ["pendant", *arguments])
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


def test_a_lost_link_releases_the_dead_man_until_start_is_typed(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    losses = 0
    node = PendantNode(world.network, world.wire.end(world.cycle))
    pressed: list[bool] = []

    class LosesTheLink(Keyboard):
        """Loses the link in cycles 300 and 400, and types start in cycle 600."""

        def lines(self) -> list[str]:
            nonlocal losses
            losses = (node.answered >= 300) + (node.answered >= 400)
            pressed.append(node.dead_man)
            return ["start"] if node.answered == 600 else []

    operator = Session(node, TARGET, StopRequest(), LosesTheLink(None), now=lambda: world.now, losses=lambda: losses)
    operator.take_over()
    operator.start_wanted = True
    operator.run(0.8)
    assert world.states[world.states.index(ACTIVE) :].count(HOLD) > 200
    assert pressed.index(False) in range(295, 306)
    assert pressed[pressed.index(False) :].index(True) in range(295, 306)
    assert capsys.readouterr().err.splitlines()[4:] == [
        "the HAL is ACTIVE",
        "the dead-man switch is released; type start to press it again, with START",
        "the HAL is HOLD",
        "the dead-man switch is released; type start to press it again, with START",
        "START pressed",
        "the HAL is ACTIVE",
        "STOP: the HAL is HOLD",
    ]


@pytest.mark.parametrize("reopens", [True, False])
def test_pendant_names_start_only_if_its_lost_link_is_opened_again(
    network: Network, monkeypatch: pytest.MonkeyPatch, reopens: bool
) -> None:
    class LostEnd(WireEnd):
        def receive(self, frames: Frames, timeout: float = 0.0) -> int:
            error = BusDown("pcan:x is down: gone; REMEDY")
            error.reopens = reopens
            raise error

        def close(self) -> None:
            pass

    monkeypatch.setattr(pendant, "open_pendant_bus", lambda target: (network, LostEnd(Wire(), lambda: None)))
    monkeypatch.setattr(pendant_session, "HAL_TIMEOUT", 0.1)
    done = CliRunner().invoke(cli, ["pendant", "start", "-i", "pcan", "-c", "x", "--for", "0.3"])
    assert done.exit_code == 0, done.output
    released = [line for line in done.stderr.splitlines() if "dead-man switch" in line]
    remedy = "; type start to press it again, with START" if reopens else ""
    assert released == [f"the dead-man switch is released{remedy}"]
    assert "REMEDY" in done.stderr
    assert ("type start" in done.stderr) is reopens


#: Messages from the first ACTIVE on, if the operator types start once in HOLD.
RESTARTED = [
    "the HAL is ACTIVE",
    "the HAL is HOLD",
    "START pressed",
    "the HAL is ACTIVE",
    "STOP: the HAL is HOLD",
]


def messages(
    world: World, node: PendantNode, keyboard: Keyboard, time: float, capsys: pytest.CaptureFixture[str]
) -> list[str]:
    """Take over, start, and run for a time [s]. Return the messages from the first ACTIVE on."""
    operator = Session(node, TARGET, StopRequest(), keyboard, now=lambda: world.now)
    operator.take_over()
    operator.start_wanted = True
    operator.run(time)
    return capsys.readouterr().err.splitlines()[4:]


def test_start_typed_after_answers_without_room_is_pressed_once_and_accepted(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    end = world.wire.end(world.cycle)
    node = PendantNode(world.network, end)

    class TypesWhenFull(Keyboard):
        """Fills the transmit queue for 50 answers after 300 answers, and types start after 49 of them."""

        def lines(self) -> list[str]:
            end.full = 300 <= node.answered < 350
            return ["start"] if node.answered == 349 else []

    assert messages(world, node, TypesWhenFull(None), 0.7, capsys) == RESTARTED


def test_stop_without_a_sync_is_reported_as_not_sent(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    class EndsTheHal(Keyboard):
        def lines(self) -> list[str]:
            world.running = operator.node.hal is not ACTIVE
            return []

    operator = world.session(keyboard=EndsTheHal(None))
    operator.take_over()
    operator.start_wanted = True
    operator.run(2.0)
    assert capsys.readouterr().err.splitlines()[-2:] == [
        "no SYNC received on pcan test: waiting for a HAL",
        "STOP was not sent, because no SYNC was received on pcan test; the HAL was last ACTIVE",
    ]


def test_start_typed_after_lost_syncs_is_pressed_once_and_accepted(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    end = world.wire.end(world.cycle)
    node = PendantNode(world.network, end)

    class TypesAfterGap(Keyboard):
        """After 300 answers, loses 30 SYNCs, and types start immediately."""

        def lines(self) -> list[str]:
            if node.answered != 300 or world.hal.state.supervisor is not ACTIVE:
                return []
            world.run(30)
            end.queue.clear()
            assert world.hal.state.supervisor is HOLD
            return ["start"]

    assert messages(world, node, TypesAfterGap(None), 0.5, capsys) == RESTARTED
