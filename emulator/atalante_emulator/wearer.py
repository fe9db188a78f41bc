"""Passive wearer of the emulated robot: the impedance of relaxed limbs at the joints. The masses of the limbs are in the URDF.

A passive wearer applies no muscle torque. But tendons and soft tissue act like a spring and a damper at each joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, SIDES
from atalante_hal.types import Vector


@dataclass(frozen=True)
class LimbParameters:
    """Impedance of relaxed legs. A tuple has one value per leg joint: FH, TH, SH, SK, SA, HA. The values are assumptions."""

    stiffness: tuple[float, ...] = (20.0, 10.0, 20.0, 15.0, 15.0, 5.0)  # stiffness of each joint [Nm/rad]
    damping: tuple[float, ...] = (2.0, 1.0, 2.0, 1.5, 1.0, 0.5)  # damping of each joint [Nm s/rad]
    rest: tuple[float, ...] = (0.0, 0.0, -0.2, 0.4, -0.1, 0.0)  # joint angles at which the stiffness torque is 0 [rad]


def _impedance(
    offset: Vector, stiffness: Vector, damping: Vector, position: Vector, velocity: Vector, torque: Vector
) -> None:
    """Compute the torques of springs and dampers at the joints.

    Args:
        offset: torque of each spring at joint angle 0, shape (12,) [Nm].
        stiffness: stiffness of each spring, shape (12,) [Nm/rad].
        damping: damping of each joint, shape (12,) [Nm s/rad].
        position: joint positions, shape (12,) [rad].
        velocity: joint velocities, shape (12,) [rad/s].
        torque: output for the torques, shape (12,) [Nm].
    """
    for joint in range(len(torque)):
        torque[joint] = offset[joint] - stiffness[joint] * position[joint] - damping[joint] * velocity[joint]


class PassiveWearer:
    """Relaxed legs of a wearer."""

    def __init__(self, parameters: LimbParameters | None = None) -> None:
        """Create the wearer.

        Args:
            parameters: impedance of the limbs. With None, the default impedance is used.
        """
        parameters = parameters or LimbParameters()
        both = len(SIDES)
        self._stiffness = np.array(parameters.stiffness * both)
        self._damping = np.array(parameters.damping * both)
        self._offset = self._stiffness * np.array(parameters.rest * both)
        self._impedance = compiled(_impedance)
        # Compile `_impedance` now. In the first control cycle, the compilation would take too long.
        self.act(*np.zeros((3, len(JOINTS))))

    def act(self, position: Vector, velocity: Vector, torque: Vector) -> None:
        """Compute the torques of the limbs on the joints.

        Args:
            position: joint positions, shape (12,) [rad].
            velocity: joint velocities, shape (12,) [rad/s].
            torque: output for the torques, shape (12,) [Nm].
        """
        self._impedance(self._offset, self._stiffness, self._damping, position, velocity, torque)
