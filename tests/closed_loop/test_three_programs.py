"""Robot, controller and pendant of the README in three threads on python-can's `virtual` bus, started in every order.

The folder tests/vcan has the same test on SocketCAN, with three processes that are also killed and disconnected.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from atalante_dbc import Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_hal.bus import Bus, open_bus
from atalante_hal.hal import Hal
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import Robot
from atalante_hal.types import SupervisorState
from atalante_tools.commands.emulator_line import Line
from atalante_tools.console.options import Target
from atalante_tools.console.stop_request import StopRequest
from atalante_tools.session.pendant_node import PendantNode
from atalante_tools.session.pendant_session import Keyboard, Session
from atalante_tools.session.pose_hold import PoseHold
from atalante_tools.session.rig import LOCKSTEP_PATIENCE

S = SupervisorState
TARGET = Target("virtual", "three programs", lockstep=True)
ROBOT, CONTROLLER, PENDANT = "robot", "controller", "pendant"
#: Largest number of cycles from the start of the last program to ACTIVE: two seconds of robot time.
ACTIVE_BY = 2000
#: Longest wait for a state [s].
PATIENCE = 60.0


class Programs:
    """The three programs. Each program has its own thread and its own end of the bus, and runs until its stop request."""

    def __init__(self, network: Network, robot: Robot, urdf_text: str) -> None:
        self._network, self._limits, self._urdf_text = network, robot, urdf_text
        self._threads: dict[str, threading.Thread] = {}
        self._stops: dict[str, StopRequest] = {}
        self.hal: Hal | None = None

    def start(self, name: str) -> None:
        """Start a program."""
        programs: dict[str, Callable[[Bus, StopRequest], None]] = {
            ROBOT: self._robot,
            CONTROLLER: self._controller,
            PENDANT: self._pendant,
        }
        stop = self._stops[name] = StopRequest()

        def work() -> None:
            bus = open_bus(TARGET.interface, TARGET.channel)
            try:
                programs[name](bus, stop)
            finally:
                bus.close()

        self._threads[name] = threading.Thread(target=work, name=name)
        self._threads[name].start()

    def end(self, name: str) -> None:
        """Request a program to stop, and wait for its end."""
        self._stops[name].wanted = True
        self._threads.pop(name).join()

    def wait_for(self, state: SupervisorState) -> None:
        """Wait until the HAL is in a state."""
        deadline = time.monotonic() + PATIENCE
        while self.hal is None or self.hal.state.supervisor is not state:
            assert time.monotonic() < deadline, self.hal and (self.hal.state.supervisor, self.hal.reason)
            time.sleep(0.001)

    def close(self) -> None:
        """Stop all programs that still run. The robot is the last, because the others wait for its frames for a long time."""
        for name in (CONTROLLER, PENDANT, ROBOT):
            if name in self._threads:
                self.end(name)

    def _robot(self, bus: Bus, stop: StopRequest) -> None:
        body = PyBulletBody(self._urdf_text)
        emulator = Emulator(self._network, self._limits, body, Line(bus, self._network))
        while not stop.wanted:
            emulator.poll(0.02)
        body.close()

    def _controller(self, bus: Bus, stop: StopRequest) -> None:
        controller = PoseHold(self._limits)
        fields = controller.telemetry_fields
        hal = Hal(self._network, self._limits, bus, patience=LOCKSTEP_PATIENCE, controller_fields=fields)
        hal.listen()
        self.hal = hal
        run(hal, controller, LockStep(), until=lambda state: stop.wanted)

    def _pendant(self, bus: Bus, stop: StopRequest) -> None:
        session = Session(PendantNode(self._network, bus), TARGET, stop, Keyboard(None))
        session.take_over()
        session.start_wanted = True
        session.run(None)


@pytest.fixture
def programs(network: Network, robot: Robot, urdf_text: str) -> Iterator[Programs]:
    made = Programs(network, robot, urdf_text)
    yield made
    made.close()


@pytest.mark.sample(6)
@pytest.mark.parametrize("order", list(itertools.permutations((ROBOT, CONTROLLER, PENDANT))), ids="-".join)
def test_every_order_of_the_three_programs_becomes_active_within_two_seconds(
    programs: Programs, order: tuple[str, ...]
) -> None:
    for name in order[:2]:
        programs.start(name)
        time.sleep(0.3)
    before = programs.hal.state.cycle if programs.hal else 0
    programs.start(order[2])
    programs.wait_for(S.ACTIVE)
    assert programs.hal is not None
    assert programs.hal.state.cycle - before <= ACTIVE_BY
    programs.end(PENDANT)
    programs.wait_for(S.HOLD)
    programs.start(PENDANT)
    programs.wait_for(S.ACTIVE)
