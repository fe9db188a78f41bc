"""Determinism: runs with the same seed exchange identical frames, in one process and in two processes."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_emulator.faults import Fault
from atalante_hal.wire.frame import Frames
from atalante_tools.console.options import Target
from atalante_tools.session.embedded import EmbeddedRobot
from atalante_tools.session.rig import open_hal


class Log:
    """Tap that keeps identifier and data of every frame, in order."""

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
def log_of(network, robot):
    def walk(seed: int, cycles: int = 1500, robot_process: EmbeddedRobot | None = None) -> bytes:
        controller = AirwalkController(
            robot, load_gait(AIRWALK_GAIT, robot), SHAPES["pinched"], AirwalkConfig(startup=0.3)
        )
        log = Log()
        fields = controller.telemetry_fields
        faults = [
            Fault("drop", "LEFT_SK_STATE", start=1100, cycles=2),
            Fault("drop", "SYNC_RIGHT_LEG", start=1150, cycles=1),
            Fault("drop", "COMMAND_LEFT_LEG", start=1200, cycles=2),
        ]
        with open_hal(
            Target("embedded", "", lockstep=True), network=network, robot=robot, seed=seed, assistance_factor=0.5,
            controller_fields=fields, tap=log, faults=faults, robot_process=robot_process,
        ) as rig:  # fmt: skip
            rig.run(controller, until=lambda state: state.cycle >= cycles)
            assert np.ptp(rig.hal.state.position) > 0.3
        return bytes(log.data)

    return walk


def test_same_seed_gives_the_same_frames_and_another_seed_does_not(log_of):
    first = log_of(7)
    assert len(first) > 1400 * 20 * 12
    assert log_of(7) == first
    assert log_of(8) != first
    assert log_of(7, robot_process=EmbeddedRobot()) == first
