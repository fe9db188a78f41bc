"""Trials of the experiment `faults`: each case of the fault matrix, injected at nine points of a walk on the ground.

    scenarios of the fault matrix -> trials

A trial is one case at all moments, so its start-up is paid once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

#: Phases of the second step of the walk at which a fault begins. None is the weight shift before the walk, in double support.
MOMENTS: Final = (None, *(k / 8 for k in range(8)))
QUICK_MOMENTS: Final = (None, 0.375)
#: Faults of `--quick`.
QUICK_IDS: Final = ("F05", "F56")
#: Value of `FaultTrial.index` for the permanent case of a scenario.
PERMANENT: Final = -1


@dataclass(frozen=True)
class FaultTrial:
    """Trial of one case of a fault scenario, with one walk for each point at which the fault begins."""

    kind: ClassVar[str] = "fault"
    id: str  # fault ID, as in the fault matrix
    index: int  # index of the case in its scenario, or `PERMANENT`
    case: str  # name of the case
    moments: tuple[float | None, ...]  # of `MOMENTS`
    mass: float  # kg, of the wearer
    height: float  # m, of the wearer
    seed: int
    engine: str
    sources: str  # hash of the scenarios and of the rig

    @property
    def name(self) -> str:
        """Return a name that is unique in the experiment."""
        return f"{self.id}-{'permanent' if self.index == PERMANENT else f'{self.index:02d}'}"


def fault_trials(ids: Sequence[str], quick: bool, seed: int, engine: str) -> list[FaultTrial]:
    """Return the trials of the given faults. Cases that begin at power-on or at another phase than `MID_SWING` are left out.

    Args:
        ids: fault IDs. With none, all faults with a scenario.
        quick: whether only the first case of each fault is tried, at two moments.
        seed: seed of the experiment, which is added to the seed of each case.
        engine: physics engine of the emulated robot.
    """
    import atalante_tools.faults
    import atalante_tools.session
    from atalante_control.gait.subject import STUDY_PATIENTS
    from atalante_tools.faults.catalogue import SCENARIOS
    from atalante_tools.faults.scenario import MID_SWING
    from atalante_tools.trial.plan import SWEEP_SUBJECT, source_hash

    patient = next(patient for patient in STUDY_PATIENTS if patient.mass == SWEEP_SUBJECT[0])
    sources = source_hash([Path(next(iter(one.__path__))) for one in (atalante_tools.faults, atalante_tools.session)])
    trials = []
    for id_ in ids or SCENARIOS:
        scenario = SCENARIOS[id_]
        cases = [(index, case) for index, case in enumerate(scenario.cases) if case.phase == MID_SWING]
        if quick:
            cases = cases[:1]
        elif scenario.permanent is not None:
            cases.append((PERMANENT, scenario.permanent))
        trials += [
            FaultTrial(
                id_, index, case.name, QUICK_MOMENTS if quick else MOMENTS, patient.mass, patient.height,
                seed + case.seed, engine, sources,
            )
            for index, case in cases
        ]  # fmt: skip
    return trials
