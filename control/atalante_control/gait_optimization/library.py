"""A library of gaits over a grid of subjects: resumable, fanned out over processes or a cluster, nothing silently missing.

`Grid, solve -> one file a gait -> fit`. Every gait is solved cold, so it depends on nothing but its own parameters: not on
its neighbours, the number of processes or how often the work was interrupted. That the neighbours follow one local minimum
all the same is what the fit shows.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

from atalante_control.gait.gait import Gait, load_gait, write_gait
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.parallel import fan_out
from atalante_control.gait_optimization.result import SolvedGait
from atalante_control.gait_optimization.solve import solve
from atalante_control.gait_optimization.verify import Verifier
from atalante_control.model import Patient
from atalante_hal.robot import Robot, load_robot

FORMAT = "atalante-library/1"
LEVELS_MIN = 3  # an axis: with two, a fit is off by 10 degrees between them

Index = tuple[int, ...]
#: What solves one gait; a function of a module, for other processes to find it.
Solve = Callable[[Subject], SolvedGait]


class LibraryError(ValueError):
    """The folder does not hold the library that was asked for; the message says what does."""


@dataclass(frozen=True)
class Grid:
    """Levels of each parameter; the default encloses the paper's subjects, who are 58 to 91 kg and 1.62 to 1.93 m.

    Raises:
        ValueError: fewer than three levels, levels that do not rise, or a subject out of range.
    """

    mass: tuple[float, ...] = (58.0, 68.0, 80.0, 91.0)  # kg
    height: tuple[float, ...] = (1.62, 1.71, 1.83, 1.93)  # m
    step_length: tuple[float, ...] = (0.10, 0.13, 0.165, 0.20)  # m
    step_duration: tuple[float, ...] = (0.7, 0.78, 0.88, 0.99, 1.1)  # s

    def __post_init__(self) -> None:
        for name, levels in zip(self.names(), self.axes(), strict=True):
            if len(levels) < LEVELS_MIN or any(b <= a for a, b in pairwise(levels)):
                raise ValueError(f"{name} has at least {LEVELS_MIN} levels that rise, not {list(levels)}")
        for index in (tuple(0 for _ in self.shape), tuple(n - 1 for n in self.shape)):
            self.subject(index)

    @staticmethod
    def names() -> tuple[str, ...]:
        """The parameters, in the order of an index."""
        return tuple(field.name for field in fields(Grid))

    def axes(self) -> tuple[tuple[float, ...], ...]:
        """The levels of each parameter."""
        return (self.mass, self.height, self.step_length, self.step_duration)

    @property
    def shape(self) -> tuple[int, ...]:
        """Levels of each parameter."""
        return tuple(map(len, self.axes()))

    def subject(self, index: Index) -> Subject:
        """Who stands at a point of the grid; leg lengths are Winter's."""
        mass, height, length, duration = (levels[i] for levels, i in zip(self.axes(), index, strict=True))
        return Subject(Patient(mass, height), length, duration)

    def points(self) -> list[Index]:
        """Every point of the grid."""
        return list(product(*map(range, self.shape)))


class Library:
    """The folder of a library: `grid.json`, `gaits/` with one gait file each, `failed/` with the record of each failure."""

    def __init__(self, folder: Path, grid: Grid | None = None) -> None:
        """Open a library, or begin one.

        Args:
            grid: what is wanted; None takes the folder's own.

        Raises:
            LibraryError: there is none and no grid to begin one, or the folder's is another.
        """
        self.folder = folder
        path = folder / "grid.json"
        try:
            found = _read_grid(path) if path.exists() else None
        except OSError as error:
            raise LibraryError(f"{path} cannot be read: {error.strerror}") from error
        except (TypeError, ValueError) as error:
            raise LibraryError(f"{path}: {error}") from error
        if found is None:
            if grid is None:
                raise LibraryError(f"{folder} holds no library; `atalante gait library --out {folder}` makes one")
            for name in ("gaits", "failed"):
                (folder / name).mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"format": FORMAT, **asdict(grid)}, indent=1) + "\n", encoding="utf-8")
        elif grid is not None and grid != found:
            raise LibraryError(f"{folder} holds a library over another grid, {found}; choose another folder")
        self.grid = grid or found or Grid()

    def gait(self, index: Index, robot: Robot) -> Gait | None:
        """The gait of a point; None while there is none. Raises `GaitError`."""
        path = self._path("gaits", index)
        return load_gait(path, robot) if path.exists() else None

    def gaits(self, robot: Robot) -> dict[Index, Gait]:
        """Every gait there is. Raises `GaitError`."""
        found = ((index, self.gait(index, robot)) for index in self.grid.points())
        return {index: gait for index, gait in found if gait is not None}

    def failures(self) -> dict[Index, str]:
        """Why the last attempt failed, of every point where it did."""
        failed = ((index, self._path("failed", index)) for index in self.grid.points())
        return {
            index: str(json.loads(path.read_text(encoding="utf-8"))["status"])
            for index, path in failed
            if path.exists()
        }

    def missing(self) -> list[Index]:
        """Points without a gait, failed or not yet tried."""
        return [index for index in self.grid.points() if not self._path("gaits", index).exists()]

    def generate(
        self, solve: Solve, *, jobs: int = 1, cluster: str | None = None
    ) -> Generator[tuple[Subject, SolvedGait], None, None]:
        """Solve what is missing, and tell of each point once it is on the disk.

        Args:
            jobs: processes on this machine.
            cluster: address of a dask scheduler whose workers solve instead.

        Raises:
            FanOutError: they cannot, see `fan_out`.
        """
        tasks = [(index, self.grid.subject(index)) for index in self.missing()]
        for index, solved in fan_out(partial(_solve, solve), tasks, jobs=jobs, cluster=cluster):
            self._keep(index, solved)
            yield self.grid.subject(index), solved

    def _path(self, kind: str, index: Index) -> Path:
        levels = (axis[i] for axis, i in zip(self.grid.axes(), index, strict=True))
        return (
            self.folder
            / kind
            / ("_".join(f"{letter}{v:g}" for letter, v in zip("mhld", levels, strict=True)) + ".json")
        )

    def _keep(self, index: Index, solved: SolvedGait) -> None:
        failed = self._path("failed", index)
        if solved.solved:
            write_gait(solved.gait, self._path("gaits", index))
            failed.unlink(missing_ok=True)
        else:
            record = {"parameters": dict(solved.gait.parameters), "solver": dict(solved.gait.solver)}
            failed.write_text(json.dumps({"status": solved.status, **record}, indent=1) + "\n", encoding="utf-8")


def solve_subject(subject: Subject) -> SolvedGait:
    """The gait of a subject, cold, and then verified by Pinocchio alone."""
    return verified(subject, solve(subject))


def solve_compiled(subject: Subject) -> SolvedGait:
    """The same gait by functions that are compiled first, once on a machine: minutes, and then half the time a gait."""
    return verified(subject, solve(subject, machine_code=True))


def verified(subject: Subject, solved: SolvedGait) -> SolvedGait:
    """The gait as it is, or failed where the verification does not agree that it is one."""
    if not solved.solved:
        return solved
    for check in Verifier(load_robot(), subject.patient).verify(solved.gait):
        if not check.holds:
            status = f"{subject}: {check.name} is {check.value:.3g} {check.unit} when verified, over {check.limit:.3g}"
            return replace(solved, status=status)
    return solved


def _solve(solve: Solve, task: tuple[Index, Subject]) -> tuple[Index, SolvedGait]:
    index, subject = task
    return index, solve(subject)


def _read_grid(path: Path) -> Grid:
    document = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(document, dict) or document.pop("format", None) != FORMAT:
        raise ValueError(f"format is {FORMAT!r} in the grid of a library")
    return Grid(**{name: _levels(name, values) for name, values in document.items()})


def _levels(name: str, values: Any) -> tuple[float, ...]:
    if not isinstance(values, Sequence) or not all(type(value) in (int, float) for value in values):
        raise ValueError(f"{name} is a list of numbers, not {values!r}")
    return tuple(map(float, values))
