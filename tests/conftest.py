"""Shared fixtures: the network, the robot, and an embedded rig of HAL and emulator in lock-step."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hal_witness
import numpy as np
import pytest
from command_limits import RECORD, CommandLimits, database
from hypothesis import HealthCheck, Phase, settings

import atalante_dbc
from atalante_control.model import ExoskeletonParameters, urdf
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus import Bus
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot, load_robot
from atalante_hal.safety.direction import pose_gains
from atalante_hal.types import Command, State, SupervisorState
from atalante_hal.wire.frame import Frames

# A shell starts background jobs with SIGINT ignored, and `nohup` ignores SIGHUP. The tests send both signals to programs, and
# processes inherit this setting.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

# Examples have no deadline, because the first example may compile functions.
settings.register_profile("any time", deadline=None)
settings.load_profile("any time")
# Profile for `make mutation`: failing examples are not shrunk, because shrinking is slow. A process runs each test twice.
settings.register_profile(
    "mutation",
    deadline=None,
    phases=(Phase.explicit, Phase.generate),
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.differing_executors],
)
# Profile for `make coverage`: a few examples are sufficient to cover every line.
settings.register_profile("coverage", settings.get_profile("mutation"), max_examples=5)


class Witness:
    """Check of the frames that the HALs of this process and its subprocesses sent. Each HAL writes its frames to one file."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="atalante-witness-"))
        self._checks: defaultdict[Path, CommandLimits] = defaultdict(CommandLimits)
        self._read: Counter[Path] = Counter()  # checked bytes of the files of other processes
        self._ours = f"{os.getpid()}-"

    def check(self) -> list[str]:
        """Check the frames since the last call; return the violations."""
        violations = []
        with os.scandir(self.folder) as entries:
            files = {Path(entry.path): entry.stat().st_size for entry in entries}
        for path, size in sorted(files.items()):
            done = self._read[path]
            whole = (size - done) // RECORD.itemsize * RECORD.itemsize
            if not whole:
                continue
            with path.open("rb") as file:
                file.seek(done)
                content = file.read(whole)
            if path.name.startswith(self._ours):
                os.truncate(path, 0)  # no HAL writes at this time; otherwise the files would grow to gigabytes
            else:
                self._read[path] = done + whole
            limits = self._checks[path]
            if limits.check(np.frombuffer(content, RECORD)):
                violations.append(limits.summary())
        return violations

    @property
    def counts(self) -> tuple[int, int]:
        """Return the number of HALs and the number of command frames that were checked so far."""
        return len(self._checks), sum(limits.command_frames for limits in self._checks.values())


_witness_key = pytest.StashKey[Witness]()
_counts_key = pytest.StashKey[list[tuple[int, int]]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_witness_key] = Witness()
    config.stash[_counts_key] = []
    # With xdist the tests run in its workers, which load this file, too.
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        hal_witness.start(str(config.stash[_witness_key].folder))
        gc.disable()  # until `pytest_collection_finish`, because the collection of the tests creates many objects and no garbage


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the cases of a test with the mark `sample(n)` as long, except the cases 0, n, 2n and so on."""
    cases: Counter[str] = Counter()
    for item in items:
        if (sample := item.get_closest_marker("sample")) is not None:
            test = item.nodeid.partition("[")[0]
            if cases[test] % sample.args[0]:
                item.add_marker("long")
            cases[test] += 1


def pytest_collection_finish() -> None:
    """Exclude the half million objects of modules and tests from garbage collection, so that a collection takes less time.

    Each run of the control loop asks whether objects are frozen. Python counts them one by one, which takes 60 ms for so many.
    """
    gc.enable()
    gc.collect()
    gc.freeze()
    frozen = gc.get_freeze_count()
    gc.get_freeze_count = lambda: frozen


@pytest.fixture(scope="session")
def witness(pytestconfig: pytest.Config) -> Witness:
    return pytestconfig.stash[_witness_key]


@pytest.fixture(autouse=True)
def _commands_within_limits(witness: Witness) -> Iterator[None]:
    """Fail a test if a HAL sent a frame of another node, or a command beyond the limits."""
    yield
    if violations := witness.check():
        pytest.fail("a HAL sent forbidden frames:\n" + "\n".join(violations), pytrace=False)


def pytest_sessionfinish(session: pytest.Session) -> None:
    counts = session.config.stash[_witness_key].counts
    session.config.stash[_counts_key].append(counts)
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["witness"] = counts


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    node.config.stash[_counts_key].append(tuple(getattr(node, "workeroutput", {}).get("witness", (0, 0))))


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    hals, frames = (sum(column) for column in zip(*config.stash[_counts_key], strict=True))
    terminalreporter.write_line(f"{frames} command frames of {hals} HALs checked with cantools and the limits file")


def pytest_unconfigure(config: pytest.Config) -> None:
    shutil.rmtree(config.stash[_witness_key].folder)


@pytest.fixture(scope="session")
def network() -> atalante_dbc.Network:
    return atalante_dbc.load()


@pytest.fixture(scope="session")
def robot() -> Robot:
    return load_robot()


@pytest.fixture(scope="session")
def urdf_text(robot: Robot) -> str:
    return urdf(ExoskeletonParameters(), robot)


class FilterBus(WrappedBus):
    """A bus on which a test can drop, change or add frames to the HAL or to the nodes."""

    def __init__(self, bus: Bus) -> None:
        super().__init__(bus)
        self.to_hal: Callable[[Frames], Frames] = lambda frames: frames
        self.to_nodes: Callable[[Frames], Frames] = lambda frames: frames

    def send(self, frames: Frames) -> None:
        kept = self.to_nodes(frames)
        if len(kept):
            self.bus.send(np.ascontiguousarray(kept))

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        count = self.bus.receive(frames, timeout)
        kept = self.to_hal(frames[:count].copy())
        frames[: len(kept)] = kept
        return len(kept)


@dataclass
class HoldRig:
    """HAL and emulator in one process; `cycle` runs one cycle of a stiff position hold."""

    hal: Hal
    emulator: Emulator
    bus: FilterBus
    operator: Operator
    sent: list[Frames]

    def cycle(self, torque: np.ndarray | None = None) -> State:
        state = self.hal.read()
        if state.supervisor is SupervisorState.ACTIVE:
            self.hal.write(self.hold_torque() if torque is None else Command(torque, np.zeros(8)))
        else:
            self._anchor = state.position.copy()
            self.hal.hold()
        return state

    def run(self, cycles: int) -> State:
        for _ in range(cycles):
            state = self.cycle()
        return state

    def until(self, wanted: SupervisorState, cycles: int = 600) -> State:
        for _ in range(cycles):
            state = self.cycle()
            if state.supervisor is wanted:
                return state
        raise AssertionError(
            f"not {wanted.name} after {cycles} cycles: {self.hal.reason}, missing {self.hal.missing()}"
        )

    def walk(self, cycles: int, *, step: int | None = None, **flags: bool) -> State:
        """Run cycles with the commands of a pose hold in every supervisor state; `flags` are fields of `Command`."""
        for _ in range(cycles):
            self.hal.read()
            self.hal.write(self.hold_torque(step=step, **flags))
        return self.hal.state

    def hold_torque(self, *, step: int | None = None, **flags: bool) -> Command:
        robot, state = self.hal.robot, self.hal.state
        stiffness, damping = pose_gains(robot)
        torque = stiffness * (self._anchor - state.position) - damping * state.velocity
        return Command(torque, np.zeros(8), step=step, **flags)

    def codes(self) -> list[str]:
        return [event.code for event in self.hal.events]

    def events_of(self, *codes: str) -> list[tuple[str, str]]:
        return [(event.code, event.severity) for event in self.hal.events if event.code in codes]

    def last_commands(self) -> dict[str, dict[str, float]]:
        """Return the newest command frames decoded by cantools, by side."""
        frames = next(f for f in reversed(self.sent) if f["can_id"][0] == 0x100)
        return {
            side: database().decode_message(int(f["can_id"]), f["data"][: f["len"]].tobytes(), decode_choices=False)
            for side, f in zip(("left", "right"), frames[:2], strict=True)
        }

    def controlwords(self) -> set[int]:
        return {int(v) for c in self.last_commands().values() for k, v in c.items() if k.endswith("Controlword")}

    @staticmethod
    def drop(*ids: int) -> Callable[[Frames], Frames]:
        return lambda frames: frames[~np.isin(frames["can_id"], ids)]


class _Tap:
    def __init__(self, sent: list[Frames]) -> None:
        self._sent = sent

    def sent(self, frames: Frames) -> None:
        self._sent.append(frames.copy())

    def received(self, frames: Frames, count: int) -> None:
        pass


@pytest.fixture
def make_rig(network: atalante_dbc.Network, robot: Robot, urdf_text: str) -> Iterator[Callable[..., HoldRig]]:
    bodies: list[PyBulletBody] = []

    def make(
        *,
        seed: int = 0,
        assistance_factor: float | None = None,
        starts: bool = True,
        hal_network: atalante_dbc.Network = network,
        **options: Any,
    ) -> HoldRig:
        ours, theirs = lockstep_pair()
        body = PyBulletBody(urdf_text)
        bodies.append(body)
        operator = Operator(assistance_factor, starts=starts)
        emulator = Emulator(network, robot, body, theirs, seed=seed, operator=operator)
        ours.step = emulator.poll
        bus = FilterBus(ours)
        sent: list[Frames] = []
        hal = Hal(hal_network, robot, bus, tap=_Tap(sent), **options)
        return HoldRig(hal, emulator, bus, operator, sent)

    yield make
    for body in bodies:
        body.close()


@pytest.fixture
def rig(make_rig: Callable[..., HoldRig]) -> HoldRig:
    return make_rig()
