"""The crane suspends the robot, lowers it onto its feet and lifts it again, in both engines."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from atalante_control.model import ExoskeletonParameters, Patient, urdf
from atalante_dbc import Network
from atalante_emulator.bodies import ENGINES, Body, Pose, lowest_corner
from atalante_emulator.crane import DELAY, Crane
from atalante_emulator.emulator import Emulator
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.robot import load_robot
from atalante_hal.types import GRAVITY, PERIOD, SupervisorState
from atalante_hal.wire.frame import new_frames
from atalante_hal.wire.process_image import TransmitImage

ROBOT = load_robot()
STANDING = [0.0, 0.0, -0.2, 0.45, -0.25, 0.0] * 2
KP, KD = np.array([9000, 4000, 6000, 6000, 4000, 2500] * 2), np.array([200, 90, 160, 140, 60, 25] * 2)
WEARERS = {"empty": None, "light": Patient(45.0, 1.5), "heavy": Patient(110.0, 2.0)}


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=WEARERS)
def body(engine: str, request: pytest.FixtureRequest) -> Iterator[Body]:
    text = urdf(ExoskeletonParameters(), ROBOT, WEARERS[request.param])
    made = Mechanics(text, engine, Ground()).make_body(STANDING)
    yield made
    made.close()


def run(body: Body, crane: Crane, seconds: float, state: int = SupervisorState.READY) -> list[float]:
    """Hold the pose for `seconds`; return the upward force of the crane in each cycle [N]."""
    tension = []
    for _ in range(round(seconds / PERIOD)):
        wrench = crane(state)
        tension.append(float(wrench[2]))
        body.push(wrench[:3], wrench[3:])
        body.step((KP * (np.array(STANDING) - body.position) - KD * body.velocity).tolist())
    return tension


def test_robot_is_suspended_above_the_floor_until_active(body: Body) -> None:
    crane = Crane(body)
    tension = run(body, crane, 2.0)
    assert np.mean(tension[-200:]) == pytest.approx(body.mass * GRAVITY, rel=0.01)
    assert np.ptp(tension[-200:]) < 0.02 * body.mass * GRAVITY
    assert lowest_corner(body) > 0.02
    assert not body.touching
    assert np.abs(body.motion("pelvis").attitude[:2]).max() < 0.02


@pytest.mark.sample(3)
def test_robot_is_lowered_in_active_and_then_stands_alone(body: Body) -> None:
    crane = Crane(body)
    run(body, crane, 0.2)
    run(body, crane, 0.9 * DELAY, SupervisorState.ACTIVE)
    assert lowest_corner(body) > 0.02
    run(body, crane, 3.5, SupervisorState.ACTIVE)
    assert crane.lowered
    assert run(body, crane, 0.1, SupervisorState.HOLD) == [0.0] * 100
    assert body.sole_force[:, :, 2].sum() == pytest.approx(body.mass * GRAVITY, rel=0.05)


def test_crane_does_not_lower_the_robot_after_the_end_of_the_hal(network: Network) -> None:
    body = Mechanics(urdf(ExoskeletonParameters(), ROBOT, None), ENGINES[0], Ground()).make_body(STANDING)
    hal, nodes = lockstep_pair()
    emulator = Emulator(network, ROBOT, body, nodes)
    emulator.pelvis_forces.append(Crane(body))
    syncs = TransmitImage([m for m in network.sent_by("HAL") if m.name.startswith("SYNC_")])
    syncs.values[syncs.codec.slice("HalState")] = SupervisorState.ACTIVE
    hal.step = emulator.poll
    buffer = new_frames(128)
    for cycle in range(round(0.5 * DELAY / PERIOD)):
        syncs.values[syncs.codec.slice("Cycle")] = cycle
        hal.send(syncs.seal())
        hal.receive(buffer)
    height = float(body.motion("pelvis").position[2])
    for _ in range(round(2.0 * DELAY / PERIOD)):
        emulator.idle()
    assert body.motion("pelvis").position[2] > height - 0.02
    body.close()


@pytest.mark.sample(3)
def test_robot_is_lifted_at_its_current_position(body: Body) -> None:
    crane = Crane(body, automatic=False)
    run(body, crane, 1.0, SupervisorState.ACTIVE)
    assert not body.touching
    crane.lower()
    run(body, crane, 3.0)
    assert crane.lowered
    at = body.motion("pelvis").position
    crane.lift()
    run(body, crane, 3.0)
    assert not crane.lowered
    assert not body.touching
    assert lowest_corner(body) > 0.02
    np.testing.assert_allclose(body.motion("pelvis").position[:2], at[:2], atol=0.02)


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_crane_holds_the_initial_heading(engine: str, heading: float) -> None:
    body = Mechanics(urdf(ExoskeletonParameters(), ROBOT), engine, Ground()).make_body(STANDING)
    upright = np.array([0.0, 0.0, np.sin(0.5 * heading), np.cos(0.5 * heading)])
    body.reset(STANDING, Pose((0.0, 0.0, 1.2), upright.tolist()))
    run(body, Crane(body), 1.0)
    assert abs(body.motion("pelvis").attitude @ upright) == pytest.approx(1.0, abs=1e-3)
    body.close()
