"""Compiled cycle of the controller, compared with the same source run as Python."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_hal.robot import load_robot
from atalante_hal.types import State, SupervisorState

ROBOT = load_robot()
GAIT = load_gait(AIRWALK_GAIT, ROBOT)
STARTUP = 20  # cycles


def controller(config: AirwalkConfig = AirwalkConfig()) -> AirwalkController:  # noqa: B008
    return AirwalkController(ROBOT, GAIT, SHAPES["pinched"], replace(config, startup=STARTUP * 1e-3))


def states(xi: float) -> list[State]:
    """Return the states of some cycles of two steps. Joints deviate from the gait, and every sensor has noise."""
    rng, tables, result = np.random.default_rng(2), GAIT.tables(), []
    attitude = np.zeros((4, 4))
    attitude[:, 0] = 1.0
    zeros = [np.zeros(n) for n in (12, 12, 12)]
    for since in [*range(STARTUP + 12), *range(400, 410), *range(STARTUP + 795, STARTUP + 812)]:
        at = (since - STARTUP) % 800
        # The start motion from the first pose takes no longer than `STARTUP`.
        first = since == 0
        q = tables.q[0 if first else at] + rng.normal(size=12) * 0.02 * (not first)
        qd = tables.qd[at] + rng.normal(size=12) * 0.2
        tilted = attitude + rng.normal(size=(4, 4)) * 0.05
        tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
        sensors = [tilted, rng.normal(size=(4, 3)), np.zeros((4, 3)), np.zeros((2, 4, 3)), np.zeros(8)]
        valid, age = np.ones(24, bool), np.zeros(24, int)
        result.append(State(since, since * 1e-3, SupervisorState.ACTIVE, xi, q, qd, *zeros, *sensors, valid, age, True))
    return result


@pytest.mark.sample(5)
@pytest.mark.parametrize(
    ("xi", "config"),
    [
        (0.5, AirwalkConfig()),
        (0.95, AirwalkConfig()),
        (1.0, AirwalkConfig()),
        (0.5, AirwalkConfig.literal()),
        (1.0, AirwalkConfig.literal()),
    ],
)
def test_compiled_cycle_equals_its_python_source(monkeypatch: pytest.MonkeyPatch, xi: float, config: AirwalkConfig):
    machine = controller(config)
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    source = controller(config)
    walked = states(xi)
    machine.reset(walked[0])
    source.reset(walked[0])
    for state in walked:
        one, other = machine.update(state), source.update(state)
        np.testing.assert_allclose(one.torque, other.torque, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(one.vibration, other.vibration, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(machine.telemetry, source.telemetry, rtol=1e-11, atol=1e-9)
        assert one.outside == other.outside
    assert machine.statistics.steps == source.statistics.steps == 1


def test_flat_foot_option_changes_only_the_swing_ankle_targets():
    walked = states(0.5)[: STARTUP + 10]
    level, free = (
        controller(),
        AirwalkController(ROBOT, GAIT, SHAPES["pinched"], replace(controller().config, flat_foot=False)),
    )
    for one in (level, free):
        one.reset(walked[0])
        for state in walked:
            one.update(state)
    targets = [one.telemetry[[4, 5, 10, 11]] for one in (level, free)]
    assert (targets[0][:2] != targets[1][:2]).all()  # the left leg swings
    np.testing.assert_array_equal(targets[0][2:], targets[1][2:])
