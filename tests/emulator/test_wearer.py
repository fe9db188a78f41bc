from __future__ import annotations

import numpy as np
import pytest

from atalante_control.model import ExoskeletonParameters, Patient, urdf
from atalante_emulator.emulator import Emulator
from atalante_emulator.mechanics import Mechanics
from atalante_emulator.pendant import Operator
from atalante_emulator.wearer import LimbParameters, PassiveWearer
from atalante_hal.bus.pair import lockstep_pair


def test_limbs_are_springs_and_dampers_about_their_rest_angles() -> None:
    parameters = LimbParameters((10.0,) * 6, (2.0,) * 6, (0.1, 0.0, -0.2, 0.4, 0.0, 0.0))
    wearer, torque = PassiveWearer(parameters), np.full(12, 99.0)
    rest = np.array(parameters.rest * 2)
    wearer.act(rest, np.zeros(12), torque)
    np.testing.assert_allclose(torque, 0.0, atol=1e-12)
    wearer.act(rest + 0.1, np.full(12, 0.5), torque)
    np.testing.assert_allclose(torque, -10.0 * 0.1 - 2.0 * 0.5)


@pytest.mark.parametrize("seed", range(3))
def test_limbs_dissipate_energy_over_a_closed_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wearer, torque = PassiveWearer(), np.zeros(12)
    phase, size = rng.uniform(0.0, 6.0, 12), rng.uniform(0.1, 1.0, 12)
    time = np.linspace(0.0, 2.0 * np.pi, 2001)[:-1]
    work = 0.0
    for t in time:
        velocity = size * np.cos(t + phase)
        wearer.act(size * np.sin(t + phase), velocity, torque)
        work += float(torque @ velocity)
    assert work < 0.0


def test_limbs_move_the_joints_of_the_emulated_robot(network, robot) -> None:
    """Without power, the knees of a suspended robot move against the brakes towards the rest angle of stiff limbs."""
    text, ends = urdf(ExoskeletonParameters(), robot, Patient(75.0, 1.75)), []
    for limbs in (None, LimbParameters((0.0, 0.0, 0.0, 400.0, 0.0, 0.0), (0.0,) * 6, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0))):
        mechanics = Mechanics(text, limbs=limbs)
        body = mechanics.make_body()
        emulator = Emulator(network, robot, body, lockstep_pair()[1], operator=Operator())
        mechanics.complete(emulator)
        for _ in range(200):
            emulator.idle()
        ends.append(float(body.position[3]))
        body.close()
    assert ends[1] > ends[0] + 0.2
