"""Run the HAL on your own bus: a bus that counts the frames of each message.

Run it:  python examples/own_bus.py

A bus is any object with the members of `atalante_hal.bus.Bus`. `WrappedBus` has all these members and forwards each call
to the wrapped bus, so a subclass overrides only the members that it changes. Prints the state of the HAL, and the three
messages with the most frames.
"""

import argparse
from collections import Counter

import atalante_dbc
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.hal import Hal
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import load_robot
from atalante_tools.session.body import open_body
from atalante_tools.session.pose_hold import PoseHold


class CountingBus(WrappedBus):
    """Bus that counts sent and received frames by CAN identifier."""

    def __init__(self, bus):
        super().__init__(bus)
        self.count = Counter()

    def send(self, frames):
        """Count the frames, then send them."""
        self.count.update(frames["can_id"].tolist())
        super().send(frames)

    def receive(self, frames, timeout=0.0):
        """Receive frames, then count them."""
        received = super().receive(frames, timeout)
        self.count.update(frames["can_id"][:received].tolist())
        return received


argparse.ArgumentParser(description=__doc__).parse_args()  # no arguments
network, robot = atalante_dbc.load(), load_robot()
hal_end, robot_end = lockstep_pair()  # the two ends of a bus in this process
bus, controller = CountingBus(hal_end), PoseHold(robot)
with open_body(robot) as body:
    emulator = Emulator(network, robot, body, robot_end, operator=Operator())
    hal_end.step = emulator.poll  # a call of `receive` by the HAL runs the emulated robot
    hal = Hal(network, robot, bus, patience=2.0, controller_fields=controller.telemetry_fields)
    run(hal, controller, LockStep(), until=lambda state: state.time >= 1.0)
    names = {message.frame_id: message.name for message in network.messages}
    print(hal.state.supervisor.name, [(names[can_id], n) for can_id, n in bus.count.most_common(3)])
    bus.close()
