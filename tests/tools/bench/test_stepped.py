"""Tests of the step-by-step prediction against the tables of the guide filter."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from atalante_tools.bench.nodes import walk
from atalante_tools.bench.stepped import SteppedRollout


@given(st.lists(st.floats(-1.0, 1.0), min_size=10, max_size=10))
@settings(max_examples=30, deadline=None)
def test_integration_agrees_with_the_responses(state: list[float]):
    x = np.array(state) * np.repeat([0.05, 1.0, 1.0, 50.0, 50.0], 2)
    prediction = walk().guide.prediction
    np.testing.assert_allclose(SteppedRollout(walk().guide).errors(x), prediction.nominal.error[:301] @ x, atol=1e-10)
