"""Test of the measured motion of a drive: the velocity must be the change of the position."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from atalante_hal.types import PERIOD
from atalante_tools.conform.node_tester import NodeTester, NotTested
from atalante_tools.conform.requirement import Outcome

#: Length of a window [cycles]. In each window, the integral of the velocity is compared with the change of the position.
WINDOW: Final = 50
#: The integral of the velocity, divided by the change of the position, must be from 1 - `RATIO` to 1 + `RATIO`.
#: A velocity filter in the drive changes the ratio only slightly, because the filter delays the integral and does not scale it.
RATIO: Final = 0.2
#: Smallest root mean square of the motion over all windows, as an angle of the motor [rad]. A smaller motion is not compared.
#: The velocity signal has a finite resolution. The resulting rounding error of the integral over a window is at most
#: `MOTION` / 20.
MOTION: Final = 0.01


def reports_consistent_motion(tester: NodeTester) -> Outcome:
    """Test DRIVE-25: the integral of the velocity equals the change of the position, in all state frames received.

    The test needs no motion of its own, because the joint moves in the other tests.
    """
    if not tester.states(tester.received):
        tester.idle(4 * WINDOW)
    received = tester.states(tester.received)
    cycles = np.array([frame.cycle for frame in received], dtype=np.int64)
    position = np.array([frame.values["Position"] for frame in received])
    velocity = np.array([frame.values["Velocity"] for frame in received])
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(cycles) * PERIOD
    integral = np.concatenate([[0.0], np.cumsum(steps)])
    signal = tester.state_message.signal("Velocity")
    # If the velocity is outside the DBC range, a drive sends the nearest limit of the range.
    # Windows that contain such a value are left out.
    clipped = (velocity <= signal.minimum) | (velocity >= signal.maximum)
    count = np.cumsum(clipped)
    complete = cycles[WINDOW:] - cycles[:-WINDOW] == WINDOW  # windows without a lost frame
    complete &= count[WINDOW:] == (count - clipped)[:-WINDOW]
    change = (position[WINDOW:] - position[:-WINDOW])[complete]
    expected = (integral[WINDOW:] - integral[:-WINDOW])[complete]
    if not len(change):
        raise NotTested(
            f"{WINDOW} consecutive state frames of the DBC length must be received; see NODE-04 and NODE-13"
        )
    moved, integrated = math.sqrt(np.mean(change**2)), math.sqrt(np.mean(expected**2))
    text = (
        f"in {WINDOW} ms the position changes by {moved:.3f} rad, the integral of the velocity by {integrated:.3f} rad"
    )
    if max(moved, integrated) < MOTION:
        raise NotTested(f"the motor must move by {MOTION:g} rad; {text}; turn the joint by hand during the examination")
    if moved < MOTION * RATIO:
        return Outcome(False, text)
    ratio = float(change @ expected / (change @ change))
    return Outcome(abs(ratio - 1.0) <= RATIO, f"{text}, ratio {ratio:+.2f}")
