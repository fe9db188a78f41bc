"""Structured arrays of record classes: dtype, attribute access, and rejected annotations."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
import pytest

from atalante_control.structured import dtype_of, zeros
from atalante_hal.compiled import compiled
from atalante_hal.types import Vector


class Sample:
    flag: bool
    number: int
    value: float
    pair: Annotated[Vector, 2]
    matrix: Annotated[npt.NDArray[np.int64], (2, 3)]


class Wrong:
    text: str


def test_fields_have_the_types_and_shapes_of_the_annotations():
    dtype = dtype_of(Sample)
    assert dtype.names == ("flag", "number", "value", "pair", "matrix")
    assert [dtype[name].base for name in dtype.names or ()] == [np.bool_, np.int64, np.float64, np.float64, np.int64]
    assert [dtype[name].shape for name in dtype.names or ()] == [(), (), (), (2,), (2, 3)]
    assert dtype.isalignedstruct


def write(samples: npt.NDArray[np.void]) -> float:
    sample = samples[1]
    sample.flag, sample.number, sample.value = True, 3, 2.5
    sample.pair[0], sample.matrix[1, 2] = 1.5, 4
    return float(sample.pair[0] + sample.value)


def test_machine_code_and_python_write_the_same_fields():
    machine, source = zeros(Sample, 2), zeros(Sample, 2)
    assert compiled(write)(machine) == write(source) == 4.0
    assert machine.tobytes() == source.tobytes()
    assert machine["matrix"][1, 1, 2] == 4


def test_field_of_an_unsupported_type_is_rejected():
    with pytest.raises(TypeError, match=r"Wrong\.text must be float, int, bool or Annotated"):
        dtype_of(Wrong)
