"""Torque carried over a stance change: the command starts at the last torque and fades to the new one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.airwalk.carry_over import CarryOver, add_carried


def commands(carry: CarryOver, cycles: int, torque: float) -> list[float]:
    sent = []
    for cycle in range(cycles):
        command = np.full(12, torque)
        add_carried(carry.records, carry.blends, cycle, command)
        assert (command == command[0]).all()
        sent.append(float(command[0]))
    return sent


def test_added_torque_of_a_limited_joint_is_at_most_its_limit():
    carry = CarryOver(0.004, 0.002)
    carry.limit((2, 3), (3.0, 9.0))
    carry.start(np.full(12, -7.0))
    command = np.zeros(12)
    add_carried(carry.records, carry.blends, 0, command)
    assert command.tolist() == [-7.0, -7.0, -3.0, *[-7.0] * 9]
    assert carry.records[0].jump.tolist() == [-7.0] * 12
    for cycle, free, guided in ((1, 0.5 + 0.5 * math.cos(math.pi / 4.0), 0.5), (2, 0.5, 0.0), (4, 0.0, 0.0)):
        command = np.zeros(12)
        add_carried(carry.records, carry.blends, cycle, command)
        expected = np.full(12, -7.0 * free)
        expected[[2, 3]] = -3.0 * guided, -7.0 * guided
        np.testing.assert_allclose(command, expected, atol=1e-12)
    carry.limit((), ())
    carry.start(np.full(12, 7.0))
    command = np.zeros(12)
    add_carried(carry.records, carry.blends, 0, command)
    assert command.tolist() == [7.0] * 12


def test_torque_continues_from_the_last_one_and_fades_to_the_new_one():
    carry = CarryOver(0.004, 0.002)
    carry.start(np.full(12, 7.0))
    assert carry.pending
    factors = [0.5 + 0.5 * np.cos(np.pi * x) for x in (0.0, 0.25, 0.5, 0.75)]
    assert commands(carry, 6, 3.0) == pytest.approx([*(3.0 + 4.0 * factor for factor in factors), 3.0, 3.0])
    assert not carry.pending


def test_cancelled_change_carries_nothing_over():
    carry = CarryOver(0.004, 0.002)
    carry.start(np.full(12, 7.0))
    carry.cancel()
    assert commands(carry, 4, 3.0) == [3.0] * 4


def test_start_copies_the_torque():
    carry, before = CarryOver(0.002, 0.0), np.full(12, 7.0)
    carry.start(before)
    before[:] = 0.0
    assert commands(carry, 1, 3.0) == [7.0]
