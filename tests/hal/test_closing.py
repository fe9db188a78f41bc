from __future__ import annotations

import pytest

from atalante_hal.closing import Closing


class Resource(Closing):
    closed = 0

    def close(self) -> None:
        self.closed += 1


def test_with_block_returns_the_object_and_closes_it_once() -> None:
    with Resource() as resource:
        assert resource.closed == 0
    assert resource.closed == 1


def test_error_in_the_block_closes_the_object_and_is_raised() -> None:
    resource = Resource()
    with pytest.raises(KeyError), resource:
        raise KeyError
    assert resource.closed == 1


def test_subclass_without_close_cannot_be_constructed() -> None:
    class Unclosable(Closing):
        pass

    with pytest.raises(TypeError, match="close"):
        Unclosable()  # type: ignore[abstract]
