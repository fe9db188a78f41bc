"""Run your own controller. This controller holds the pose that the robot has when the operator presses START.

Run it:  python examples/hold_pose.py                       on an emulated robot, for two seconds of robot time
         python examples/hold_pose.py socketcan vcan0       on a robot or an emulator on a CAN bus

Prints the reason for HOLD and the joint angles [deg] at the end of the run.
"""

import sys

import numpy as np

from atalante_hal.types import Command
from atalante_tools.console.options import target_of
from atalante_tools.console.outcome import one_sentence
from atalante_tools.session.rig import open_hal


class Spring:
    """PD controller that holds the start pose."""

    telemetry, telemetry_fields = np.zeros(0), ()

    def reset(self, state):
        """Store the measured pose as the pose to hold."""
        self.rest = state.position.copy()

    def update(self, state):
        """Return the joint torques [Nm] and the levels of the vibration motors for this cycle."""
        return Command(torque=2000 * (self.rest - state.position) - 20 * state.velocity, vibration=np.zeros(8))


with one_sentence(), open_hal(target_of(sys.argv[1:])) as rig:
    rig.run(Spring(), until=lambda state: state.time >= 2.0)
    print(rig.hal.reason, np.degrees(rig.hal.state.position).round(1))
