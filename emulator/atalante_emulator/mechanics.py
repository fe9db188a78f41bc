"""Description of the mechanics of an emulated robot: URDF, physics engine, floor, wearer and parameters of the nodes.

The methods of the description create the body, and add crane, wearer and virtual operator to the emulator. A description can be
pickled, so it can be sent to another process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from atalante_emulator.bodies import ENGINES, FRICTION, Body, hang, make_body
from atalante_emulator.crane import Crane
from atalante_emulator.emulator import Emulator, EmulatorParameters
from atalante_emulator.imu import ImuParameters
from atalante_emulator.patient import ActivePatient, ActiveTask
from atalante_emulator.virtual_operator import VirtualOperator
from atalante_emulator.wearer import LimbParameters, PassiveWearer
from atalante_hal.robot import JOINTS

#: Parameters of the nodes if the robot stands on the ground.
#: The IMUs have attitude errors, because a walking controller must tolerate such errors.
GROUND_PARAMETERS: Final = EmulatorParameters(imu=ImuParameters(attitude_error=0.004, heading_drift=5.2e-5))
#: Like `GROUND_PARAMETERS`, but without heading drift: each IMU also measures its heading, for example by a magnetometer.
HEADING_REFERENCE_PARAMETERS: Final = replace(GROUND_PARAMETERS, imu=replace(GROUND_PARAMETERS.imu, heading_drift=0.0))


@dataclass(frozen=True)
class Ground:
    """Floor, crane and virtual operator of a robot with a free pelvis. The height of the floor is 0."""

    friction: float = FRICTION  # coefficient of friction between soles and floor
    clearance: float = 0.03  # height of the lowest sole corner above the floor at the start (robot suspended) [m]
    operator_force: float = 0.0  # largest force of the virtual operator [N]; 0 if there is no virtual operator


@dataclass(frozen=True)
class Mechanics:
    """Mechanics of an emulated robot."""

    urdf: str  # text of the URDF; if a person wears the robot, the URDF also contains the body of the person
    engine: str = ENGINES[0]  # physics engine, one of `ENGINES`
    ground: Ground | None = None  # floor below a robot with a free pelvis; None: no floor and a fixed pelvis
    #: Impedance of the wearer's relaxed legs. None: the default impedance if `active` is set, otherwise no impedance.
    limbs: LimbParameters | None = None
    active: ActiveTask | None = None  # task of a wearer who moves the legs by muscle; None: the wearer uses no muscles
    parameters: EmulatorParameters | None = None  # parameters of the nodes; None: see `node_parameters`

    @property
    def node_parameters(self) -> EmulatorParameters:
        """Return `parameters` if set. Otherwise return GROUND_PARAMETERS if there is a floor, and the defaults if not."""
        return self.parameters or (GROUND_PARAMETERS if self.ground else EmulatorParameters())

    def make_body(self, pose: Sequence[float] | None = None) -> Body:
        """Create the body of the emulated robot. The caller must call `close` of the body at the end.

        If there is a floor, the body is suspended, with the soles at the height `ground.clearance` above the floor.

        Args:
            pose: initial joint positions, shape (12,) [rad]. With None, all joints are at 0.

        Raises:
            ValueError: If the engine is unknown, the text is not a URDF, or the pose does not have 12 angles.
            ModuleNotFoundError: If the engine is not installed.
        """
        angles = [0.0] * len(JOINTS) if pose is None else pose
        if self.ground is None:
            body = make_body(self.engine, self.urdf)
        else:
            body = make_body(self.engine, self.urdf, free=True, ground=0.0, friction=self.ground.friction)
        try:
            if self.ground is not None:
                hang(body, angles, self.ground.clearance)
            elif pose is not None:
                body.reset(pose)
        except ValueError:
            body.close()
            raise
        return body

    def complete(self, emulator: Emulator) -> None:
        """Add wearer, crane and virtual operator to the emulator.

        The wearer is added if `active` or `limbs` is set, the crane if `ground` is set, and the virtual operator if
        `ground.operator_force` is not 0.

        Args:
            emulator: emulator with the body of `make_body`.
        """
        if self.active is not None:
            emulator.wearer = ActivePatient(emulator.body, self.active, self.limbs, emulator.vibration)
        elif self.limbs is not None:
            emulator.wearer = PassiveWearer(self.limbs)
        if self.ground is not None:
            emulator.crane = Crane(emulator.body)
            emulator.pelvis_forces.append(emulator.crane)
            if self.ground.operator_force:
                emulator.virtual_operator = VirtualOperator(emulator.body, self.ground.operator_force)
                emulator.pelvis_forces.append(emulator.virtual_operator)
