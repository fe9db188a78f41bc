"""Subprocess of the embedded robot: `python -m atalante_tools.session.embedded MEMORY BELL`, started by `EmbeddedRobot`.

It reads the `SpawnConfig` from stdin; all other communication uses the bus. It ends when the other end of the bus closes.
"""

from __future__ import annotations

import gc
import pickle
import sys

from atalante_hal.bus import BusDown
from atalante_hal.bus.shared import SharedBus
from atalante_tools.session.body import no_banner, open_described
from atalante_tools.session.embedded import SpawnConfig

with no_banner():  # these slow imports run while the parent prepares the `SpawnConfig`
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.pendant import Operator


def answer(bus: SharedBus, order: SpawnConfig) -> None:
    """Emulate the robot until the bus is closed.

    Args:
        bus: End of the robot on the bus.
        order: Robot to create.
    """
    with open_described(order.urdf, order.pose) as body:
        emulator = Emulator(
            order.network, order.robot, body, bus, seed=order.seed, operator=Operator(), faults=order.faults
        )
        # All objects of this point are needed until the end, so the garbage collector need not scan them again.
        gc.collect()
        gc.freeze()
        bus.serve(emulator.poll)


def main(memory: str, bell: str) -> None:
    """Create the robot and answer the SYNCs of the HAL.

    Args:
        memory: File descriptor of the shared memory, as text.
        bell: File descriptor of the notification socket, as text.
    """
    bus = SharedBus("the embedded robot's bus", int(memory), int(bell), 1)
    reason = ""
    try:
        answer(bus, pickle.load(sys.stdin.buffer))
    except (BusDown, EOFError):
        pass  # the parent has ended, maybe before it sent the `SpawnConfig`
    except Exception as error:  # noqa: BLE001 - the parent reports every kind of error to the user
        reason = f"the robot's process failed with {type(error).__name__}: {error}"
    bus.close(reason)


if __name__ == "__main__":
    main(*sys.argv[1:])
