from __future__ import annotations

import math
import pickle
from typing import Any

import pytest

from atalante_emulator.faults import KINDS, Fault, FaultError


def test_as_given_with_defaults_filled_in() -> None:
    fault = Fault("duplicate", "LEFT_SK_STATE", 100, 5, p=0.25)
    assert (fault.kind, fault.target, fault.start, fault.cycles) == ("duplicate", "LEFT_SK_STATE", 100, 5)
    assert (fault["p"], fault["copies"]) == (0.25, 1)
    assert fault.end == 105
    assert str(fault) == "duplicate LEFT_SK_STATE p=0.25 copies=1"


def test_for_good_from_the_start() -> None:
    fault = Fault("silence", "LEFT_SK")
    assert (fault.start, fault.end) == (0, math.inf)


def test_signals_are_parameters() -> None:
    assert Fault("value", "LEFT_SK_STATE", Position=1, p=0.5).signals == {"Position": 1.0}


def test_equal_faults_are_one_and_travel_between_processes() -> None:
    fault = Fault("drop", "LEFT_SK", 1, 2)
    assert {fault, Fault("drop", "LEFT_SK", 1, 2, p=1.0)} == {fault}
    assert pickle.loads(pickle.dumps(fault)) == fault
    with pytest.raises(AttributeError):
        fault.start = 2  # type: ignore[misc]


@pytest.mark.parametrize(
    ("kind", "options", "says"),
    [
        ("dropp", {}, "kind of fault must be one of drop, duplicate, .*, got 'dropp'"),
        ("drop", {"start": -1}, r"start of a fault must be an integer of at least 0 \[cycles\], got -1"),
        ("drop", {"start": 1.0}, r"start of a fault must be an integer of at least 0 \[cycles\], got 1.0"),
        ("drop", {"cycles": 0}, r"duration of a fault must be an integer of at least 1 \[cycles\], or None, got 0"),
        (
            "drop",
            {"cycles": True},
            r"duration of a fault must be an integer of at least 1 \[cycles\], or None, got True",
        ),
        ("drop", {"p": 1.5}, "drop: p must be a number from 0 to 1, got 1.5"),
        ("drop", {"p": math.nan}, "drop: p must be a number from 0 to 1, got nan"),
        ("drop", {"p": "1"}, "drop: p must be a number from 0 to 1, got '1'"),
        ("drop", {"q": 1.0}, "drop: unknown parameter 'q'; valid parameters: p"),
        ("silence", {"p": 1.0}, "silence: unknown parameter 'p'; valid parameters: none"),
        ("delay", {"by": 0}, "delay: by must be an integer from 1 to 1000, got 0"),
        ("delay", {"by": 1.0}, "delay: by must be an integer from 1 to 1000, got 1.0"),
        ("length", {}, "length: bytes must be a CAN FD payload length in bytes: 0, 1, .*, 48, 64, got no value"),
        ("length", {"bytes": 13}, "length: bytes must be a CAN FD payload length in bytes: .*, got 13"),
        ("masquerade", {"like": 3}, "masquerade: like must be the name of a message, got 3"),
        ("value", {}, "value: the fault must set a signal, for example Position=0.3, got no signal"),
        ("raw", {"p": 0.5}, "raw: the fault must set a signal, for example Position=0.3, got no signal"),
        ("value", {"Position": math.inf}, "value: signal Position must be a finite number, got inf"),
    ],
)
def test_what_is_valid_is_said(kind: str, options: dict[str, Any], says: str) -> None:
    with pytest.raises(FaultError, match=says):
        Fault(kind, "LEFT_SK_STATE", **options)


def test_every_kind_says_what_it_does() -> None:
    for kind in KINDS.values():
        assert kind.does
        assert kind.targets
        assert all(parameter.valid for parameter in kind.parameters.values())


def test_the_same_fault_from_another_cycle_on() -> None:
    fault = Fault("value", "LEFT_SK_STATE", 10, 3, p=0.5, Position=0.3)
    later = fault.starting(500)
    assert later == Fault("value", "LEFT_SK_STATE", 500, 3, p=0.5, Position=0.3)
    assert fault.start == 10
