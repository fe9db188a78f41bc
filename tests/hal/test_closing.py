from __future__ import annotations

import pytest

from atalante_hal.closing import Closing


class Door(Closing):
    closed = 0

    def close(self) -> None:
        self.closed += 1


def test_with_block_returns_the_object_and_closes_it_once() -> None:
    with Door() as door:
        assert door.closed == 0
    assert door.closed == 1


def test_error_in_the_block_closes_the_object_and_is_raised() -> None:
    door = Door()
    with pytest.raises(KeyError), door:
        raise KeyError
    assert door.closed == 1


def test_subclass_without_close_cannot_be_constructed() -> None:
    class Hole(Closing):
        pass

    with pytest.raises(TypeError, match="close"):
        Hole()  # type: ignore[abstract]
