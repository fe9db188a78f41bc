"""What the HAL sends every cycle: SYNC, the commands of the drives and of the vibration motors.

`limiter -> commands -> process image -> transceiver -> bus`
"""

from __future__ import annotations

import numpy as np

from atalante_dbc import Network
from atalante_hal.record import Record
from atalante_hal.transceiver import Transceiver
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword
from atalante_hal.wire.codec import Vector
from atalante_hal.wire.process_image import TransmitImage


class Commands:
    """Values of the command frames, sealed together with the SYNC of the next cycle: one encoding for both.

    Attributes:
        control: `Controlword` of each drive, shape (12,).
        torque: target torque, shape (12,) [Nm].
        limit: the drives' MaxTorque, shape (12,) [Nm].
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
        #: Quick stop to every drive, no torque, motors still: encoded before anything can go wrong.
        self._prepared_hold = self._image.prepare()
        self._sealed = False  # with the SYNC of the next cycle

    def announce(self, state: SupervisorState) -> None:
        """State of the supervisor, as SYNC carries it."""
        self._state.fill(state)

    def hold(self) -> None:
        """Quick stop to every drive, no torque, motors still: the values, until others are written."""
        self._holding = True
        self.torque.fill(0.0)
        self.control.fill(Controlword.QUICK_STOP)
        self._level.fill(0.0)

    def drive(self, torque: Vector, vibration: Vector) -> None:
        """Torques of enabled drives, shape (12,) [Nm], and levels of the motors, shape (8,), cut to [0, 1]."""
        np.maximum(vibration, self._no_level, out=self._level)  # the codec cuts at 1
        self.torque[:] = torque
        if self._holding:
            self.control.fill(Controlword.ENABLE_OPERATION)
            self._holding = False

    def synchronise(self, cycle: int) -> None:
        """Send the SYNC of a cycle."""
        if not self._sealed:
            self._seal(cycle, None)
        self._sealed = False
        self._transceiver.send(self._syncs)

    def send(self, cycle: int) -> Vector:
        """Send the commands of a cycle. Returns the torques sent, shape (12,) [Nm]."""
        self._seal(cycle + 1, None)
        self._transceiver.send(self._commands)
        return self._record()

    def send_prepared_hold(self, cycle: int) -> Vector:
        """Send HOLD whatever the values are; then they are those of HOLD. Returns the torques sent, shape (12,) [Nm]."""
        self._image.seal_prepared(self._prepared_hold)
        self._transceiver.send(self._commands)
        self.hold()
        self._seal(cycle + 1, self._image.counter)  # its SYNC was not prepared
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
    """HAL_STATUS, the HAL's heartbeat: state, hashes of what it works with, worst diagnostic."""

    def __init__(self, network: Network, transceiver: Transceiver, config_hash: int, gait_hash: int) -> None:
        self._transceiver = transceiver
        self._image = TransmitImage([network.message("HAL_STATUS")])
        self._frames = transceiver.grant(self._image.frames)
        #: Cycles between two.
        self.cycles = network.message("HAL_STATUS").cycle_ms
        self._write({"DbcHash": network.hash32, "ConfigHash": config_hash, "GaitHash": gait_hash})

    def send(
        self, state: SupervisorState, assistance_factor: float, overruns: float, diagnostic: int, step: int | None
    ) -> None:
        """Send it. `diagnostic`: of `diagnostics.number_of`."""
        values = {"HalState": state, "AssistanceFactor": assistance_factor, "Overruns": overruns}
        self._write({**values, "DiagnosticCode": diagnostic, "Step": (step or 0) & 0xFFFF})
        self._image.seal()
        self._transceiver.send(self._frames)

    def _write(self, signals: dict[str, float]) -> None:
        for name, value in signals.items():
            self._image.values[self._image.codec.index("HAL_STATUS", name)] = value
