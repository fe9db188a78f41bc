from __future__ import annotations

import math
import re
from collections.abc import Iterator

import numpy as np
import pinocchio
import pytest

from atalante_control.model import (
    HEIGHT_RANGE,
    LEG_RANGE,
    MASS_RANGE,
    SEGMENTS,
    ExoskeletonParameters,
    Inertia,
    Patient,
    links,
    pinocchio_model,
    urdf,
)
from atalante_hal.robot import load_robot

ROBOT = load_robot()
EMPTY = ExoskeletonParameters()
#: Winter 2009, tables 4.1 and figure 4.1: mass, centre of mass, radius of gyration, length.
WINTER = {
    "HAT": (0.678, 0.626, 0.496, 0.288),
    "thigh": (0.100, 0.433, 0.323, 0.245),
    "shank": (0.0465, 0.433, 0.302, 0.246),
    "foot": (0.0145, 0.5, 0.475, 0.152),
}
WORN = {"pelvis": "HAT", "left_thigh": "thigh", "left_shank": "shank", "left_foot": "foot"}


def patients() -> Iterator[Patient]:
    for mass in np.linspace(*MASS_RANGE, 5):
        for height in np.linspace(*HEIGHT_RANGE, 5):
            yield Patient(float(mass), float(height))
            for thigh, shank in ((0, 0), (0, 1), (1, 0), (1, 1)):
                yield Patient(float(mass), float(height), LEG_RANGE[thigh], LEG_RANGE[shank])


def only(worn: Inertia, empty: Inertia) -> Inertia:
    """Return the inertia that the patient adds to a link, computed from masses and moments about the origin of the link."""
    mass = worn.mass - empty.mass
    centre = (worn.mass * np.array(worn.centre) - empty.mass * np.array(empty.centre)) / mass

    def about_origin(body: Inertia) -> np.ndarray:
        c = np.array(body.centre)
        return body.matrix() + body.mass * (c @ c * np.eye(3) - np.outer(c, c))

    m = about_origin(worn) - about_origin(empty) - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return Inertia(mass, tuple(centre), (m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]))


def test_segment_fractions_are_those_of_winter_and_sum_to_one() -> None:
    assert {name: (s.mass, s.centre, s.gyration, s.length) for name, s in SEGMENTS.items()} == WINTER
    both_legs = 2 * sum(WINTER[name][0] for name in ("thigh", "shank", "foot"))
    assert WINTER["HAT"][0] + both_legs == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("patient", [Patient(75.0, 1.75), Patient(58.0, 1.93, 0.41, 0.45)])
def test_link_with_patient_includes_the_segment_of_the_table(patient: Patient) -> None:
    worn = {link.name: link.inertia for link in links(EMPTY, patient)}
    empty = {link.name: link.inertia for link in links(EMPTY.fitted(patient))}
    for name, segment in WORN.items():
        mass, centre, gyration, _ = WINTER[segment]
        added, length = only(worn[name], empty[name]), patient.length(segment)
        assert added.mass == pytest.approx(mass * patient.mass, rel=1e-12)
        axis = 0 if segment == "foot" else 2
        start = {"HAT": 0.0, "foot": EMPTY.sole_centre[0] - 0.5 * length}.get(segment, 0.0)
        sign = 1.0 if segment in ("HAT", "foot") else -1.0
        assert added.centre[axis] == pytest.approx(start + sign * centre * length, abs=1e-12)
        across = np.delete(np.diag(added.matrix()), axis)
        np.testing.assert_allclose(across, mass * patient.mass * (gyration * length) ** 2, rtol=1e-9)
        assert np.abs(added.matrix() - np.diag(np.diag(added.matrix()))).max() < 1e-12
    unchanged = set(empty) - {*WORN, *(name.replace("left", "right") for name in WORN)}
    assert all(worn[name] == empty[name] for name in unchanged)


def test_default_lengths_follow_winter_and_given_lengths_are_kept() -> None:
    by_height = Patient(70.0, 1.80)
    assert by_height.length("thigh") == 0.245 * 1.80
    assert by_height.length("shank") == 0.246 * 1.80
    given = Patient(70.0, 1.80, thigh_length=0.42, shank_length=0.40)
    assert (given.length("thigh"), given.length("shank")) == (0.42, 0.40)
    origins = {link.name: link.origin for link in links(EMPTY, given)}
    assert origins["left_shank"][2] == -0.42
    assert origins["left_ankle"][2] == -0.40


def test_joints_of_patient_and_exoskeleton_coincide() -> None:
    """FH and SH intersect at the hip of the patient, so neither of them moves the upper end of the thigh."""
    patient = Patient(80.0, 1.70)
    model, q_index, _ = pinocchio_model(urdf(EMPTY, ROBOT, patient))
    data = model.createData()
    thigh = next(link for link in links(EMPTY, patient) if link.name == "left_thigh").boxes[1]
    upper = np.add(thigh.centre, [0.0, 0.0, 0.5 * patient.length("thigh")])
    for joint in (0, 2):
        q = np.zeros(12)
        q[q_index[joint]] = 0.2
        pinocchio.framesForwardKinematics(model, data, q)
        position = data.oMf[model.getFrameId("left_thigh")].act(upper)
        np.testing.assert_allclose(position, [0.0, EMPTY.fh_offset[1], 0.0], atol=1e-15)


def test_masses_and_inertias_are_physical_over_the_whole_range() -> None:
    empty = math.fsum(link.inertia.mass for link in links(EMPTY))
    for patient in patients():
        bodies = links(EMPTY, patient)
        assert math.fsum(link.inertia.mass for link in bodies) == pytest.approx(empty + patient.mass, abs=1e-12)
        segments = [patient.body(name, (0.0, 0.0, 0.0), 2, 1)[1] for name in SEGMENTS]
        for inertia in [*(link.inertia for link in bodies if link.inertia.mass), *segments]:
            moments = np.linalg.eigvalsh(inertia.matrix())
            assert moments[0] > 0.0
            assert moments[0] + moments[1] >= moments[2] * (1 - 1e-12)


def test_urdf_keeps_the_full_precision() -> None:
    patient = Patient(71.3, 1.777)
    model = pinocchio_model(urdf(EMPTY, ROBOT, patient), fixed_base=False).model
    assert pinocchio.computeTotalMass(model) == pytest.approx(82.5 + 71.3, abs=1e-12)
    pelvis = links(EMPTY, patient)[0].inertia
    root = model.inertias[1]
    np.testing.assert_allclose(root.inertia, pelvis.matrix(), rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(root.lever, pelvis.centre, rtol=1e-15, atol=1e-15)


def test_patient_of_numpy_numbers_gives_the_same_urdf() -> None:
    numpy = Patient(np.float64(71.3), np.float64(1.777))
    assert urdf(EMPTY, ROBOT, numpy) == urdf(EMPTY, ROBOT, Patient(71.3, 1.777))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((44.9, 1.75), "mass of the patient must be 45 to 110 kg, got 44.9 kg"),
        ((75.0, 2.01), "height of the patient must be 1.5 to 2 m, got 2.01 m"),
        ((75.0, 175.0), "height of the patient must be 1.5 to 2 m, got 175 m"),
        ((75.0, 1.75, 0.6), "thigh length of the patient must be 0.3 to 0.55 m, got 0.6 m"),
        ((75.0, 1.75, None, 0.2), "shank length of the patient must be 0.3 to 0.55 m, got 0.2 m"),
        ((math.nan, 1.75), "mass of the patient must be 45 to 110 kg, got nan kg"),
    ],
)
def test_patient_out_of_range_is_rejected(arguments: tuple[float, ...], sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        Patient(*arguments)
