"""Structured arrays for compiled kernels. A record class declares the fields of an array. `record class -> dtype, array`.

A record class only declares fields; it is never instantiated. The arrays are NumPy structured arrays, whose fields numba reads
and writes as attributes. The class states the type of each field for the type checker, and the unit of each field for the reader.
"""

from __future__ import annotations

from typing import Annotated, Any, Protocol, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

Record = TypeVar("Record", covariant=True)
_SCALARS: dict[Any, type[np.generic]] = {float: np.float64, int: np.int64, bool: np.bool_}


class Records(Protocol[Record]):
    """Structured array of shape (n,), whose elements have the fields of a record class."""

    def __len__(self) -> int:
        """Return the number of records."""

    def __getitem__(self, index: int, /) -> Record:
        """Return a view of a record; writing to a field of the view changes the array.

        Args:
            index: index of the record.
        """


def dtype_of(record: type) -> np.dtype[np.void]:
    """Return the aligned dtype of a record class.

    Args:
        record: class whose annotations are `float`, `int`, `bool`, or `Annotated[array type, shape]` for an array.

    Raises:
        TypeError: If an annotation is of another type.
    """
    fields = [(name, *_field(record, name, hint)) for name, hint in get_type_hints(record, include_extras=True).items()]
    # `np.record` allows attribute access when numba is disabled and the kernels run as plain Python.
    return np.dtype((np.record, np.dtype(fields, align=True)))


def zeros(record: type, count: int) -> npt.NDArray[np.void]:
    """Return an array of records in which every field is zero or False.

    Args:
        record: record class, see `dtype_of`.
        count: number of records.
    """
    return np.zeros(count, dtype_of(record))


def _field(record: type, name: str, hint: object) -> tuple[Any, tuple[int, ...]]:
    if hint in _SCALARS:
        return _SCALARS[hint], ()
    if get_origin(hint) is Annotated:
        array, shape = get_args(hint)
        # Up to Python 3.11, NDArray[scalar] is ndarray[shape, dtype[scalar]].
        # From Python 3.12 on, NDArray[scalar] can be an alias whose only argument is `scalar`.
        argument = get_args(array)[-1]
        scalar = get_args(argument)[0] if get_origin(argument) is np.dtype else argument
        return scalar, shape if isinstance(shape, tuple) else (shape,)
    raise TypeError(f"{record.__name__}.{name} must be float, int, bool or Annotated[array, shape], got {hint!r}")
