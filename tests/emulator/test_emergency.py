from __future__ import annotations

import pytest

from atalante_emulator.emergency import Emergency, Errors, FaultReaction, reaction_to, register_of


@pytest.fixture
def told() -> list[Emergency]:
    return []


@pytest.fixture
def errors(told: list[Emergency]) -> Errors:
    return Errors(("LEFT", "RIGHT"), told)


def test_every_code_has_a_reaction_by_its_class() -> None:
    lowers = {0x2, 0x4, 0x7}
    for code in range(1, 0x10000):
        reaction = reaction_to(code)
        if code in (0x8110, 0x8200):
            assert reaction is FaultReaction.NONE
        elif code >> 12 in lowers or code == 0x3222:
            assert reaction is FaultReaction.LOWER
        else:
            assert reaction is FaultReaction.HOLD


@pytest.mark.parametrize(
    ("codes", "register"),
    [
        ([], 0),
        ([0x1000], 0x01),
        ([0x2310], 0x03),
        ([0x3220], 0x05),
        ([0x4310], 0x09),
        ([0x8250], 0x11),
        ([0x7305], 0x21),
        ([0x4310, 0x8250], 0x19),
    ],
)
def test_register(codes: list[int], register: int) -> None:
    assert register_of(codes) == register


class TestErrors:
    def test_told_once_and_gone_once(self, errors: Errors, told: list[Emergency]) -> None:
        errors.begin(0, 0x8250)
        errors.begin(0, 0x8250)
        errors.acknowledge(0)
        errors.acknowledge(0)
        assert told == [Emergency("LEFT", 0x11, 0x8250), Emergency("LEFT", 0, 0)]

    def test_an_error_of_one_node_is_not_the_others(self, errors: Errors, told: list[Emergency]) -> None:
        errors.begin(1, 0x8250, persists=True)
        assert [errors.any_persists(node) for node in (0, 1)] == [False, True]
        assert [errors.has(node, 0x8250) for node in (0, 1)] == [False, True]
        errors.acknowledge(0)
        assert [e.node for e in told] == ["RIGHT"]

    def test_what_stands_stays(self, errors: Errors, told: list[Emergency]) -> None:
        errors.begin(0, 0x4310, persists=True)
        errors.begin(0, 0x8250)
        assert told[-1] == Emergency("LEFT", 0x19, 0x8250)
        errors.acknowledge(0)
        assert errors.any_persists(0)
        assert len(told) == 2
        errors.end(0, 0x4310)
        assert errors.any_persists(0) is False
        assert errors.has(0, 0x4310) is False
        assert len(told) == 2
        errors.acknowledge(0)
        assert told[2:] == [Emergency("LEFT", 0, 0)]

    def test_the_end_of_what_never_was_is_nothing(self, errors: Errors, told: list[Emergency]) -> None:
        errors.end(0, 0x4310)
        errors.acknowledge(0)
        assert told == []

    def test_forgotten_without_a_word(self, errors: Errors, told: list[Emergency]) -> None:
        errors.begin(0, 0x4310, persists=True)
        errors.clear(0)
        errors.acknowledge(0)
        assert not errors.any_persists(0)
        assert len(told) == 1


class TestNotices:
    def test_over_after_an_inhibit_time(self, errors: Errors, told: list[Emergency]) -> None:
        errors.warn(0, 0x8110)
        assert told == [Emergency("LEFT", 0x11, 0x8110)]
        errors.advance()
        assert len(told) == 1
        errors.advance()
        assert told[1:] == [Emergency("LEFT", 0, 0)]
        for _ in range(5):
            errors.advance()
        assert len(told) == 2

    def test_goes_on_as_long_as_it_happens(self, errors: Errors, told: list[Emergency]) -> None:
        for _ in range(20):
            errors.warn(0, 0x8110)
            errors.advance()
        assert len(told) == 1

    def test_no_sooner_again_than_the_inhibit_time(self, errors: Errors, told: list[Emergency]) -> None:
        errors.warn(0, 0x8110)
        errors.advance()
        errors.advance()
        errors.warn(0, 0x8110)
        assert len(told) == 2
        errors.advance()
        errors.warn(0, 0x8110)
        assert [e.code for e in told] == [0x8110, 0, 0x8110]

    def test_two_kinds_are_told_and_end_with_one_word(self, errors: Errors, told: list[Emergency]) -> None:
        errors.warn(0, 0x8110)
        errors.warn(0, 0x8200)
        errors.advance()
        errors.advance()
        assert [e.code for e in told] == [0x8110, 0x8200, 0]

    def test_an_error_outlives_a_notice(self, errors: Errors, told: list[Emergency]) -> None:
        errors.warn(0, 0x8110)
        errors.begin(0, 0x8250)
        errors.advance()
        errors.advance()
        assert [e.code for e in told] == [0x8110, 0x8250]
        assert not errors.any_persists(0)
