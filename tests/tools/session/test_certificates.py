"""Certificates of the guides: choice of the smallest promise, and the fields of a result."""

from __future__ import annotations

import pytest

from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_control.guide.statistics import GuideStatistics
from atalante_hal.robot import load_robot
from atalante_tools.session.certificates import promise_fields, report_hand_overs, weakest


@pytest.mark.parametrize(("factors", "weakest_factor"), [([0.5], 0.5), ([0.9, 0.5], 0.9), ([0.5, 1.0], 1.0)])
def test_weakest_certificate_has_the_smallest_promise_or_none(factors: list[float], weakest_factor: float) -> None:
    robot = load_robot()
    controller = AirwalkController(robot, load_gait(AIRWALK_GAIT, robot), SHAPES["constant"])
    assert weakest(controller.certificate(xi) for xi in factors) == controller.certificate(weakest_factor)


def test_fields_of_a_certificate_with_a_promise_contain_its_torques() -> None:
    robot = load_robot()
    certificate = AirwalkController(robot, load_gait(AIRWALK_GAIT, robot), SHAPES["constant"]).certificate(0.5)
    promise = certificate.promise
    assert promise is not None
    fields = {"certified": True, "promise_hip_nm": promise.hip, "promise_knee_nm": promise.knee}
    assert promise_fields(certificate) == fields


def test_fields_without_a_guide_are_none() -> None:
    assert promise_fields(None) == {"certified": None, "promise_hip_nm": None, "promise_knee_nm": None}


def test_steps_without_a_valid_certificate_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    report_hand_overs("pinched", GuideStatistics(hand_overs=20))
    assert capsys.readouterr() == ("", "")
    report_hand_overs("pinched", GuideStatistics(hand_overs=20, hand_overs_exceeded=3))
    assert "pinched: the certificate did not apply to 3 of 20 steps" in capsys.readouterr().err
