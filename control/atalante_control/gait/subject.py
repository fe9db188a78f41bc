"""Subject: patient, step length and step duration. Gait solver, gait library and gait network compute the gait of a subject."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from atalante_control.model import Patient
from atalante_hal.types import PERIOD

STEP_LENGTH_RANGE = (0.05, 0.40)  # m, accepted step lengths; some of them have no feasible gait
STEP_DURATION_RANGE = (0.4, 2.0)  # s, accepted step durations; some of them have no feasible gait

#: Eight patients for the walks in the documentation.
#: The patients lie within the range of the paper's subjects: 58 to 91 kg, 1.62 to 1.93 m.
STUDY_PATIENTS = tuple(
    Patient(mass, height)
    for mass, height in (
        (58.0, 1.62), (62.0, 1.68), (66.0, 1.65), (70.0, 1.74), (75.0, 1.75), (80.0, 1.80), (85.0, 1.86), (91.0, 1.93),
    )
)  # fmt: skip


@dataclass(frozen=True)
class Subject:
    """Patient and step parameters for which a gait is computed.

    Raises:
        ValueError: If step length or step duration is out of range, or the duration is not a whole number of cycles.
    """

    patient: Patient
    step_length: float  # m, distance from one landing to the next along the walking direction
    step_duration: float  # s, duration of one step, a whole number of milliseconds

    def __post_init__(self) -> None:
        for name, value, (low, high), unit in (
            ("step length", self.step_length, STEP_LENGTH_RANGE, "m"),
            ("step duration", self.step_duration, STEP_DURATION_RANGE, "s"),
        ):
            if not low <= value <= high:
                raise ValueError(f"{name} must be {low:g} to {high:g} {unit}, got {value:g} {unit}")
        cycles = self.step_duration / PERIOD
        if abs(cycles - round(cycles)) > 1e-6:
            raise ValueError(f"step duration must be a whole number of milliseconds, got {self.step_duration!r} s")

    def parameters(self) -> dict[str, float]:
        """Return patient and step parameters by name, for the key `parameters` of a gait file."""
        return {
            "patient_mass": self.patient.mass,
            "patient_height": self.patient.height,
            "thigh_length": self.patient.length("thigh"),
            "shank_length": self.patient.length("shank"),
            "step_length": self.step_length,
            "step_duration": self.step_duration,
        }

    def __str__(self) -> str:
        """Return patient and step parameters as one line of text."""
        patient = self.patient
        legs = {"thigh": patient.thigh_length, "shank": patient.shank_length}
        given = "".join(f"{segment} {value:.3f} m, " for segment, value in legs.items() if value is not None)
        return (
            f"{patient.mass:g} kg, {patient.height:g} m, {given}step {self.step_length:g} m in {self.step_duration:g} s"
        )


def patient_of(parameters: Mapping[str, float]) -> Patient:
    """Return the patient of a gait.

    Args:
        parameters: parameters of the gait. If leg lengths are missing, the leg lengths of Winter's table are used.

    Raises:
        KeyError: If mass or height is missing.
    """
    mass, height = (parameters[name] for name in ("patient_mass", "patient_height"))
    return Patient(mass, height, parameters.get("thigh_length"), parameters.get("shank_length"))
