"""What a gait is asked for: who walks, how far and how fast a step. `Subject -> gait solver, library, network`."""

from __future__ import annotations

from dataclasses import dataclass

from atalante_control.gait.gait import PERIOD
from atalante_control.model import Patient

STEP_LENGTH_RANGE = (0.05, 0.40)  # m, what may be asked for at all; the solver says what can be walked
STEP_DURATION_RANGE = (0.4, 2.0)  # s


@dataclass(frozen=True)
class Subject:
    """A patient and his step.

    Raises:
        ValueError: a step out of range, or a duration off the cycle grid.
    """

    patient: Patient
    step_length: float  # m, from one landing to the next, along the walking direction
    step_duration: float  # s, a whole number of milliseconds

    def __post_init__(self) -> None:
        for name, value, (low, high), unit in (
            ("step length", self.step_length, STEP_LENGTH_RANGE, "m"),
            ("step duration", self.step_duration, STEP_DURATION_RANGE, "s"),
        ):
            if not low <= value <= high:
                raise ValueError(f"a {name} is from {low:g} to {high:g} {unit}, not {value:g} {unit}")
        cycles = self.step_duration / PERIOD
        if abs(cycles - round(cycles)) > 1e-6:
            raise ValueError(f"a step duration is a whole number of milliseconds, not {self.step_duration!r} s")

    def parameters(self) -> dict[str, float]:
        """What a gait file says under `parameters`."""
        return {
            "patient_mass": self.patient.mass,
            "patient_height": self.patient.height,
            "thigh_length": self.patient.length("thigh"),
            "shank_length": self.patient.length("shank"),
            "step_length": self.step_length,
            "step_duration": self.step_duration,
        }

    def __str__(self) -> str:
        """In one line, for a person."""
        patient = self.patient
        return f"{patient.mass:g} kg, {patient.height:g} m, step {self.step_length:g} m in {self.step_duration:g} s"
