"""Record layout: each element of the vector has one name, and the layout is sent as JSON."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_hal import record
from atalante_hal.record_layout import Layout

FIELDS = st.lists(
    st.tuples(st.text("abc.", min_size=1, max_size=4), st.integers(1, 40)),
    max_size=20,
    unique_by=lambda field: field[0],
)


@given(FIELDS)
def test_slices_cover_the_vector_in_order_without_gaps(fields: list[tuple[str, int]]) -> None:
    layout = Layout(fields)
    indices = list(range(layout.size))
    assert [index for name in layout for index in indices[layout[name]]] == indices
    assert [(name, layout[name].stop - layout[name].start) for name in layout] == fields


@given(FIELDS)
def test_layout_is_unchanged_by_json(fields: list[tuple[str, int]]) -> None:
    layout = Layout(fields)
    back = Layout.from_json(layout.to_json())
    assert (back.fields, back.size) == (layout.fields, layout.size)
    assert all(back[name] == layout[name] for name in layout)


def test_index_of_each_header_field_is_its_position_in_the_record() -> None:
    indices = [getattr(record, name.removesuffix("_us").upper()) for name in record.HEADER_FIELDS]
    assert indices == list(range(len(record.HEADER_FIELDS)))


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ([("q", 1), ("q", 1)], "field 'q' must be defined once, got it twice"),
        ([("q", 0)], "field 'q' must have a length of at least 1, got 0"),
        ([("q", -1)], "field 'q' must have a length of at least 1, got -1"),
    ],
)
def test_duplicate_name_or_length_below_one_is_rejected(fields: list[tuple[str, int]], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Layout(fields)


def test_unknown_field_error_lists_the_known_fields() -> None:
    layout = Layout([("position", 12), ("velocity", 12)])
    assert "position" in layout
    assert "torque" not in layout
    with pytest.raises(KeyError, match="position, velocity"):
        layout["torque"]
