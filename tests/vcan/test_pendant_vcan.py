"""Robot, HAL, two pendants and a listener on real SocketCAN, each on a socket of its own, in lock-step."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from atalante_dbc import Network
from atalante_emulator.body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_hal.bus.socketcan import SocketCanBus
from atalante_hal.frame import new_frames
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot
from atalante_hal.types import SupervisorState
from atalante_tools.observer import Observer
from atalante_tools.pendant_node import PendantNode, Request
from atalante_tools.pose_hold import PoseHold

PATIENCE = 60.0  # s


@contextmanager
def repeated(work: Callable[[], object]) -> Iterator[None]:
    """`work` again and again in a thread of its own."""
    over = threading.Event()

    def run() -> None:
        while not over.is_set():
            work()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def test_a_second_pendant_takes_over_and_holds(vcan: str, network: Network, robot: Robot, urdf_text: str) -> None:
    with ExitStack() as stack:

        def socket() -> SocketCanBus:
            bus = SocketCanBus(vcan)
            stack.callback(bus.close)
            return bus

        body = PyBulletBody(urdf_text)
        stack.callback(body.close)
        emulator = Emulator(network, robot, body, socket())
        hal = Hal(network, robot, socket(), patience=PATIENCE)
        first, second = PendantNode(network, socket()), PendantNode(network, socket())
        listening, block = socket(), new_frames(256)
        listener = Observer(network, robot, time.monotonic())
        controller = PoseHold(robot)
        first.dead_man = True
        first.speak()
        for work in (lambda: emulator.poll(0.05), lambda: first.poll(0.05), lambda: second.poll(0.05)):
            stack.enter_context(repeated(work))

        def cycles(count: int, wanted: SupervisorState | None = None) -> SupervisorState:
            active = hal.state.supervisor is SupervisorState.ACTIVE
            for _ in range(count):
                state = hal.read()
                if state.supervisor is SupervisorState.ACTIVE:
                    if not active:
                        controller.reset(state)
                    hal.write(controller.update(state))
                else:
                    hal.hold()
                active = state.supervisor is SupervisorState.ACTIVE
                listener.take(block, listening.receive(block), time.monotonic())
                if state.supervisor is wanted:
                    break
            return hal.state.supervisor

        assert cycles(400, SupervisorState.READY) is SupervisorState.READY, hal.missing()
        first.press(Request.START)
        assert cycles(60, SupervisorState.ACTIVE) is SupervisorState.ACTIVE, hal.reason
        second.speak()
        assert cycles(70) is SupervisorState.ACTIVE, hal.reason
        assert (first.displaced, second.displaced, second.refused) == (True, False, False)
        second.press(Request.HOLD)
        assert cycles(10) is SupervisorState.HOLD
        assert hal.crc_errors == 0

        report = listener.report(time.monotonic(), listening.dropped)
        assert (report.supervisor, report.crc_errors, report.foreign, report.dropped) == ("HOLD", 0, 0, 0)
        assert all(node.dbc_ok for node in report.nodes)
