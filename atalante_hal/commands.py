"""Frames that the HAL sends every cycle: SYNC, drive commands and vibration commands.

`limiter -> commands -> process image -> transceiver -> bus`
"""

from __future__ import annotations

import numpy as np

from atalante_dbc import Network
from atalante_hal.record import Record
from atalante_hal.transceiver import Transceiver
from atalante_hal.types import SupervisorState, Vector
from atalante_hal.wire.cia402 import Controlword
from atalante_hal.wire.process_image import TransmitImage


class Commands:
    """Command frames and SYNC frames of the HAL.

    The commands of a cycle and the SYNC of the next cycle are encoded together, because one encoding takes less time
    than two.

    Args:
        network: CAN network that defines the frames.
        transceiver: Transceiver that sends the frames.
        record: Record of the cycle, in which the sent torques and levels are stored.
        limit: MaxTorque of the drives, shape (12,) [Nm].

    Attributes:
        control: `Controlword` of each drive, shape (12,).
        torque: Target torque, shape (12,) [Nm].
        limit: MaxTorque of the drives, shape (12,) [Nm].
    """

    def __init__(self, network: Network, transceiver: Transceiver, record: Record, limit: Vector) -> None:
        self._transceiver = transceiver
        sent = [m for m in network.sent_by("HAL") if m.cycle_ms == 1]
        syncs = [m for m in sent if m.name.startswith("SYNC_")]
        commands = [m for m in sent if m not in syncs]
        self._image = TransmitImage([*commands, *syncs])
        self._commands = transceiver.grant(self._image.frames[: len(commands)])
        self._syncs = transceiver.grant(self._image.frames[len(commands) :])
        values, codec = self._image.values, self._image.codec
        self.torque, self.control, self.limit, self._level, self._state, self._cycle = (
            values[codec.slice(s)] for s in ("TargetTorque", "Controlword", "MaxTorque", "Level", "HalState", "Cycle")
        )
        self.limit[:] = limit
        self._sent_torque, self._sent_level = record.torque_command, record.level_command
        self._no_level = np.zeros_like(self._level)
        self.hold()
        #: Encoded HOLD frames: quick stop, zero torque, vibration motors off.
        #: HOLD frames are encoded now, so that HOLD can be sent even if later command values are invalid (NaN).
        self._prepared_hold = self._image.prepare()
        self._sealed = False  # whether the SYNC of the next cycle is already encoded

    def announce(self, state: SupervisorState) -> None:
        """Set the signal HalState in the SYNC frames.

        Args:
            state: Current state of the state machine.
        """
        self._state.fill(state)

    def hold(self) -> None:
        """Set the command values for HOLD: quick stop for every drive, zero torque, vibration motors off."""
        self._holding = True
        self.torque.fill(0.0)
        self.control.fill(Controlword.QUICK_STOP)
        self._level.fill(0.0)

    def drive(self, torque: Vector, vibration: Vector) -> None:
        """Set the command values for a motion: drives enabled, torques and vibration levels.

        Args:
            torque: Torques after the limiter, shape (12,) [Nm].
            vibration: Levels of the vibration motors, shape (8,); clipped to [0, 1].
        """
        np.maximum(vibration, self._no_level, out=self._level)  # the codec clips at 1
        self.torque[:] = torque
        if self._holding:
            self.control.fill(Controlword.ENABLE_OPERATION)
            self._holding = False

    def synchronise(self, cycle: int) -> None:
        """Send the SYNC frames of a cycle.

        Args:
            cycle: Cycle number; the signal Cycle in SYNC has its lower 32 bits.
        """
        if not self._sealed:
            self._seal(cycle, None)
        self._sealed = False
        self._transceiver.send(self._syncs)

    def send(self, cycle: int) -> Vector:
        """Send the commands of a cycle.

        Args:
            cycle: Number of the current cycle.

        Returns:
            Torques that were sent, shape (12,) [Nm].
        """
        self._seal(cycle + 1, None)
        self._transceiver.send(self._commands)
        return self._record()

    def send_prepared_hold(self, cycle: int) -> Vector:
        """Send the HOLD frames that were encoded in advance, and set the command values for HOLD.

        Args:
            cycle: Number of the current cycle.

        Returns:
            Torques that were sent, shape (12,) [Nm].
        """
        self._image.seal_prepared(self._prepared_hold)
        self._transceiver.send(self._commands)
        self.hold()
        self._seal(cycle + 1, self._image.counter)  # encode the SYNC frames of the next cycle in advance
        return self._record()

    def _seal(self, next_cycle: int, counter: int | None) -> None:
        self._cycle.fill(float(next_cycle & 0xFFFFFFFF))
        self._image.seal(counter)
        self._sealed = True

    def _record(self) -> Vector:
        self._sent_torque[:] = self.torque
        self._sent_level[:] = self._level
        return self._sent_torque


class StatusReport:
    """Sender of HAL_STATUS, the heartbeat of the HAL.

    The message contains the supervisor state, the worst diagnostic, and the hashes of the DBC, the robot file and the gait.

    Args:
        network: CAN network; its hash is sent as DbcHash.
        transceiver: Transceiver that sends the frame.
        config_hash: CRC-32 of the robot file.
        gait_hash: CRC-32 of the gait.
    """

    def __init__(self, network: Network, transceiver: Transceiver, config_hash: int, gait_hash: int) -> None:
        self._transceiver = transceiver
        self._image = TransmitImage([network.message("HAL_STATUS")])
        self._frames = transceiver.grant(self._image.frames)
        #: Period of HAL_STATUS in cycles of 1 ms.
        self.cycles = network.message("HAL_STATUS").cycle_ms
        self._write({"DbcHash": network.hash32, "ConfigHash": config_hash, "GaitHash": gait_hash})

    def send(
        self, state: SupervisorState, assistance_factor: float, overruns: float, diagnostic: int, step: int | None
    ) -> None:
        """Send one HAL_STATUS.

        Args:
            state: State of the state machine.
            assistance_factor: Assistance factor Xi, 0 to 1.
            overruns: Number of cycles so far that began more than a period late.
            diagnostic: Number of the worst active diagnostic, see `diagnostics.number_of`.
            step: Number of the current walking step; None is sent as 0.
        """
        values = {"HalState": state, "AssistanceFactor": assistance_factor, "Overruns": overruns}
        self._write({**values, "DiagnosticCode": diagnostic, "Step": (step or 0) & 0xFFFF})
        self._image.seal()
        self._transceiver.send(self._frames)

    def _write(self, signals: dict[str, float]) -> None:
        for name, value in signals.items():
            self._image.values[self._image.codec.index("HAL_STATUS", name)] = value
