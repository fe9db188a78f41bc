from __future__ import annotations

import pytest

from atalante_emulator.emergency import Emergency, Errors, FaultReaction, reaction_to, register_of


@pytest.fixture
def sent() -> list[Emergency]:
    return []


@pytest.fixture
def errors(sent: list[Emergency]) -> Errors:
    return Errors(("LEFT", "RIGHT"), sent)


def test_reaction_to_every_code_follows_its_class() -> None:
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
def test_error_register_has_the_bit_of_each_error_class(codes: list[int], register: int) -> None:
    assert register_of(codes) == register


class TestErrors:
    def test_emergency_is_sent_once_when_an_error_begins_and_once_when_acknowledged(
        self, errors: Errors, sent: list[Emergency]
    ) -> None:
        errors.begin(0, 0x8250)
        errors.begin(0, 0x8250)
        errors.acknowledge(0)
        errors.acknowledge(0)
        assert sent == [Emergency("LEFT", 0x11, 0x8250), Emergency("LEFT", 0, 0)]

    def test_error_of_one_node_does_not_change_the_other(self, errors: Errors, sent: list[Emergency]) -> None:
        errors.begin(1, 0x8250, persists=True)
        assert [errors.any_persists(node) for node in (0, 1)] == [False, True]
        assert [errors.has(node, 0x8250) for node in (0, 1)] == [False, True]
        errors.acknowledge(0)
        assert [e.node for e in sent] == ["RIGHT"]

    def test_persistent_error_cannot_be_acknowledged_before_its_end(
        self, errors: Errors, sent: list[Emergency]
    ) -> None:
        errors.begin(0, 0x4310, persists=True)
        errors.begin(0, 0x8250)
        assert sent[-1] == Emergency("LEFT", 0x19, 0x8250)
        errors.acknowledge(0)
        assert errors.any_persists(0)
        assert len(sent) == 2
        errors.end(0, 0x4310)
        assert errors.any_persists(0) is False
        assert errors.has(0, 0x4310) is False
        assert len(sent) == 2
        errors.acknowledge(0)
        assert sent[2:] == [Emergency("LEFT", 0, 0)]

    def test_end_of_an_unknown_error_sends_nothing(self, errors: Errors, sent: list[Emergency]) -> None:
        errors.end(0, 0x4310)
        errors.acknowledge(0)
        assert sent == []

    def test_clear_removes_the_errors_without_an_emergency(self, errors: Errors, sent: list[Emergency]) -> None:
        errors.begin(0, 0x4310, persists=True)
        errors.clear(0)
        errors.acknowledge(0)
        assert not errors.any_persists(0)
        assert len(sent) == 1


class TestWarnings:
    def test_warning_ends_after_the_inhibit_time(self, errors: Errors, sent: list[Emergency]) -> None:
        errors.warn(0, 0x8110)
        assert sent == [Emergency("LEFT", 0x11, 0x8110)]
        errors.advance()
        assert len(sent) == 1
        errors.advance()
        assert sent[1:] == [Emergency("LEFT", 0, 0)]
        for _ in range(5):
            errors.advance()
        assert len(sent) == 2

    def test_repeated_warning_is_sent_once_and_does_not_end(self, errors: Errors, sent: list[Emergency]) -> None:
        for _ in range(20):
            errors.warn(0, 0x8110)
            errors.advance()
        assert len(sent) == 1

    def test_warning_is_not_sent_again_within_the_inhibit_time(self, errors: Errors, sent: list[Emergency]) -> None:
        errors.warn(0, 0x8110)
        errors.advance()
        errors.advance()
        errors.warn(0, 0x8110)
        assert len(sent) == 2
        errors.advance()
        errors.warn(0, 0x8110)
        assert [e.code for e in sent] == [0x8110, 0, 0x8110]

    def test_two_warnings_are_sent_separately_and_end_with_one_frame(
        self, errors: Errors, sent: list[Emergency]
    ) -> None:
        errors.warn(0, 0x8110)
        errors.warn(0, 0x8200)
        errors.advance()
        errors.advance()
        assert [e.code for e in sent] == [0x8110, 0x8200, 0]

    def test_end_of_a_warning_is_not_reported_while_another_one_is_active(
        self, errors: Errors, sent: list[Emergency]
    ) -> None:
        errors.warn(0, 0x8110)
        errors.advance()
        errors.warn(0, 0x4210)
        assert sent[-1] == Emergency("LEFT", register_of([0x8110, 0x4210]), 0x4210)
        errors.advance()
        assert len(sent) == 2
        errors.advance()
        assert sent[2:] == [Emergency("LEFT", 0, 0)]

    def test_acknowledged_error_is_not_reported_as_the_end_of_a_warning(
        self, errors: Errors, sent: list[Emergency]
    ) -> None:
        errors.begin(0, 0x8250)
        errors.warn(0, 0x8110)
        errors.acknowledge(0)
        assert [e.code for e in sent] == [0x8250, 0x8110]

    def test_warning_of_a_node_that_restarts_is_forgotten(self, errors: Errors, sent: list[Emergency]) -> None:
        for node in (0, 1):
            errors.warn(node, 0x8110)
        errors.clear(0)
        errors.begin(0, 0x4310)
        assert sent[2:] == [Emergency("LEFT", register_of([0x4310]), 0x4310)]
        errors.acknowledge(0)
        errors.advance()
        errors.advance()
        assert sent[3:] == [Emergency("LEFT", 0, 0), Emergency("RIGHT", 0, 0)]

    def test_end_of_a_warning_does_not_end_an_error(self, errors: Errors, sent: list[Emergency]) -> None:
        errors.warn(0, 0x8110)
        errors.begin(0, 0x8250)
        errors.advance()
        errors.advance()
        assert [e.code for e in sent] == [0x8110, 0x8250]
        assert not errors.any_persists(0)
