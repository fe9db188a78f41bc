"""Command-line options that several commands share: bus, clock, output format and patient."""

from __future__ import annotations

import functools
import inspect
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from atalante_tools.console.outcome import InvalidUsage

if TYPE_CHECKING:
    from atalante_control.gait.subject import Subject
    from atalante_control.model import Patient

_Command = TypeVar("_Command", bound=Callable[..., Any])

EMBEDDED: Final = "embedded"
#: Physics engines of the emulated robot, as in `atalante_emulator.bodies.ENGINES`. The first one is the default.
PYBULLET, MUJOCO = ENGINES = ("pybullet", "mujoco")
#: Option `--engine`.
engine_option = click.option(
    "--engine",
    type=click.Choice(ENGINES),
    default=PYBULLET,
    show_default=True,
    help="Physics engine of the emulated robot. MuJoCo runs on every supported version of Python.",
)
#: Option `--json`. JSON objects go to stdout, all other text goes to stderr.
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON objects on stdout, one per line.")

#: Option `--jobs`: number of processes on this computer.
jobs_option = click.option(
    "--jobs",
    type=click.IntRange(1),
    default=os.cpu_count() or 1,
    show_default="number of cores",
    metavar="N",
    help="Number of parallel processes.",
)
#: Option `--dask`: address of a dask scheduler; empty for processes on this computer.
dask_option = click.option(
    "--dask",
    default="",
    metavar="ADDRESS",
    help="Run on the workers of this dask scheduler, such as tcp://127.0.0.1:8786.",
)

#: Option `--network`: file of the neural network that computes the gaits.
network_option = click.option(
    "--network",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="File of a neural gait network, as written by `atalante gait fit`.  [default: the installed gait network]",
)

#: Option type for a seed of random numbers.
SEED: Final = click.IntRange(min=0)


class Between(click.FloatRange):
    """Option type for a number in a range. NaN is rejected."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert the option value to a number and return it.

        Raises:
            click.BadParameter: If the value is not a number, is NaN or is out of range.
        """
        number = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail("must be a number, got nan", param, ctx)
        return number


def require_writable(folder: Path) -> None:
    """Check that a file can be created in an existing folder.

    Args:
        folder: Folder of the file.

    Raises:
        OSError: If no file can be created. The error contains the path of the folder and the reason.
    """
    from tempfile import TemporaryFile

    try:
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from error


class OutputFile(click.Path):
    """Option type for an output file in an existing folder. The suffix of the file must be one of the allowed suffixes.

    An invalid path is rejected before the command starts its work.
    """

    def __init__(self, *suffixes: str) -> None:
        super().__init__(dir_okay=False, readable=False, writable=True)
        self._suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert the option value to a path and return it.

        Raises:
            click.BadParameter: If the suffix is not allowed, the folder does not exist, or the file cannot be written.
        """
        path = Path(str(super().convert(value, param, ctx)))
        if self._suffixes and path.suffix.lower() not in self._suffixes:
            self.fail(f"must end in {' or '.join(self._suffixes)}, got {path}", param, ctx)
        if not path.parent.is_dir():
            self.fail(f"must be in an existing folder, got {path}: create the folder {path.parent}", param, ctx)
        try:
            require_writable(path.parent)
        except OSError as error:
            self.fail(f"must be in a writable folder, got {path}: {error.strerror}", param, ctx)
        return path


#: Smallest number that is read as a length in centimetres. A smaller number is read as metres: 175 is 175 cm, 1.75 is 1.75 m.
_CENTIMETRES: Final = 5.0

#: Default step length [m] and default step duration [s] of a patient.
DEFAULT_STEP: Final = (0.15, 0.9)


def length(text: str) -> float:
    """Convert the text of a length option to metres. For example, 1.75 and 175 both give 1.75 m.

    Args:
        text: Length of a body part or a step. Numbers below 5 are metres, other numbers are centimetres.

    Raises:
        click.BadParameter: If the text is not a number.
    """
    try:
        metres = float(text)
    except ValueError:
        raise click.BadParameter(f"must be a length in metres (1.75) or centimetres (175), got {text!r}") from None
    return metres / 100.0 if metres >= _CENTIMETRES else metres


def options_as(
    name: str, meaning: Callable[..., object], options: Sequence[Callable[[Any], Any]]
) -> Callable[[_Command], _Command]:
    """Return a decorator that adds several options to a command. The command receives the option values as one argument.

    Args:
        name: Name of the argument of the command.
        meaning: Function that computes the argument from the option values. Its parameters have the names of the options.
        options: Click options, or decorators that an earlier call of this function returned. The help text lists the options
            in this order.
    """
    parameters = inspect.signature(meaning).parameters

    def decorate(command: _Command) -> _Command:
        @functools.wraps(command)
        def with_value(**arguments: Any) -> Any:
            value = meaning(**{key: arguments.pop(key) for key in parameters if key in arguments})
            return command(**{name: value}, **arguments)

        decorated: Any = with_value
        for option in reversed(options):
            decorated = option(decorated)
        result: _Command = decorated
        return result

    return decorate


def _segment_option(name: str, ends: str) -> Callable[[Any], Any]:
    return click.option(
        f"--{name}",
        type=length,
        metavar="M",
        help=f"Distance from {ends} of the patient, in m (0.43) or cm (43).  "
        "[default: estimated from the height with Winter's anthropometric table]",
    )


@dataclass(frozen=True)
class GaitFiles:
    """Gait file and network file of a command. The user gives at most one of the two files."""

    gait: Path | None = None  # gait file or walk file
    network: Path | None = None  # file of a neural gait network; None means the file installed with `atalante_control`

    @property
    def arguments(self) -> str:
        """Return the options `--gait` and `--network` as text for the command line of another `atalante` command."""
        return "".join(f" --{name} {path}" for name, path in (("gait", self.gait), ("network", self.network)) if path)

    def require_patient(self, patient: object) -> None:
        """Raise an error if the user gives the option `--network` (gait network) without a patient.

        Args:
            patient: Patient or subject that the user gave, or None.

        Raises:
            click.UsageError: If `--network` is given and `patient` is None.
        """
        if self.network is not None and patient is None:
            raise click.UsageError("--network requires a patient: add --mass and --height")


def typed(name: str) -> bool:
    """Return whether the user typed an option of the current command.

    Args:
        name: Name of the option as a parameter of the command, such as "push_direction".
    """
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE


def _gait_files(gait: Path | None, network: Path | None) -> GaitFiles:
    if gait is not None and network is not None:
        raise click.UsageError("--gait and --network exclude each other: use only one of them")
    for name in ("step_length", "step_duration"):
        if gait is not None and typed(name):
            raise click.UsageError(
                f"--{name.replace('_', '-')} has no effect with --gait, because the gait file contains length and duration "
                f"of the step: omit --{name.replace('_', '-')} or --gait"
            )
    return GaitFiles(gait, network)


def gait_options(command: _Command) -> _Command:
    """Add the options `--gait` and `--network` to a command. The command function receives both values in its argument `files`.

    Args:
        command: Command to decorate.
    """
    file = click.Path(path_type=Path, dir_okay=False)
    options = [
        click.option(
            "--gait",
            type=file,
            metavar="FILE",
            help="Gait file or walk file of `atalante gait solve`. Without --mass and --height, the file also gives the patient.",
        ),
        network_option,
    ]
    return options_as("files", _gait_files, options)(command)


def patient_options(command: _Command) -> _Command:
    """Add `--mass`, `--height`, `--thigh` and `--shank` to a command, which then gets the argument `patient`.

    `patient` is None if the user gave none of the options.

    Args:
        command: Command to decorate.
    """
    options = [
        click.option("--mass", type=float, metavar="KG", help="Body mass of the patient [kg]."),
        click.option("--height", type=length, metavar="M", help="Body height of the patient, in m (1.75) or cm (175)."),
        _segment_option("thigh", "hip to knee"),
        _segment_option("shank", "knee to ankle"),
    ]
    return options_as("patient", _patient, options)(command)


def patient_arguments(patient: Patient) -> str:
    """Return the options of a patient as text for the command line of another `atalante` command.

    Args:
        patient: Patient that the user gave.
    """
    given = {
        "mass": patient.mass,
        "height": patient.height,
        "thigh": patient.thigh_length,
        "shank": patient.shank_length,
    }
    return " ".join(f"--{name} {value:g}" for name, value in given.items() if value is not None)


def subject_options(command: _Command) -> _Command:
    """Add the patient options, and `--step-length` and `--step-duration`, to a command. The command gets the argument `subject`.

    `subject` is None if the user gave none of the options.

    Args:
        command: Command to decorate.
    """
    step_length, step_duration = DEFAULT_STEP
    options = [
        patient_options,
        click.option(
            "--step-length",
            type=length,
            metavar="M",
            help=f"Step length of the patient's gait, in m (0.15) or cm (15).  [default: {step_length:g} m]",
        ),
        click.option(
            "--step-duration",
            type=float,
            metavar="S",
            help=f"Step duration of the patient's gait [s].  [default: {step_duration:g} s]",
        ),
    ]
    return options_as("subject", _subject, options)(command)


def _subject(patient: Patient | None, step_length: float | None, step_duration: float | None) -> Subject | None:
    if patient is None:
        if step_length is not None or step_duration is not None:
            raise click.UsageError("--step-length and --step-duration require a patient: add --mass and --height")
        return None
    from atalante_control.gait.subject import Subject

    default_length, default_duration = DEFAULT_STEP
    try:
        return Subject(
            patient,
            default_length if step_length is None else step_length,
            default_duration if step_duration is None else step_duration,
        )
    except ValueError as error:
        raise click.UsageError(str(error)) from error


def _patient(
    mass: float | None, height: float | None, thigh: float | None = None, shank: float | None = None
) -> Patient | None:
    if mass is None and height is None and thigh is None and shank is None:
        return None
    if mass is None or height is None:
        raise click.UsageError("a patient requires both --mass and --height")
    from atalante_control.model import Patient

    try:
        return Patient(mass, height, thigh, shank)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


@dataclass(frozen=True)
class Target:
    """Bus and clock of a run. The bus is a CAN interface, or `embedded` for an emulated robot without a CAN bus."""

    interface: str
    channel: str  # one channel, or a channel map of the four buses. Empty for the embedded robot.
    #: True: a cycle ends when all nodes have answered (lock-step). False: a cycle takes 1 ms (wall clock).
    lockstep: bool
    engine: str = PYBULLET  # physics engine of the embedded robot

    @property
    def embedded(self) -> bool:
        """Return whether the robot is emulated inside the command itself, without a CAN bus."""
        return self.interface == EMBEDDED

    def __str__(self) -> str:
        """Return the interface and the channel as the user typed them."""
        return self.interface if self.embedded else f"{self.interface} {self.channel}"

    @property
    def arguments(self) -> str:
        """Return the options `-i` and `-c` of this bus as text for the command line of another `atalante` command."""
        return f"-i {self.interface} -c {self.channel}"


def target_of(arguments: Sequence[str]) -> Target:
    """Return the bus and the clock of a program with the arguments `[INTERFACE CHANNEL]`.

    Without arguments, the robot is embedded and the clock is lock-step. On a CAN bus, the clock is the wall clock.

    Args:
        arguments: Arguments of the program, for example `sys.argv[1:]`.

    Raises:
        InvalidUsage: If the number of arguments is wrong, or if the interface cannot connect HAL and robot.
    """
    from atalante_hal.bus.adapters import refusal

    if not arguments:
        return Target(EMBEDDED, "", lockstep=True)
    if len(arguments) != 2 or EMBEDDED in arguments or not all(arguments):
        raise InvalidUsage(
            f"the arguments must be a CAN interface and a channel, such as socketcan vcan0, got {' '.join(arguments)!r}"
        )
    interface, channel = arguments
    if refused := refusal(interface):
        raise InvalidUsage(refused)
    return Target(interface, channel, lockstep=False)


def target_options(*, embedded: bool, clock: bool = True) -> Callable[[_Command], _Command]:
    """Return a decorator that adds `-i`, `-c` and `--lockstep/--wall`. The command gets their values as the argument `target`.

    Args:
        embedded: Whether to allow the embedded robot, which is then the default.
        clock: Whether to add `--lockstep/--wall`.
    """
    options = [
        click.option(
            "-i",
            "--interface",
            default=EMBEDDED if embedded else "socketcan",
            show_default=True,
            metavar="NAME",
            help="CAN FD interface by its name in python-can, for example socketcan, pcan or kvaser; see atalante doctor -i NAME."
            + (" With embedded, the command itself emulates the robot." if embedded else ""),
        ),
        click.option(
            "-c",
            "--channel",
            default="",
            metavar="CHANNEL",
            help="CAN channel of all four buses (vcan0), or one channel per bus "
            "(left_leg=can0,right_leg=can1,left_sense=can2,right_sense=can3).",
        ),
    ]
    if embedded:
        options.append(engine_option)
    if clock:
        default = "lock-step when embedded, else wall" if embedded else "wall"
        options.append(
            click.option(
                "--lockstep/--wall",
                default=None,
                help="With --lockstep, a cycle ends after the answers of all nodes (for slow computers). "
                f"With --wall, a cycle takes 1 ms.  [default: {default}]",
            )
        )

    return options_as("target", functools.partial(_target, embedded=embedded), options)


def _refusal(interface: str) -> str:
    from atalante_hal.bus.adapters import ADAPTERS, refusal

    # An unknown name may be an interface of a python-can plug-in. `open_bus` raises an error if there is no such interface.
    return refusal(interface) if interface in ADAPTERS else ""


def _target(
    interface: str, channel: str, lockstep: bool | None = None, engine: str = PYBULLET, *, embedded: bool
) -> Target:
    if interface == EMBEDDED:
        if not embedded:
            raise click.UsageError(
                "this command requires a CAN bus, got -i embedded: use for example -i socketcan -c vcan0"
            )
        if channel:
            raise click.UsageError(
                f"the embedded robot has no channel; to use {channel}, type -i socketcan -c {channel}"
            )
    elif refused := _refusal(interface):
        raise click.UsageError(refused)
    elif not channel:
        raise click.UsageError(f"{interface} requires a channel: -c vcan0, or a channel map of the four buses")
    elif embedded and (name := next(filter(typed, ("engine", "seed")), None)):
        raise click.UsageError(f"--{name} requires the emulated robot of -i embedded")
    return Target(interface, channel, interface == EMBEDDED if lockstep is None else lockstep, engine)
