"""Phases of a walk, as a table."""

from __future__ import annotations

import pytest

from atalante_control.walking.phases import STEPPING, Facts, Phase, next_phase

FACTS = Facts(elapsed=100, nominal=800, rest=300, timeout=400, landed=False, loaded=False, stopping=False)


@pytest.mark.parametrize(
    ("phase", "facts", "expected"),
    [
        (Phase.POSTURE, FACTS, None),
        (Phase.POSTURE, FACTS._replace(elapsed=800), Phase.STAND),
        (Phase.STAND, FACTS._replace(elapsed=9999), None),
        (Phase.STAND, FACTS._replace(loaded=True), Phase.SHIFT),
        (Phase.STAND, FACTS._replace(loaded=True, stopping=True), Phase.REST),
        (Phase.STAND, FACTS._replace(stopping=True), Phase.REST),
        (Phase.POSTURE, FACTS._replace(loaded=True, stopping=True), None),
        (Phase.SHIFT, FACTS._replace(elapsed=1099), None),
        (Phase.SHIFT, FACTS._replace(elapsed=1100), Phase.START),
        (Phase.SHIFT, FACTS._replace(elapsed=1100, stopping=True), Phase.BACK),
        (Phase.START, FACTS._replace(landed=True), Phase.STEP),
        (Phase.START, FACTS._replace(landed=True, stopping=True), Phase.STOP),
        (Phase.STEP, FACTS._replace(elapsed=1199), None),
        (Phase.STEP, FACTS._replace(landed=True), Phase.STEP),
        (Phase.STEP, FACTS._replace(elapsed=1200), Phase.STEP),
        (Phase.STEP, FACTS._replace(landed=True, stopping=True), Phase.STOP),
        (Phase.STOP, FACTS._replace(elapsed=1199, stopping=True), None),
        (Phase.STOP, FACTS._replace(landed=True, stopping=True), Phase.BACK),
        (Phase.STOP, FACTS._replace(elapsed=1200), Phase.BACK),
        (Phase.BACK, FACTS._replace(elapsed=1099), None),
        (Phase.BACK, FACTS._replace(elapsed=1100), Phase.REST),
        (Phase.REST, FACTS._replace(elapsed=99_999, loaded=True, landed=True), None),
    ],
)
def test_next_phase(phase: Phase, facts: Facts, expected: Phase | None) -> None:
    assert next_phase(phase, facts) is expected


@pytest.mark.parametrize("phase", sorted(STEPPING))
def test_stop_request_alone_never_ends_a_step(phase: Phase) -> None:
    assert next_phase(phase, FACTS._replace(stopping=True)) is None
