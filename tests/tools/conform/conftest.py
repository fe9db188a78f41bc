"""Node tester with one emulated node; tests can change the frames and the internals of the node."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from atalante_dbc import Message, Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.robot import Robot
from atalante_hal.wire.frame import Frames
from atalante_tools.conform.examination import requirements_of
from atalante_tools.conform.node_tester import Limits, LockStep, NodeTester
from atalante_tools.conform.requirement import Result, Verdict, examine
from atalante_tools.conform.technician import EmulatorTechnician

from .wire import Reading, Wire


@dataclass
class NodeSetup:
    """One emulated node with its tester and bus."""

    tester: NodeTester
    wire: Wire
    emulator: Emulator

    def message(self, kind: str) -> Message:
        return self.tester.network.message(f"{self.tester.node.name}_{kind}")

    def examine(self, without: Sequence[str] = ()) -> list[Result]:
        return list(examine(self.tester, [r for r in requirements_of(self.tester) if r.id not in without]))


def receive_as(setup: NodeSetup, message: Message, other_data_id: int, change: Reading) -> NodeSetup:
    """Replace every frame of one message on its way to the node by the result of `change`."""
    memory: dict = {"other": other_data_id}

    def to_node(frame: Frames) -> Frames:
        if int(frame["can_id"][0]) != message.frame_id:
            return frame
        changed = change(frame.copy(), message, memory)
        return frame if changed is None else changed

    setup.wire.to_node = to_node
    return setup


def not_passed(results: list[Result]) -> dict[str, Verdict]:
    """Return the verdict of each requirement that did not pass, by id."""
    return {r.requirement.id: r.verdict for r in results if r.verdict is not Verdict.PASSED}


MakeSetup = Callable[..., NodeSetup]


@pytest.fixture
def make_setup(network: Network, robot: Robot, urdf_text: str) -> Iterator[MakeSetup]:
    bodies: list[PyBulletBody] = []

    def make(
        node: str,
        *,
        their_network: Network = network,
        their_robot: Robot = robot,
        operator: Operator | None = None,
        limits: Limits | None = None,
        **options: Any,
    ) -> NodeSetup:
        ours, theirs = lockstep_pair()
        body = PyBulletBody(urdf_text)
        bodies.append(body)
        operator = operator or Operator(starts=False)
        emulator = Emulator(their_network, their_robot, body, theirs, operator=operator, **options)
        ours.step = emulator.poll
        wire = Wire(ours)
        technician = EmulatorTechnician(emulator, operator)
        tester = NodeTester(network, robot, network.node(node), wire, LockStep(emulator), technician, limits)
        return NodeSetup(tester, wire, emulator)

    yield make
    for body in bodies:
        body.close()
