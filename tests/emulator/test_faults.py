from __future__ import annotations

import math
import pickle
from typing import Any

import pytest

from atalante_emulator.faults import KINDS, Fault, FaultError


def test_fault_has_the_given_values_and_the_defaults_of_its_kind() -> None:
    fault = Fault("duplicate", "LEFT_SK_STATE", 100, 5, p=0.25)
    assert (fault.kind, fault.target, fault.start, fault.cycles) == ("duplicate", "LEFT_SK_STATE", 100, 5)
    assert (fault["p"], fault["copies"]) == (0.25, 1)
    assert fault.end == 105
    assert str(fault) == "duplicate LEFT_SK_STATE p=0.25 copies=1"


def test_fault_without_times_lasts_from_cycle_zero_forever() -> None:
    fault = Fault("silence", "LEFT_SK")
    assert (fault.start, fault.end) == (0, math.inf)


def test_signals_exclude_the_parameters_of_the_kind() -> None:
    assert Fault("value", "LEFT_SK_STATE", Position=1, p=0.5).signals == {"Position": 1.0}


def test_equal_faults_hash_equally_survive_pickling_and_are_immutable() -> None:
    fault = Fault("drop", "LEFT_SK", 1, 2)
    assert {fault, Fault("drop", "LEFT_SK", 1, 2, p=1.0)} == {fault}
    assert pickle.loads(pickle.dumps(fault)) == fault
    with pytest.raises(AttributeError):
        fault.start = 2  # type: ignore[misc]


@pytest.mark.parametrize(
    ("kind", "options", "expected"),
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
        ("drop", {"p": 1.5}, "drop: the parameter 'p' must be a number from 0 to 1, got 1.5"),
        ("drop", {"p": math.nan}, "drop: the parameter 'p' must be a number from 0 to 1, got nan"),
        ("drop", {"p": "1"}, "drop: the parameter 'p' must be a number from 0 to 1, got '1'"),
        ("drop", {"q": 1.0}, "drop: unknown parameter 'q'; valid parameters: p"),
        ("silence", {"p": 1.0}, "silence: unknown parameter 'p'; valid parameters: none"),
        ("delay", {"by": 0}, "delay: the parameter 'by' must be an integer from 1 to 1000, got 0"),
        ("delay", {"by": 1.0}, "delay: the parameter 'by' must be an integer from 1 to 1000, got 1.0"),
        (
            "length",
            {},
            "length: the parameter 'bytes' must be a CAN FD payload length in bytes: 0, 1, .*, 48, 64, got no value",
        ),
        ("length", {"bytes": 13}, "length: the parameter 'bytes' must be a CAN FD payload length in bytes: .*, got 13"),
        ("masquerade", {"like": 3}, "masquerade: the parameter 'like' must be the name of a message, got 3"),
        ("value", {}, "value: the fault must set a signal, for example Position=0.3, got no signal"),
        ("raw", {"p": 0.5}, "raw: the fault must set a signal, for example Position=0.3, got no signal"),
        ("value", {"Position": math.inf}, "value: signal Position must be a finite number, got inf"),
    ],
)
def test_invalid_parameter_error_lists_the_valid_ones(kind: str, options: dict[str, Any], expected: str) -> None:
    with pytest.raises(FaultError, match=expected):
        Fault(kind, "LEFT_SK_STATE", **options)


def test_every_kind_has_a_description_targets_and_valid_ranges() -> None:
    for kind in KINDS.values():
        assert kind.does
        assert kind.targets
        assert all(parameter.valid for parameter in kind.parameters.values())


def test_starting_returns_a_copy_with_another_start_cycle() -> None:
    fault = Fault("value", "LEFT_SK_STATE", 10, 3, p=0.5, Position=0.3)
    later = fault.starting(500)
    assert later == Fault("value", "LEFT_SK_STATE", 500, 3, p=0.5, Position=0.3)
    assert fault.start == 10
