from __future__ import annotations

import pytest

from atalante_control.gait.subject import Subject, patient_of
from atalante_control.model import Patient

PATIENT = Patient(75.0, 1.75, thigh_length=0.44)


def test_subject_parameters_have_the_keys_of_a_gait_file() -> None:
    assert Subject(PATIENT, 0.16, 0.8).parameters() == {
        "patient_mass": 75.0,
        "patient_height": 1.75,
        "thigh_length": 0.44,
        "shank_length": 0.246 * 1.75,
        "step_length": 0.16,
        "step_duration": 0.8,
    }
    assert str(Subject(PATIENT, 0.16, 0.8)) == "75 kg, 1.75 m, thigh 0.440 m, step 0.16 m in 0.8 s"
    assert str(Subject(Patient(75.0, 1.75), 0.16, 0.8)) == "75 kg, 1.75 m, step 0.16 m in 0.8 s"


def test_patient_of_a_gait_has_the_leg_lengths_of_the_gait() -> None:
    parameters = Subject(PATIENT, 0.16, 0.8).parameters()
    assert patient_of(parameters).length("thigh") == 0.44
    legs_unknown = {name: parameters[name] for name in ("patient_mass", "patient_height")}
    assert patient_of(legs_unknown) == Patient(75.0, 1.75)
    with pytest.raises(KeyError, match="patient_height"):
        patient_of({"patient_mass": 75.0})


@pytest.mark.parametrize(
    ("length", "duration", "sentence"),
    [
        (16.0, 0.8, "step length must be 0.05 to 0.4 m, got 16 m"),
        (0.16, 0.2, "step duration must be 0.4 to 2 s, got 0.2 s"),
        (0.16, 0.8004, "step duration must be a whole number of milliseconds, got 0.8004 s"),
    ],
)
def test_step_out_of_range_is_rejected(length: float, duration: float, sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}$"):
        Subject(PATIENT, length, duration)
