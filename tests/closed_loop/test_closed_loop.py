"""Closed loop of HAL, controller and emulator. Each bus has a subclass, which connects the two ends of the bus.

The SocketCAN subclass is in tests/vcan, where the emulator runs in another process.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_dbc import Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus import Bus, open_bus
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import Robot
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import DriveState

S = SupervisorState
#: Short motion to the first pose, because these tests are about the steps.
CONFIG = AirwalkConfig(startup=0.5)


class ClosedLoop:
    """Walk of one and a half steps: OFF, ACTIVE, HOLD."""

    #: Longest wait for the frames of the nodes [s]. On a slow machine, a run in lock-step takes longer but does not fail.
    patience = 5.0
    until_phase = 1.5  # steps

    @pytest.fixture
    def bus(self) -> Iterator[Bus]:
        """Return the HAL's end of the bus. At the other end is the emulator, whose operator sets Xi = 0.5."""
        raise NotImplementedError("a subclass connects the ends")  # pragma: no cover

    @pytest.fixture
    def walked(self, bus: Bus, network: Network, robot: Robot) -> Any:
        controller = AirwalkController(robot, load_gait(AIRWALK_GAIT, robot), SHAPES["constant"], CONFIG)
        hal = Hal(network, robot, bus, patience=self.patience, controller_fields=controller.telemetry_fields)
        records: list[np.ndarray] = []
        cycles = round((CONFIG.startup + self.until_phase * 0.8) * 1000)
        active = [0]

        def record() -> None:
            if hal.state.supervisor is S.ACTIVE:
                active[0] += 1
            records.append(hal.record.copy())

        run(hal, controller, LockStep(), until=lambda state: active[0] >= cycles or state.cycle > 6000, record=record)
        return hal, controller, np.array(records)

    def test_walks_inside_its_guide_and_ends_in_hold(self, walked: Any) -> None:
        hal, controller, records = walked
        column = {name: records[:, hal.layout[name]] for name in hal.layout}
        active = column["supervisor"][:, 0] == S.ACTIVE
        assert controller.statistics.steps == 1, hal.reason
        assert [e.code for e in hal.events if e.code in S.__members__] == ["READY", "ACTIVE", "HOLD"]
        assert hal.crc_errors == 0
        # Every joint follows its reference, and the assisted joints are inside the guide.
        walking = active & (column["controller.phase"][:, 0] > 0)
        off = np.abs(column["position"] - column["controller.q_des"])[walking]
        assert math.degrees(off.max()) < 6.0
        ratio = np.abs(column["controller.error"]) / np.maximum(column["controller.q_bound"], 1e-9)
        assert ratio[walking].max() <= 1.1
        assert (column["assistance_factor"][active] == 0.5).all()
        assert (np.abs(column["torque_command"]) <= hal.robot.torque_max).all()
        assert (column["drive_state"][active] == DriveState.OPERATION_ENABLED).all()
        # The robot walks: its left knee bends by more than 30 degrees.
        assert math.degrees(np.ptp(column["position"][active][:, 3])) > 30.0
        assert hal.state.supervisor is S.HOLD
        assert (hal.state.drive_state == DriveState.QUICK_STOP_ACTIVE).all()


@pytest.fixture
def make_emulator(network: Network, robot: Robot, urdf_text: str) -> Iterator[Callable[[Bus], Emulator]]:
    bodies = []

    def make(bus: Bus, seed: int = 0) -> Emulator:
        body = PyBulletBody(urdf_text)
        bodies.append(body)
        return Emulator(network, robot, body, bus, seed=seed, operator=Operator(0.5))

    yield make
    for body in bodies:
        body.close()


class TestEmbedded(ClosedLoop):
    @pytest.fixture
    def bus(self, make_emulator: Callable[[Bus], Emulator]) -> Iterator[Bus]:
        ours, theirs = lockstep_pair()
        ours.step = make_emulator(theirs).poll
        return ours


class TestPythonCanVirtual(ClosedLoop):
    @pytest.fixture
    def bus(self, make_emulator: Callable[[Bus], Emulator]) -> Iterator[Bus]:
        ours, theirs = open_bus("virtual", "closed loop"), open_bus("virtual", "closed loop")
        emulator = make_emulator(theirs)
        over = threading.Event()

        def answer() -> None:
            while not over.is_set():
                emulator.poll(0.05)

        nodes = threading.Thread(target=answer)
        nodes.start()
        yield ours
        over.set()
        nodes.join()
        ours.close()
        theirs.close()
