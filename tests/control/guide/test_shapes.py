"""Guide shapes: their bounds along a step, and their width at each assistance factor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.guide.shapes import CONSTANT, SHAPES, GuideShape, half_width

PHASE = np.linspace(0.0, 1.0, 801)
ALL = list(SHAPES.values())
NAMES = list(SHAPES)


@given(st.floats(0.0, 1.0))
def test_half_width_follows_the_paper(xi: float):
    assert half_width(xi) == pytest.approx(math.radians(0.5 + 7.0 * (1.0 - xi)))


def test_half_width_at_half_assistance_is_four_degrees():
    assert math.degrees(half_width(0.5)) == pytest.approx(4.0)


@pytest.mark.parametrize("bad", [-0.01, 1.01, float("nan")])
def test_half_width_rejects_an_invalid_factor(bad: float):
    with pytest.raises(ValueError, match="between 0 and 1"):
        half_width(bad)


@pytest.mark.parametrize("shape", ALL, ids=NAMES)
@given(xi=st.floats(0.0, 1.0))
def test_every_shape_is_positive_and_at_most_the_half_width(shape: GuideShape, xi: float):
    bounds = shape.bounds(PHASE, xi)
    assert bounds.shape == (2, len(PHASE), 2)
    assert (bounds > 0.0).all()
    assert (bounds <= half_width(xi) * (1 + 1e-12)).all()


@pytest.mark.parametrize("shape", ALL, ids=NAMES)
def test_every_shape_shrinks_with_the_assistance_factor(shape: GuideShape):
    widths = np.stack([shape.bounds(PHASE, xi) for xi in (0.0, 0.25, 0.5, 0.75, 1.0)])
    assert (np.diff(widths, axis=0) <= 1e-12).all()
    at_the_end = shape.bounds(np.array([1.0, 1.2]), 0.5)
    np.testing.assert_array_equal(at_the_end[:, 0], at_the_end[:, 1])


@pytest.mark.parametrize("name", ["constant", "widening", "narrowing", "pinched", "asymmetric"])
def test_certifiable_shapes_are_continuous(name: str):
    bounds = SHAPES[name].bounds(PHASE, 0.5)
    assert np.abs(np.diff(bounds, axis=1)).max() < 0.02 * half_width(0.5)


def test_shapes_have_the_widths_of_their_names():
    def at(name: str, phase: float) -> np.ndarray:
        return np.degrees(SHAPES[name].bounds(np.array([phase]), 0.5)[0, 0])

    for phase in (0.0, 0.3, 1.0):
        np.testing.assert_allclose(at("constant", phase), [4.0, 4.0])
    np.testing.assert_allclose(at("widening", 0.0), [2.0, 2.0])
    np.testing.assert_allclose(at("widening", 1.0), [4.0, 4.0])
    np.testing.assert_allclose(at("narrowing", 0.0), [4.0, 4.0])
    np.testing.assert_allclose(at("narrowing", 1.0), [2.0, 2.0])
    np.testing.assert_allclose(at("pinched", 0.4), [4.0, 4.0])
    np.testing.assert_allclose(at("pinched", 0.6), [2.5, 2.5])
    np.testing.assert_allclose(at("pinched", 0.8), [1.0, 1.0])
    np.testing.assert_allclose(at("pinched", 1.0), [1.0, 1.0])
    np.testing.assert_allclose(at("asymmetric", 0.5), [4.0, 2.4])
    np.testing.assert_allclose(at("snap", 0.3), [4.0, 4.0])
    np.testing.assert_allclose(at("snap", 0.5), [0.1, 0.1])


def test_pinch_does_not_narrow_an_already_narrow_guide():
    np.testing.assert_allclose(SHAPES["pinched"].bounds(PHASE, 1.0), half_width(1.0))


def at(value: float, side: int = 0, where: Callable[[np.ndarray, float], np.ndarray] | None = None):
    """Return fractions of 1, and of `value` on one side where `where(phase, half_width)` is true."""

    def fractions(phase: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        sides = [np.ones_like(phase), np.ones_like(phase)]
        sides[side] = np.where(np.True_ if where is None else where(phase, width), value, sides[side])
        return sides[0], sides[1]

    return fractions


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("value", [-1.0, 0.0, -0.0, math.nan, math.inf, -math.inf, 1e-300, 1e-6])
def test_shape_with_an_invalid_bound_is_rejected(value: float, side: int):
    with pytest.raises(ValueError, match=rf"bounds of the guide shape 'own' must be .*SH, {('upper', 'lower')[side]}"):
        GuideShape("own", "", at(value, side))
    with pytest.raises(ValueError, match="'constant' must be finite"):
        replace(CONSTANT, fractions=at(value, side))


def test_error_names_shape_phase_factor_and_value():
    negative = at(-0.5, 1, lambda phase, width: np.abs(phase - 0.43) < 3e-4)
    with pytest.raises(ValueError) as refused:  # noqa: PT011
        GuideShape("notched", "", negative)
    assert str(refused.value) == (
        "bounds of the guide shape 'notched' must be finite and at least 1e-06 rad, got -0.0654498 rad (SH, lower) "
        "at phase 0.43 and Xi 0"
    )


def test_shape_that_closes_in_narrow_guides_is_rejected():
    """The fractions of this shape are negative only in narrow guides."""
    with pytest.raises(ValueError, match=r"'narrow' must be .* and Xi 0\.85"):
        GuideShape("narrow", "", lambda phase, width: ((width - 0.03) * np.ones_like(phase), np.ones_like(phase)))


def test_shape_that_becomes_wider_with_the_assistance_factor_is_rejected():
    def wider(phase: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        share = np.full_like(phase, 2.5 if width < half_width(0.45) else 1.0)
        return share, share

    with pytest.raises(ValueError, match=r"'wider' must not become larger .*, got larger bounds at Xi 0\.5"):
        GuideShape("wider", "", wider)


def test_invalid_bound_between_the_checked_phases_is_rejected_on_use():
    between = GuideShape("between", "", at(-1.0, 0, lambda phase, width: np.abs(phase - 0.41625) < 1e-5))
    with pytest.raises(ValueError, match=r"'between' must be .* at phase 0\.4163"):
        between.bounds(PHASE, 0.5)


@pytest.mark.parametrize(
    "fractions",
    [
        lambda phase, width: (1.0, 1.0),
        lambda phase, width: (np.ones(3), np.ones(3)),
        lambda phase, width: [phase + 1.0],
    ],
)
def test_fractions_of_another_array_shape_are_rejected(fractions):
    with pytest.raises(
        ValueError,
        match=r"`fractions` of the guide shape 'own' must return 2 arrays, .* of the shape \(2001,\) .* or \(2, 2001\) .* got",
    ):
        GuideShape("own", "", fractions)


def test_shape_may_have_other_bounds_at_the_knee():
    def fractions(phase: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        return np.ones_like(phase), np.stack([np.full_like(phase, 0.5), np.full_like(phase, 0.25)])

    bounds = np.degrees(GuideShape("own", "", fractions).bounds(PHASE, 0.5))
    np.testing.assert_allclose(bounds, np.broadcast_to([[[4.0, 2.0]], [[4.0, 1.0]]], bounds.shape))


def test_invalid_bound_at_the_knee_is_rejected():
    with pytest.raises(ValueError, match=r"got -0\.13\d* rad \(SK, upper\)"):
        GuideShape("own", "", lambda phase, width: (np.stack([phase + 1.0, phase - 1.0]), phase + 1.0))


def test_very_narrow_shape_is_accepted():
    assert GuideShape("thin", "", at(2e-4)).bounds(PHASE, 1.0).min() > 0.0
