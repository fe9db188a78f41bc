from __future__ import annotations

import pytest

from atalante_hal.closing import Closing


class Door(Closing):
    closed = 0

    def close(self) -> None:
        self.closed += 1


def test_the_block_has_the_thing_itself_and_closes_it_once() -> None:
    with Door() as door:
        assert door.closed == 0
    assert door.closed == 1


def test_an_error_closes_it_too_and_goes_on() -> None:
    door = Door()
    with pytest.raises(KeyError), door:
        raise KeyError
    assert door.closed == 1


def test_what_cannot_be_closed_cannot_be_made() -> None:
    class Hole(Closing):
        pass

    with pytest.raises(TypeError, match="close"):
        Hole()  # type: ignore[abstract]
