"""Library of gaits, one gait for each subject of a grid. The gaits are solved in parallel, and the computation can be resumed.

`Grid, solve -> one file for each gait`. `atalante_control.gait_optimization.fit` reads the files. The gait of another
patient is never the initial guess. A gait therefore depends only on the parameters of its own subject. Other gaits, the
number of processes and interruptions have no effect. The small error of the fit shows that the optimiser finds similar
local minima for similar subjects. Failures are recorded in files.

A file counts as a solved gait only if four conditions hold: the content matches the stored checksum, the parameters
match the subject, the status is `solved`, and the stored code version is the installed version. Any other file is
rejected with a reason, and its gait is solved again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import count, pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from atalante_control.dynamics.gait_network import INPUTS, subject_of
from atalante_control.gait.gait import Gait, GaitError, check_gait, gait_from, read_object, write_gait, write_object
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.parallel import LostProcessError, fan_out
from atalante_control.gait_optimization.result import SOLVED, SolvedGait
from atalante_control.gait_optimization.second_start import solve_with_second_start, with_status
from atalante_control.gait_optimization.solve import code_version, solve
from atalante_control.gait_optimization.verify import Verifier
from atalante_hal.robot import Robot, load_robot

FORMAT = "atalante-library/2"
_ROOT_ITERATIONS = 60  # number of iterations that compute the constant g in `Grid.points`
LEVELS_MIN = 3  # smallest number of levels of a parameter; with 2 levels, the joint angles of the network are wrong by 10 degrees

#: Point of the grid, given by the index of the level of each parameter.
Index = tuple[int, ...]
#: Function that solves one gait. It must be defined at module level, because other processes import it.
Solve = Callable[[Subject], SolvedGait]


class LibraryError(ValueError):
    """Missing or invalid gait library, or gait library for another grid. The message states the file or folder."""


@dataclass(frozen=True)
class Grid:
    """Grid of subjects, and selection of the subjects for which the library contains a gait.

    Each parameter has a list of values in ascending order, called levels. A point of the grid is one combination of levels.
    The default levels cover the subjects of the paper (58 to 91 kg, 1.62 to 1.93 m). A grid of six parameters has too many
    points to solve all of them. Therefore the library contains `size` points: all combinations of smallest and largest levels,
    and points of a low-discrepancy sequence, which fills the grid evenly. A larger `size` only adds points.

    Raises:
        ValueError: If there are fewer than three levels, levels are not ascending, the size is too small, or a subject is out of
            range.
    """

    mass: tuple[float, ...] = (58.0, 65.0, 74.0, 84.0, 91.0)  # kg, mass of the patient
    height: tuple[float, ...] = (1.62, 1.69, 1.775, 1.86, 1.93)  # m, height of the patient
    step_length: tuple[float, ...] = (0.10, 0.12, 0.15, 0.18, 0.20)  # m, step length
    step_duration: tuple[float, ...] = (0.7, 0.74, 0.8, 0.88, 0.97, 1.05, 1.1)  # s, step duration
    thigh: tuple[float, ...] = (0.94, 0.965, 1.0, 1.035, 1.06)  # length of the thigh relative to Winter's table
    shank: tuple[float, ...] = (0.94, 0.965, 1.0, 1.035, 1.06)  # length of the shank relative to Winter's table
    size: int = 1000  # number of selected points; if the grid has fewer points, all points are selected

    def __post_init__(self) -> None:
        for name, levels in zip(self.names(), self.axes(), strict=True):
            if len(levels) < LEVELS_MIN:
                raise ValueError(f"{name} must have at least {LEVELS_MIN} levels, got {list(levels)}")
            if not all(a < b for a, b in pairwise(levels)):
                raise ValueError(f"levels of {name} must be in ascending order, got {list(levels)}")
            if len({f"{level:g}" for level in levels}) < len(levels):
                raise ValueError(f"levels of {name} must differ after rounding to 6 digits, got {list(levels)}")
        corners = self._corners()
        if self.size < len(corners):
            raise ValueError(
                f"size must be at least {len(corners)}, the number of corners of the grid, got {self.size}"
            )
        for index in corners:
            self.subject(index)
        # A step duration between two valid ones can be invalid, because it must be a whole number of milliseconds.
        for level in range(len(self.step_duration)):
            self.subject(tuple(level * (name == "step_duration") for name in self.names()))

    @staticmethod
    def names() -> tuple[str, ...]:
        """Return the names of the parameters, in the order of the inputs of the network (INPUTS)."""
        return tuple(INPUTS)

    def axes(self) -> tuple[tuple[float, ...], ...]:
        """Return the levels of each parameter, in the order of `names`."""
        return tuple(getattr(self, name) for name in self.names())

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the number of levels of each parameter, in the order of `names`."""
        return tuple(map(len, self.axes()))

    def subject(self, index: Index) -> Subject:
        """Return the subject at a point of the grid.

        Args:
            index: index of the level of each parameter.
        """
        return subject_of([levels[i] for levels, i in zip(self.axes(), index, strict=True)])

    def points(self) -> list[Index]:
        """Return the indices of the selected points."""
        shape = np.array(self.shape)
        if math.prod(self.shape) <= self.size:
            return list(product(*map(range, self.shape)))
        # Point n of the sequence has the coordinates (0.5 + n g^-i) mod 1 for i = 1 to d (additive recurrence sequence).
        # d is the number of parameters, and g is the positive root of g^(d + 1) = g + 1. For d = 1, g is the golden ratio.
        root = 2.0
        for _ in range(_ROOT_ITERATIONS):
            root = (1.0 + root) ** (1.0 / (len(shape) + 1))
        rates = root ** -np.arange(1.0, len(shape) + 1.0)
        selected, steps = dict.fromkeys(self._corners()), count()
        while len(selected) < self.size:
            selected.setdefault(tuple(((0.5 + next(steps) * rates) % 1.0 * shape).astype(int).tolist()))
        return list(selected)

    def _corners(self) -> list[Index]:
        return list(product(*((0, levels - 1) for levels in self.shape)))


class Library:
    """Library in a folder: `grid.json`, `gaits/` with one file per gait, and `failed/` with one file per failed gait."""

    def __init__(self, folder: Path, grid: Grid | None = None) -> None:
        """Open a library, or create it.

        Args:
            folder: folder of the library.
            grid: required grid, or None to accept the grid that is stored in the folder.

        Raises:
            LibraryError: If the folder has no library and no grid is given, if the library has another grid, or if the file
                `grid.json` cannot be read or is invalid.
        """
        self.folder = folder
        path = folder / "grid.json"
        try:
            found = _read_grid(path) if path.exists() else None
        except OSError as error:
            raise LibraryError(f"{path} cannot be read: {error.strerror}") from error
        except (TypeError, ValueError, OverflowError, RecursionError) as error:
            raise LibraryError(f"{path}: {error}") from error
        if found is None:
            if grid is None:
                raise LibraryError(
                    f"{folder} contains no library: create it with `atalante gait library --out {folder}`"
                )
            self._make_folders()
            write_object({"format": FORMAT, **asdict(grid)}, path)
        elif grid is not None and grid != found:
            raise LibraryError(
                f"grid of the library in {folder} must be {grid}, got {found}: choose another folder or grid"
            )
        self.grid = grid or found or Grid()

    def gait(self, index: Index) -> Gait | None:
        """Return the gait of a grid point, or None if there is no file. The limits of the robot are not checked here.

        Args:
            index: index of the level of each parameter.

        Raises:
            GaitError: If the file is not valid, if its content was changed after writing, or if it was made for another
                subject or by another version of the code.
        """
        path = self._path("gaits", index)
        if not path.exists():
            return None
        gait = gait_from(read_object(path), str(path))
        subject, record = self.grid.subject(index), gait.solver
        expected: dict[str, tuple[object, object]] = {
            "parameters": (subject.parameters(), dict(gait.parameters)),
            "solver.status": (SOLVED, record.get("status")),
            "solver.version": (code_version(), record.get("version")),
            "solver.checksum": (gait.hash32, record.get("checksum")),
        }
        for key, (wanted, found) in expected.items():
            if found != wanted:
                raise GaitError(f"{path}: {key} must be {wanted!r}, got {found!r:.200}")
        return gait

    def gaits(self, robot: Robot) -> dict[Index, Gait]:
        """Return all solved gaits of the library. Rejected files are left out, see `rejected`.

        Args:
            robot: limits of the joints.

        Raises:
            GaitError: If a solved gait exceeds a limit of the robot.
        """
        gaits, _ = self._read()
        for index, gait in gaits.items():
            check_gait(gait, robot, str(self._path("gaits", index)))
        return gaits

    def rejected(self) -> dict[Index, str]:
        """Return the reason of the rejection for each grid point whose gait file is rejected.

        `generate` solves the gaits of these grid points again.
        """
        return self._read()[1]

    def failures(self) -> dict[Index, str]:
        """Return the reason of the last failure for each grid point that failed and is not solved."""
        found = {}
        for index in self.missing():
            path = self._path("failed", index)
            if path.exists():
                found[index] = _status(path)
        return found

    def missing(self) -> list[Index]:
        """Return the grid points without a solved gait."""
        gaits, _ = self._read()
        return [index for index in self.grid.points() if index not in gaits]

    def generate(
        self,
        solve: Solve,
        *,
        jobs: int = 1,
        cluster: str | None = None,
        on_lost: Callable[[str], None] | None = None,
    ) -> Generator[tuple[Subject, SolvedGait], None, None]:
        """Solve the missing gaits, and yield each result after it is written to disk.

        Args:
            solve: function that solves one gait, defined at module level.
            jobs: number of processes on this computer.
            cluster: address of a dask scheduler; its workers are used instead of processes on this computer.
            on_lost: function called with a message when a process has ended unexpectedly, see `fan_out`.

        Raises:
            FanOutError: If the calls cannot be distributed, see `fan_out`. If processes ended unexpectedly, the gaits without a
                result are recorded as failures.
        """
        self._make_folders()
        waiting = {index: self.grid.subject(index) for index in self.missing()}
        tasks = list(waiting.items())
        try:
            for index, solved in fan_out(partial(_solve, solve), tasks, jobs=jobs, cluster=cluster, on_lost=on_lost):
                self._keep(index, solved)
                yield waiting.pop(index), solved
        except LostProcessError as error:
            for index, subject in waiting.items():
                self._keep_failure(index, f"no result for {subject}: {error}", subject.parameters(), {})
            raise

    def _make_folders(self) -> None:
        """Create the folders `gaits/` and `failed/` if they are missing, because git does not store empty folders."""
        for name in ("gaits", "failed"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)

    def _read(self) -> tuple[dict[Index, Gait], dict[Index, str]]:
        """Return the solved gaits, and for each rejected file the reason of the rejection."""
        gaits, rejected = dict[Index, Gait](), dict[Index, str]()
        for index in self.grid.points():
            try:
                gait = self.gait(index)
            except GaitError as error:
                rejected[index] = str(error)
            else:
                if gait is not None:
                    gaits[index] = gait
        return gaits, rejected

    def _path(self, kind: str, index: Index) -> Path:
        levels = (axis[i] for axis, i in zip(self.grid.axes(), index, strict=True))
        return (
            self.folder
            / kind
            / ("_".join(f"{letter}{v:g}" for letter, v in zip("mhldts", levels, strict=True)) + ".json")
        )

    def _keep(self, index: Index, solved: SolvedGait) -> None:
        if solved.solved:
            record = {**solved.gait.solver, "checksum": solved.gait.hash32}
            write_gait(replace(solved.gait, solver=record), self._path("gaits", index))
            self._path("failed", index).unlink(missing_ok=True)
        else:
            self._keep_failure(index, solved.status, solved.gait.parameters, solved.gait.solver)

    def _keep_failure(
        self, index: Index, status: str, parameters: Mapping[str, float], solver: Mapping[str, Any]
    ) -> None:
        record = {"status": status, "parameters": dict(parameters), "solver": dict(solver)}
        write_object(record, self._path("failed", index))


def solve_subject(subject: Subject) -> SolvedGait:
    """Solve the gait of a subject, and verify the gait with Pinocchio.

    If this fails, solve the gait a second time, from another initial guess, see `solve_with_second_start`.

    Args:
        subject: patient and step parameters.
    """
    return solve_with_second_start(subject, _solve_and_verify)


def solve_compiled(subject: Subject) -> SolvedGait:
    """Solve and verify the gait of a subject with compiled functions. The result is the same as with `solve_subject`.

    The functions are compiled once per computer. The computation of a gait then takes half the time.

    Args:
        subject: patient and step parameters.
    """
    return solve_with_second_start(subject, partial(_solve_and_verify, machine_code=True))


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
            return with_status(solved, status)
    return solved


def _solve_and_verify(subject: Subject, warm_start: Gait | None, machine_code: bool = False) -> SolvedGait:
    return verified(subject, solve(subject, warm_start, machine_code=machine_code))


def _solve(solve: Solve, task: tuple[Index, Subject]) -> tuple[Index, SolvedGait]:
    index, subject = task
    return index, solve(subject)


def _status(path: Path) -> str:
    """Return why a gait is not solved, as stated in its file in `failed/`. If the file is damaged, return the read error."""
    try:
        return str(read_object(path)["status"])
    except GaitError as error:
        return str(error)
    except KeyError:
        return f"{path}: status is missing"


def _read_grid(path: Path) -> Grid:
    document = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(document, dict):
        raise ValueError(f"the grid of a library must be a JSON object, got {type(document).__name__}")
    if (found := document.pop("format", None)) != FORMAT:
        raise ValueError(f"format must be {FORMAT!r}, got {found!r:.80}")
    size = document.pop("size", None)
    if type(size) is not int:
        raise ValueError(f"size must be an integer, got {size!r}")
    return Grid(size=size, **{name: _levels(name, values) for name, values in document.items()})


def _levels(name: str, values: Any) -> tuple[float, ...]:
    if not isinstance(values, Sequence) or not all(type(value) in (int, float) for value in values):
        raise ValueError(f"{name} must be a list of numbers, got {values!r}")
    return tuple(map(float, values))
