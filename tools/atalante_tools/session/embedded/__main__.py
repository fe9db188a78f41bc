"""Main program of the subprocess with the embedded robot. `EmbeddedRobot` starts this subprocess.

Command line: `python -m atalante_tools.session.embedded MEMORY SOCKET ACCESS`. The program reads the `SpawnConfig` from stdin.
All other communication uses the bus and the shared memory of `ServedAccess`. The program ends when the HAL closes the bus.
"""

from __future__ import annotations

import gc
import pickle
import sys

from atalante_hal.bus import BusDown
from atalante_hal.bus.shared import SharedBus
from atalante_tools.session.body import no_banner, open_mechanics
from atalante_tools.session.embedded import SpawnConfig
from atalante_tools.session.embedded.access import ServedAccess

with no_banner():  # these imports are slow; they run while the parent prepares the run
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.pendant import Operator


def emulate(bus: SharedBus, access: int, config: SpawnConfig) -> None:
    """Create the robot and answer each SYNC of the HAL until the bus is closed.

    Args:
        bus: Bus to the HAL.
        access: File descriptor of the memory of the access.
        config: Description of the robot to create.
    """
    with open_mechanics(config.mechanics, config.pose) as body:
        operator = Operator()
        emulator = Emulator(
            config.network, config.robot, body, bus,
            seed=config.seed, operator=operator, parameters=config.mechanics.node_parameters, faults=config.faults,
        )  # fmt: skip
        config.mechanics.complete(emulator)
        served = ServedAccess(access, emulator, operator)
        # All objects that exist now are needed until the end, so the garbage collector need not scan them.
        gc.collect()
        gc.freeze()
        bus.serve(served.step)


def main(memory: str, wake_socket: str, access: str) -> None:
    """Read the description of the robot from stdin, and emulate the robot. Send the reason of a failure to the parent.

    Args:
        memory: File descriptor of the shared memory, as text.
        wake_socket: File descriptor of the socket through which the HAL process wakes this process, as text.
        access: File descriptor of the memory of the access, as text.
    """
    bus = SharedBus("the embedded robot's bus", int(memory), int(wake_socket), 1)
    reason = ""
    try:
        emulate(bus, int(access), pickle.load(sys.stdin.buffer))
    except (BusDown, EOFError):
        pass  # the parent ended, possibly before it sent the `SpawnConfig`
    except Exception as error:  # noqa: BLE001 - the parent shows the error to the user
        reason = f"the robot's process failed with {type(error).__name__}: {error}"
    bus.close(reason)


if __name__ == "__main__":
    main(*sys.argv[1:])
