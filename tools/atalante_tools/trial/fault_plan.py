"""Trials of the experiment `faults`: each case of the fault matrix, injected at several moments of a walk on the ground.

    cases of the fault matrix -> trials

A trial is one case of a fault, with one walk for each moment at which the fault begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, NamedTuple


class Moment(NamedTuple):
    """Moment of a walk at which a fault begins, as the time since the start of a phase of the walk."""

    phase: str  # name of a member of `atalante_control.walking.phases.Phase`
    step: int  # number of periodic steps (phase STEP) that the robot has completed before this phase
    share: float  # time since the first cycle of the phase, divided by the nominal duration of a step


#: Number of periodic steps of a walk, between its start step and its stop step.
STEPS: Final = 2
#: Moments at which every fault is tried: name -> moment. One walk has one fault, which begins at one moment.
#: In "weight shift" and "shift back", both feet carry load.
MOMENTS: Final = {
    "weight shift": Moment("SHIFT", 0, 0.75),
    **{f"phase {k / 8:g}": Moment("STEP", STEPS - 1, k / 8) for k in range(8)},
    "shift back": Moment("BACK", STEPS, 0.25),
}
#: Names of the moments that `--quick` uses.
QUICK_MOMENTS: Final = ("weight shift", "phase 0.375")
#: Further moments with both feet on the ground, for the faults after which the HAL sends no more frames.
FURTHER_MOMENTS: Final = {
    "standing": Moment("SHIFT", 0, 0.0),
    "start of the first step": Moment("START", 0, 0.0),
    "landing of the stop step": Moment("BACK", STEPS, 0.0),
}
#: Names of the moments with both feet on the ground.
DOUBLE_SUPPORT: Final = frozenset({"weight shift", "shift back", *FURTHER_MOMENTS})
#: IDs of the faults after which the HAL sends no more frames, on one bus or on all buses.
NO_FRAMES: Final = frozenset({"F15", "F16", "F41"})
#: IDs of the faults that `--quick` injects.
QUICK_IDS: Final = ("F05", "F56")
#: Value of `FaultTrial.index` for the case `Scenario.permanent`, which contains a fault without an end.
PERMANENT: Final = -1


@dataclass(frozen=True)
class FaultTrial:
    """Trial of one case of a fault: one walk for each moment at which the fault begins."""

    kind: ClassVar[str] = "fault"
    id: str  # fault ID, as in the fault matrix
    index: int  # key of the case in the mapping `ground_cases(id)`: 0 or more, or `PERMANENT`
    case: str  # name of the case
    moments: tuple[str, ...]  # keys of `MOMENTS` and `FURTHER_MOMENTS`
    mass: float  # mass of the wearer [kg]
    height: float  # height of the wearer [m]
    seed: int
    engine: str
    sources: str  # hash of the files of `atalante_tools.faults`; if it changes, the stored result is not used again
    #: path and SHA-256 of the file of the neural gait network; empty for the network of the package
    network: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return a name that is unique in the experiment."""
        return f"{self.id}-{'permanent' if self.index == PERMANENT else f'{self.index:02d}'}"


def fault_trials(
    ids: Sequence[str], quick: bool, seed: int, engine: str, network: tuple[str, ...] = ()
) -> list[FaultTrial]:
    """Return the trials of the given faults.

    Args:
        ids: fault IDs; empty means all faults with a case.
        quick: whether only the first case of each fault is tried, at two moments.
        seed: seed of the experiment, which is added to the seed of each case.
        engine: physics engine of the emulated robot.
        network: result of `plan.network_of`; empty for the network of the package.
    """
    import atalante_tools.faults
    from atalante_control.gait.subject import STUDY_PATIENTS
    from atalante_tools.trial.ground_cases import FAULT_IDS, ground_cases
    from atalante_tools.trial.plan import SWEEP_SUBJECT, source_hash

    patient = next(patient for patient in STUDY_PATIENTS if patient.mass == SWEEP_SUBJECT[0])
    sources = source_hash([Path(next(iter(atalante_tools.faults.__path__)))])
    return [
        FaultTrial(
            id_, index, case.name, QUICK_MOMENTS if quick else _moments(id_), patient.mass, patient.height,
            seed + case.seed, engine, sources, network,
        )
        for id_ in ids or FAULT_IDS
        for index, case in list(ground_cases(id_).items())[: 1 if quick else None]
    ]  # fmt: skip


def _moments(id_: str) -> tuple[str, ...]:
    return (*MOMENTS, *(FURTHER_MOMENTS if id_ in NO_FRAMES else ()))
