"""One seed, one sequence of bytes: on the bus, whatever else the machine does."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_control.controller import HangConfig, HangController
from atalante_control.gait import HANG_GAIT, load_gait
from atalante_control.guide_shapes import SHAPES
from atalante_emulator.body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.frame import Frames
from atalante_hal.hal import Hal
from atalante_hal.loop import LockStep, run


class Log:
    """Every byte of every frame, in order."""

    def __init__(self) -> None:
        self.data = bytearray()

    def sent(self, frames: Frames) -> None:
        self._add(frames, len(frames))

    def received(self, frames: Frames, count: int) -> None:
        self._add(frames, count)

    def _add(self, frames: Frames, count: int) -> None:
        for frame in frames[:count]:
            self.data += int(frame["can_id"]).to_bytes(4, "little") + frame["data"][: frame["len"]].tobytes()


@pytest.fixture
def log_of(network, robot, urdf_text):
    def walk(seed: int, cycles: int = 1500) -> bytes:
        ours, theirs = lockstep_pair()
        body = PyBulletBody(urdf_text)
        emulator = Emulator(network, robot, body, theirs, seed=seed, operator=Operator(0.5))
        ours.step = emulator.poll
        controller = HangController(robot, load_gait(HANG_GAIT, robot), SHAPES["pinched"], HangConfig(startup=0.3))
        log = Log()
        hal = Hal(network, robot, ours, controller_fields=controller.telemetry_fields, tap=log)
        run(hal, controller, LockStep(), until=lambda state: state.cycle >= cycles)
        assert np.ptp(hal.state.position) > 0.3
        body.close()
        return bytes(log.data)

    return walk


def test_one_seed_gives_the_same_bytes_and_another_does_not(log_of):
    first = log_of(7)
    assert len(first) > 1500 * 20 * 12
    assert log_of(7) == first
    assert log_of(8) != first
