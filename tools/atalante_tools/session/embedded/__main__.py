"""The embedded robot's process: `python -m atalante_tools.session.embedded MEMORY BELL`, started by `EmbeddedRobot` alone.

The order comes through stdin; everything else is said on the bus. Ends when the other end of the bus closes or dies.
"""

from __future__ import annotations

import gc
import pickle
import sys

from atalante_hal.bus import BusDown
from atalante_hal.bus.shared import SharedBus
from atalante_tools.session.body import no_banner, open_described
from atalante_tools.session.embedded import SpawnConfig

with no_banner():  # while the order is being written
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.pendant import Operator


def answer(bus: SharedBus, order: SpawnConfig) -> None:
    """Be the robot until the bus is down."""
    with open_described(order.urdf, order.pose) as body:
        emulator = Emulator(
            order.network, order.robot, body, bus, seed=order.seed, operator=Operator(), faults=order.faults
        )
        # What lives now lives as long as the run, and the collector need not look at it again and again.
        gc.collect()
        gc.freeze()
        bus.serve(emulator.poll)


def main(memory: str, bell: str) -> None:
    """Make the robot that is ordered, and answer."""
    bus = SharedBus("the embedded robot's bus", int(memory), int(bell), 1)
    last_words = ""
    try:
        answer(bus, pickle.load(sys.stdin.buffer))
    except (BusDown, EOFError):
        pass  # the HAL has gone, perhaps before it ordered
    except Exception as error:  # noqa: BLE001 - whatever it is, the other process has to say it
        last_words = f"the robot's process failed with {type(error).__name__}: {error}"
    bus.close(last_words)


if __name__ == "__main__":
    main(*sys.argv[1:])
