"""Robot, HAL, two pendants and a listener on real SocketCAN in lock-step. Each has its own socket."""

from __future__ import annotations

import time
from contextlib import ExitStack

from atalante_dbc import Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_hal.bus.socketcan import SocketCanBus
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot
from atalante_hal.safety.start import ENABLE_CYCLES
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import new_frames
from atalante_tools.commands.observer import Observer
from atalante_tools.session.pendant_node import PendantNode, Request
from tests.vcan.conftest import PATIENCE, Loop, repeated


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
        first.dead_man = True
        first.start_sending()
        for work in (lambda: emulator.poll(0.05), lambda: first.poll(0.05), lambda: second.poll(0.05)):
            stack.enter_context(repeated(work))

        cycles = Loop(hal, lambda: listener.accept(block, listening.receive(block), time.monotonic())).cycles
        assert cycles(400, SupervisorState.READY) is SupervisorState.READY, hal.missing()
        first.press(Request.START)
        assert cycles(ENABLE_CYCLES, SupervisorState.ACTIVE) is SupervisorState.ACTIVE, hal.reason
        second.start_sending()
        assert cycles(70) is SupervisorState.ACTIVE, hal.reason
        assert (first.displaced, second.displaced, second.takeover_failed) == (True, False, False)
        second.press(Request.HOLD)
        assert cycles(10) is SupervisorState.HOLD
        assert hal.crc_errors == 0

        report = listener.report(time.monotonic(), listening.dropped)
        assert (report.supervisor, report.crc_errors, report.foreign, report.dropped) == ("HOLD", 0, 0, 0)
        assert all(node.dbc_ok for node in report.nodes)
