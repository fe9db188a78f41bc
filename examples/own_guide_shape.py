"""Walk inside a virtual guide of your own shape: wide at start and end of the step, +-3 degrees in the middle of the step.

Run it:  python examples/own_guide_shape.py

Prints whether the guide is certified for the assistance factor 0.5, and the largest ratio |e| / q_bound during two steps in the
air. e is the tracking error, and q_bound is the distance from the desired trajectory to the bound of the guide. If the ratio is
below 1, hip and knee of the swing leg stayed inside the guide.
"""

import argparse

import numpy as np

from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import GuideShape
from atalante_hal.robot import load_robot
from atalante_tools.console.options import Target
from atalante_tools.session.rig import open_hal

XI = 0.5  # assistance factor


def waist(phase, half_width):
    """Return two arrays of shape (n,): the upper and the lower bound of the guide, as fractions of the half-width.

    Args:
        phase: time since the start of the step divided by the step duration, 0 to 1, shape (n,).
        half_width: half-width of the guide for the chosen assistance factor [rad].
    """
    narrowest = min(1.0, np.radians(3.0) / half_width)
    fraction = 1.0 - (1.0 - narrowest) * np.sin(np.pi * phase) ** 2
    return fraction, fraction


argparse.ArgumentParser(description=__doc__).parse_args()  # no arguments
robot = load_robot()
gait = load_gait(AIRWALK_GAIT, robot)
controller = AirwalkController(robot, gait, GuideShape("waist", "3 degrees at the middle of the step", waist))
certificate = controller.certificate(XI)
print("certified" if certificate.certified else "not certified", "-", certificate.reason)

target = Target("embedded", "", lockstep=True)
with open_hal(target, assistance_factor=XI, controller_fields=controller.telemetry_fields) as rig:
    rig.run(controller, until=lambda state: controller.statistics.steps >= 2)
    print(f"{rig.hal.reason}; largest |e| / q_bound {controller.statistics.max_ratio:.2f}")
