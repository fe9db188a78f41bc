"""Library of gaits for a grid of subjects, solved in parallel. An interrupted computation can be resumed.

`Grid, solve -> one file for each gait`. `atalante_control.gait_optimization.fit` reads the files. Every gait is solved without
a warm start, so a gait depends only on the parameters of its own subject. Other gaits, the number of processes and
interruptions have no effect. The small error of the fit shows that the optimiser finds similar local minima for similar
subjects. Failures are recorded in files.
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
LEVELS_MIN = 3  # smallest number of grid levels of a parameter; a network fitted to 2 levels has an error of 10 degrees

Index = tuple[int, ...]
#: Function that solves one gait. It must be defined at module level, because other processes import it.
Solve = Callable[[Subject], SolvedGait]


class LibraryError(ValueError):
    """Error of a gait library that is missing, invalid or made for another grid. The message states the file or folder."""


@dataclass(frozen=True)
class Grid:
    """Grid of subjects. The default covers the subjects of the paper (58 to 91 kg, 1.62 to 1.93 m).

    Each attribute is the list of levels of one parameter, in ascending order.

    Raises:
        ValueError: If there are fewer than three levels, levels are not ascending, or a subject is out of range.
    """

    mass: tuple[float, ...] = (58.0, 68.0, 80.0, 91.0)  # kg
    height: tuple[float, ...] = (1.62, 1.71, 1.83, 1.93)  # m
    step_length: tuple[float, ...] = (0.10, 0.13, 0.165, 0.20)  # m
    step_duration: tuple[float, ...] = (0.7, 0.78, 0.88, 0.99, 1.1)  # s

    def __post_init__(self) -> None:
        for name, levels in zip(self.names(), self.axes(), strict=True):
            if len(levels) < LEVELS_MIN or any(b <= a for a, b in pairwise(levels)):
                raise ValueError(f"{name} must have at least {LEVELS_MIN} ascending levels, got {list(levels)}")
        for index in (tuple(0 for _ in self.shape), tuple(n - 1 for n in self.shape)):
            self.subject(index)

    @staticmethod
    def names() -> tuple[str, ...]:
        """Return the names of the parameters, in the order of an `Index`."""
        return tuple(field.name for field in fields(Grid))

    def axes(self) -> tuple[tuple[float, ...], ...]:
        """Return the levels of each parameter, in the order of `names`."""
        return (self.mass, self.height, self.step_length, self.step_duration)

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the number of levels of each parameter, in the order of `names`."""
        return tuple(map(len, self.axes()))

    def subject(self, index: Index) -> Subject:
        """Return the subject at a point of the grid, with the leg lengths of Winter's table.

        Args:
            index: index of the level of each parameter.
        """
        mass, height, length, duration = (levels[i] for levels, i in zip(self.axes(), index, strict=True))
        return Subject(Patient(mass, height), length, duration)

    def points(self) -> list[Index]:
        """Return the indices of all points of the grid."""
        return list(product(*map(range, self.shape)))


class Library:
    """Library in a folder: `grid.json`, `gaits/` with one file per gait, and `failed/` with one file per failed gait."""

    def __init__(self, folder: Path, grid: Grid | None = None) -> None:
        """Open a library, or create it.

        Args:
            folder: folder of the library.
            grid: required grid, or None to accept the grid that is stored in the folder.

        Raises:
            LibraryError: If the folder has no library and no grid is given, or if the library has another grid.
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
                raise LibraryError(
                    f"{folder} contains no library: create it with `atalante gait library --out {folder}`"
                )
            for name in ("gaits", "failed"):
                (folder / name).mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"format": FORMAT, **asdict(grid)}, indent=1) + "\n", encoding="utf-8")
        elif grid is not None and grid != found:
            raise LibraryError(
                f"grid of the library in {folder} must be {grid}, got {found}: choose another folder or grid"
            )
        self.grid = grid or found or Grid()

    def gait(self, index: Index, robot: Robot) -> Gait | None:
        """Return the gait of a point of the grid, or None if it is not solved yet.

        Args:
            index: index of the level of each parameter.
            robot: limits of the joints.

        Raises:
            GaitError: If the gait file is not valid.
        """
        path = self._path("gaits", index)
        return load_gait(path, robot) if path.exists() else None

    def gaits(self, robot: Robot) -> dict[Index, Gait]:
        """Return all gaits of the library.

        Args:
            robot: limits of the joints.

        Raises:
            GaitError: If a gait file is not valid.
        """
        found = ((index, self.gait(index, robot)) for index in self.grid.points())
        return {index: gait for index, gait in found if gait is not None}

    def failures(self) -> dict[Index, str]:
        """Return the reason of the last failure for each grid point that failed."""
        failed = ((index, self._path("failed", index)) for index in self.grid.points())
        return {
            index: str(json.loads(path.read_text(encoding="utf-8"))["status"])
            for index, path in failed
            if path.exists()
        }

    def missing(self) -> list[Index]:
        """Return the grid points without a gait file."""
        return [index for index in self.grid.points() if not self._path("gaits", index).exists()]

    def generate(
        self, solve: Solve, *, jobs: int = 1, cluster: str | None = None
    ) -> Generator[tuple[Subject, SolvedGait], None, None]:
        """Solve the missing gaits, and yield each result after it is written to disk.

        Args:
            solve: function that solves one gait, defined at module level.
            jobs: number of processes on this computer.
            cluster: address of a dask scheduler; its workers are used instead of processes on this computer.

        Raises:
            FanOutError: If the calls cannot be distributed, see `fan_out`.
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
    """Solve the gait of a subject without a warm start, and verify it with Pinocchio.

    Args:
        subject: patient and step parameters.
    """
    return verified(subject, solve(subject))


def solve_compiled(subject: Subject) -> SolvedGait:
    """Solve and verify the gait of a subject with compiled functions. The result is the same as that of `solve_subject`.

    The functions are compiled once per computer. The computation of a gait then takes half the time.

    Args:
        subject: patient and step parameters.
    """
    return verified(subject, solve(subject, machine_code=True))


def verified(subject: Subject, solved: SolvedGait) -> SolvedGait:
    """Verify a solved gait with Pinocchio. If a check fails, the status of the result names this check.

    Args:
        subject: patient and step parameters.
        solved: result of the solver.
    """
    if not solved.solved:
        return solved
    for check in Verifier(load_robot(), subject.patient).verify(solved.gait):
        if not check.holds:
            status = (
                f"{subject}: {check.name} must be at most {check.limit:.3g} {check.unit} in the verification, "
                f"got {check.value:.3g}"
            )
            return replace(solved, status=status)
    return solved


def _solve(solve: Solve, task: tuple[Index, Subject]) -> tuple[Index, SolvedGait]:
    index, subject = task
    return index, solve(subject)


def _read_grid(path: Path) -> Grid:
    document = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(document, dict):
        raise ValueError(f"the grid of a library must be a JSON object, got {type(document).__name__}")
    if (found := document.pop("format", None)) != FORMAT:
        raise ValueError(f"format of the grid of a library must be {FORMAT!r}, got {found!r:.80}")
    return Grid(**{name: _levels(name, values) for name, values in document.items()})


def _levels(name: str, values: Any) -> tuple[float, ...]:
    if not isinstance(values, Sequence) or not all(type(value) in (int, float) for value in values):
        raise ValueError(f"{name} must be a list of numbers, got {values!r}")
    return tuple(map(float, values))
