"""Trials of the experiments: `experiment, options -> list of trials`. Each trial has a key.

The key is a hash of two things: the parameters of the trial, and the versions of all software that computes the trial. A stored
result is therefore used again only if a new run would give the same result.
"""

from __future__ import annotations

import ast
import hashlib
import json
import platform
import random
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

from atalante_tools.console.outcome import Failed
from atalante_tools.trial.fault_plan import FaultTrial

if TYPE_CHECKING:
    from atalante_control.model import Patient

#: Numbers of steps in the three parts of a walk: full assistance, changing assistance factor, factor of the trial.
#: A step takes 0.8 s, so the parts take about 90 s, 30 s and 180 s.
PROTOCOL: Final = (112, 38, 225)
QUICK_PROTOCOL: Final = (2, 1, 3)
#: Step of all walks: length [m] and duration [s].
STEP: Final = (0.16, 0.8)
#: Assistance factor of partial assistance.
PARTIAL: Final = 0.5
#: Assistance factors of the sweep in the order of the trials, in a normal run and with `--quick`.
SWEEP: Final = (1.0, 0.75, 0.5, 0.25, 0.0, 0.25, 0.5, 0.75, 1.0)
QUICK_SWEEP: Final = (1.0, 0.5, 0.0, 0.5, 1.0)
#: Number of days in the sweep: in a normal run, with `--quick`. Each day has one trial on the treadmill and several walks.
DAYS, QUICK_DAYS = 3, 1
#: Number of steps in each guide shape, in a normal run and with `--quick`. Only steps with the right leg as stance leg count.
SHAPE_STEPS, QUICK_SHAPE_STEPS = 30, 2
#: Duration of the trial on the treadmill [s].
TREADMILL_TIME: Final = 300
#: Subject of the sweep: mass [kg] and height [m].
SWEEP_SUBJECT: Final = (75.0, 1.75)
#: Masses of the subjects of `assist --quick` [kg].
QUICK_MASSES: Final = (58.0, 75.0)
#: Range of a random ratio in `robustness`: true mass of the patient divided by the mass in the model of the controller.
MASS_SHARE: Final = (0.9, 1.1)
#: Range of the random coefficient of friction between soles and floor in `robustness`.
FRICTION: Final = (0.25, 0.8)
#: Number of delays in `RobustTrial.delay`: of state messages, command messages and motor torques. Each delay is 0 or 1 cycle.
#: Longer delays are not tried, because a drive times out when its last command is five cycles old.
#: If commands are one cycle late, a drive times out after four consecutive lost frames.
#: If commands were two or more cycles late, a drive would time out after even fewer lost frames.
LATE_PARTS: Final = 3
#: Probability with which a frame is lost in `robustness`.
LOSS: Final = 0.01
#: Force of a push in `robustness` [N].
PUSH: Final = 100.0
#: Number of steps per push in `robustness`. The push begins at a random time in the first 70 % of these steps.
PUSH_STEPS: Final = 10
#: Number of trials and number of steps per trial of `robustness`, in a normal run and with `--quick`.
ROBUST, QUICK_ROBUST = (100, 60), (2, 4)
#: Experiment `pushes`: directions [deg], phases, and forces in rising order [N].
PUSH_DIRECTIONS: Final = tuple(22.5 * k for k in range(16))
PUSH_PHASES: Final = tuple(k / 8 for k in range(8))
PUSH_FORCES: Final = tuple(50.0 * k for k in range(1, 11))
QUICK_PUSHES: Final = ((0.0, 90.0), (0.25,), (50.0, 1000.0))
#: Assistance factors of `protocol`.
PROTOCOL_FACTORS: Final = (0.5, 0.0)
_PACKAGES: Final = ("numpy", "numba", "pin", "casadi", "pybullet", "mujoco-core")


@dataclass(frozen=True)
class ShapeTrial:
    """Walk of the empty exoskeleton in the air. The swing leg moves inside one guide shape, and the feedforward is off."""

    kind: ClassVar[str] = "shape"
    shape: str
    steps: int  # number of steps with the right leg as stance leg
    xi: float
    seed: int
    engine: str

    @property
    def name(self) -> str:
        """Return a name that is unique in the experiment."""
        return f"shape-{self.shape}"


#: Kinds of subjects. `KINDS[trial.active]` is the kind of the subject of a trial.
KINDS: Final = "passive", "active"


@dataclass(frozen=True)
class WalkTrial:
    """Walk of a virtual subject on the ground, with the protocol of the paper."""

    kind: ClassVar[str] = "walk"
    mass: float  # mass of the subject [kg]
    height: float  # height of the subject [m]
    active: bool  # whether the muscles of the subject track the gait
    xi: float  # assistance factor in the last part of the walk
    protocol: tuple[
        int, int, int
    ]  # numbers of steps: with factor 1, while the factor falls from 1 to `xi`, and with factor `xi`
    shape: str  # guide shape
    idealization: float
    feedforward: float
    seed: int
    engine: str
    order: str = ""  # position in the sweep, such as "day2-03" for the third walk of day 2; empty in other experiments
    literal: bool = False  # whether the controller uses the control law exactly as the paper prints it
    #: whether the IMUs have a heading reference, such as a magnetometer; the controller uses it to correct the gyro drift
    heading_reference: bool = False
    #: path and SHA-256 of the file of the neural gait network; empty for the network of the package
    network: tuple[str, ...] = ()
    haptics: bool = False  # whether an active subject responds to the vibration motors

    @property
    def name(self) -> str:
        """Return a name that is unique in the experiment."""
        return f"walk{self.order and '-' + self.order}-{self.mass:g}kg-{KINDS[self.active]}-xi{self.xi:g}"


@dataclass(frozen=True)
class RobustTrial:
    """Walk of a robot that differs from its model. The walk has full assistance, lost frames, delays and pushes."""

    kind: ClassVar[str] = "robust"
    number: int
    mass: float  # mass of the patient in the model of the controller [kg]
    height: float  # height of the patient [m]
    mass_share: float  # true mass of the patient divided by `mass`
    friction: float  # coefficient of friction between soles and floor
    delay: tuple[int, int, int]  # cycles by which state messages, command messages and motor torques are late
    loss: float  # probability that a frame is lost, on all buses
    #: time [s] and direction [deg] of each push; the time counts from the start of the first periodic step
    pushes: tuple[tuple[float, float], ...]
    force: float  # force of each push [N]
    steps: int
    seed: int
    engine: str
    #: path and SHA-256 of the file of the neural gait network; empty for the network of the package
    network: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return a name that is unique in the experiment."""
        return f"robust-{self.number:03d}"


@dataclass(frozen=True)
class PushTrial:
    """Walks with full assistance, each with one push at the pelvis. Only the force of the push differs between the walks."""

    kind: ClassVar[str] = "push"
    direction: float  # direction of the push [deg]: 0 is forwards, 90 is to the left
    phase: float  # phase at which the push begins, in a step with the right leg as stance leg
    forces: tuple[float, ...]  # forces of the pushes [N], in rising order
    mass: float  # mass of the wearer [kg]
    height: float  # height of the wearer [m]
    seed: int
    engine: str
    #: path and SHA-256 of the file of the neural gait network; empty for the network of the package
    network: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return a name that is unique in the experiment."""
        return f"push-{self.direction:g}deg-phase{self.phase:g}"


@dataclass(frozen=True)
class TreadmillTrial:
    """Baseline of the sweep: the subject walks on a level treadmill without exoskeleton. The motion is not simulated.

    An equation gives the metabolic rate. The emulated respirometer measures this rate.
    """

    kind: ClassVar[str] = "treadmill"
    mass: float  # mass of the subject [kg]
    speed: float  # walking speed [m/s]
    seconds: int
    seed: int
    order: str

    @property
    def name(self) -> str:
        """Return a name that is unique in the experiment."""
        return f"treadmill-{self.order}-{self.mass:g}kg"


Trial = ShapeTrial | WalkTrial | TreadmillTrial | RobustTrial | PushTrial | FaultTrial


@dataclass(frozen=True)
class WalkSetting:
    """Settings that all walks of an experiment share."""

    protocol: tuple[int, int, int]
    shape: str
    idealization: float
    feedforward: float
    seed: int  # seed of the experiment, from which the seed of each trial is computed
    engine: str
    literal: bool = False
    heading_reference: bool = False
    network: tuple[str, ...] = ()
    haptics: bool = False

    def walk(self, patient: Patient, active: bool, xi: float, index: int, order: str = "") -> WalkTrial:
        """Return the walk of one subject with these settings.

        Args:
            patient: mass and height of the subject.
            active: whether the subject is active.
            xi: assistance factor in the last part of the walk.
            index: number of the trial in the experiment.
            order: position in the sweep, such as "day2-03".
        """
        return WalkTrial(
            patient.mass, patient.height, active, xi, self.protocol, self.shape, self.idealization, self.feedforward,
            1000 * self.seed + index, self.engine, order, self.literal, self.heading_reference, self.network,
            self.haptics and active,
        )  # fmt: skip


def network_of(path: Path) -> tuple[str, str]:
    """Return path and SHA-256 of a network file. Both are part of a trial, so a changed file leads to a new trial.

    Args:
        path: path of the file.

    Raises:
        Failed: If the file cannot be read.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise Failed(f"{path} cannot be read: {error.strerror}") from error
    return str(path.resolve()), hashlib.sha256(content).hexdigest()


def shape_trials(names: Sequence[str], steps: int, xi: float, seed: int, engine: str) -> list[Trial]:
    """Return one trial for each guide shape.

    Args:
        names: names of the shapes.
        steps: number of steps with the right leg as stance leg in each trial.
        xi: assistance factor.
        seed: seed of the sensor noise.
        engine: name of the physics engine.
    """
    return [ShapeTrial(name, steps, xi, seed, engine) for name in names]


def assist_trials(setting: WalkSetting, masses: Sequence[float] = ()) -> list[Trial]:
    """Return four trials for each subject: passive and active, with full and with partial assistance.

    Args:
        setting: settings that all walks share.
        masses: masses of the subjects [kg]; empty means all eight subjects.
    """
    return protocol_trials(setting, (1.0, PARTIAL), masses)


def sweep_trials(setting: WalkSetting, factors: Sequence[float], days: int) -> list[Trial]:
    """Return the trials of the sweep. Each day has one treadmill trial, and one walk of an active subject per item of `factors`.

    Args:
        setting: settings that all walks share.
        factors: assistance factors in the order of the walks. The same factor may occur twice, for example 1, 0.5, 0, 0.5, 1.
        days: number of days. Only the seeds differ between the days.
    """
    from atalante_control.model import Patient

    patient, trials, speed = Patient(*SWEEP_SUBJECT), list[Trial](), STEP[0] / STEP[1]
    for day in range(days):
        first = 100 + 20 * day
        trials.append(TreadmillTrial(patient.mass, speed, TREADMILL_TIME, 1000 * setting.seed + first, f"day{day + 1}"))
        trials += [
            setting.walk(patient, True, xi, first + 1 + k, f"day{day + 1}-{k + 1:02d}") for k, xi in enumerate(factors)
        ]
    return trials


def protocol_trials(
    setting: WalkSetting, factors: Sequence[float], masses: Sequence[float] = (), kinds: Sequence[str] = KINDS
) -> list[Trial]:
    """Return a trial for each combination of subject, kind (passive or active) and assistance factor.

    Args:
        setting: settings that all walks share.
        factors: assistance factors in the last part of the walks.
        masses: masses of the subjects [kg]; empty means all eight subjects.
        kinds: one or both of `KINDS`. The seed of a trial does not depend on this choice.
    """
    from atalante_control.gait.subject import STUDY_PATIENTS

    conditions = [(active, xi) for active in (False, True) for xi in factors]
    return [
        setting.walk(patient, active, xi, len(conditions) * number + index)
        for number, patient in enumerate(STUDY_PATIENTS)
        for index, (active, xi) in enumerate(conditions)
        if (not masses or patient.mass in masses) and KINDS[active] in kinds
    ]


def robust_trials(count: int, steps: int, seed: int, engine: str, network: tuple[str, ...] = ()) -> list[Trial]:
    """Return trials with random patients, mass errors, friction, delay and pushes.

    Args:
        count: number of trials.
        steps: number of periodic steps in each trial.
        seed: seed of the experiment.
        engine: name of the physics engine.
        network: result of `network_of`; empty for the network of the package.
    """
    from atalante_control.gait.subject import STUDY_PATIENTS

    trials: list[Trial] = []
    for number in range(count):
        draw = random.Random(f"{seed}/{number}")
        patient = draw.choice(STUDY_PATIENTS)
        slots, interval = max(1, steps // PUSH_STEPS), min(PUSH_STEPS, steps) * STEP[1]
        pushes = tuple(
            (round((k + 0.7 * draw.random()) * interval, 3), round(draw.uniform(-180.0, 180.0), 1))
            for k in range(slots)
        )
        trials.append(
            RobustTrial(
                number, patient.mass, patient.height, round(draw.uniform(*MASS_SHARE), 4), round(draw.uniform(*FRICTION), 3),
                _delay(draw), LOSS, pushes, PUSH, steps, 1000 * seed + number, engine, network,
            )
        )  # fmt: skip
    return trials


def _delay(draw: random.Random) -> tuple[int, int, int]:
    """Return random delays of the state messages, the command messages and the motors, 0 or 1 each [cycles].

    The sum is uniformly distributed from 0 to `LATE_PARTS`.

    Args:
        draw: source of the random numbers.
    """
    late = draw.sample(range(LATE_PARTS), draw.randint(0, LATE_PARTS))
    state, command, motor = (int(part in late) for part in range(LATE_PARTS))
    return state, command, motor


def push_trials(
    directions: Sequence[float],
    phases: Sequence[float],
    forces: Sequence[float],
    seed: int,
    engine: str,
    network: tuple[str, ...] = (),
) -> list[Trial]:
    """Return one trial for each direction and phase of a push.

    Args:
        directions: directions of the pushes [deg].
        phases: phases at which the pushes begin, in a step with the right leg as stance leg.
        forces: forces in rising order [N].
        seed: seed of the sensor noise.
        engine: name of the physics engine.
        network: result of `network_of`; empty for the network of the package.
    """
    return [
        PushTrial(direction, phase, tuple(forces), *SWEEP_SUBJECT, seed, engine, network)
        for direction in directions
        for phase in phases
    ]


@cache
def versions() -> dict[str, str]:
    """Describe the software and the machine that compute a trial.

    Returns:
        Versions of Python, of this project and of the packages in `_PACKAGES`, by name. The key "source" has a hash of the source
        code, and the key "machine" has the processor architecture and byte order.
    """
    import atalante_tools.session

    folder = Path(__file__).parent
    session = Path(next(iter(atalante_tools.session.__path__)))
    source = source_hash([*_roots(), session, folder], [folder / name for name in _REPORTING])
    found = {"python": platform.python_version(), "atalante-hal": version("atalante-hal"), "source": source}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return {**found, "machine": f"{platform.machine()} {sys.byteorder}"}


def key(trial: Trial) -> str:
    """Return the key of a trial: a hash of its kind, its parameters and all software versions (`versions`).

    Args:
        trial: trial to identify.
    """
    content = {"kind": trial.kind, "parameters": asdict(trial), "versions": versions()}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


#: Files of this package that do not affect the results.
_REPORTING: Final = (
    "__init__.py", "findings.py", "fault_findings.py", "fault_table.py", "figures.py", "report.py", "store.py",
)  # fmt: skip


def _roots() -> list[Path]:
    """Return the folders of the packages that a trial uses, except the folders of the tools."""
    import atalante_control
    import atalante_dbc
    import atalante_emulator
    import atalante_hal

    packages = (atalante_control, atalante_dbc, atalante_emulator, atalante_hal)
    return [Path(next(iter(package.__path__))) for package in packages]


def source_hash(roots: Sequence[Path], ignored: Sequence[Path] = ()) -> str:
    """Return a hash of the syntax trees of all Python files, and of all data files.

    Args:
        roots: folders of the files. Byte code and Markdown files are ignored.
        ignored: further files to ignore.
    """
    digest = hashlib.sha256()
    for root in roots:
        for file in sorted(root.rglob("*")):
            if file.is_file() and file.suffix not in (".pyc", ".md") and file not in ignored:
                digest.update(str(file.relative_to(root)).encode() + b"\0" + _content(file))
    return digest.hexdigest()[:16]


def _content(file: Path) -> bytes:
    """Return the part of a file that can change a result: all bytes; for a Python file, the syntax tree without docstrings."""
    if file.suffix != ".py":
        return file.read_bytes()
    tree = ast.parse(file.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node) is not None:
            del node.body[0]
    return ast.dump(tree).encode()


def fields(trial: Trial) -> dict[str, Any]:
    """Return kind, name and parameters of a trial as a JSON object.

    Args:
        trial: trial to describe.
    """
    return {"kind": trial.kind, "name": trial.name, **asdict(trial)}
