"""Options the commands share: which bus, which clock, what output. `-i` and `-c` are python-can's names."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

if TYPE_CHECKING:
    from atalante_control.gait.subject import Subject
    from atalante_control.model import Patient

_Command = TypeVar("_Command", bound=Callable[..., Any])

EMBEDDED: Final = "embedded"
#: Interfaces of python-can that do not join processes as a wire does, and why.
NO_WIRE: Final = {
    "virtual": "stays inside one process",
    "udp_multicast": "hands every sender its own frames, which a HAL takes for another HAL's",
}

#: --json: one object a line on stdout, everything else on stderr.
json_option = click.option("--json", "as_json", is_flag=True, help="JSON objects on stdout, one a line.")

#: Of random numbers: an option's type.
SEED: Final = click.IntRange(min=0)


class Between(click.FloatRange):
    """A number in a range, which nan is not: an option's type."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number."""
        number = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail("nan is not a number", param, ctx)
        return number


class OutputFile(click.Path):
    """A file to be written, of a kind that its suffix names: an option's type. What cannot be is told before the work."""

    def __init__(self, *suffixes: str) -> None:
        super().__init__(dir_okay=False)
        self._suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path."""
        path = Path(str(super().convert(value, param, ctx)))
        if self._suffixes and path.suffix.lower() not in self._suffixes:
            self.fail(f"{path} must end in {' or '.join(self._suffixes)}", param, ctx)
        if not path.parent.is_dir():
            self.fail(f"there is no folder {path.parent} for {path.name}", param, ctx)
        return path


#: From here on a length means centimetres: nobody is 5 m tall, and no thigh or step is under 5 cm.
_CENTIMETRES: Final = 5.0


#: Length [m] and duration [s] of a step when a patient is given and his step is not.
DEFAULT_STEP: Final = (0.15, 0.9)


def length(text: str) -> float:
    """A length of a body or a step as people write it, 1.75 or 175 for the same height: an option's type, in metres."""
    try:
        metres = float(text)
    except ValueError:
        raise click.BadParameter(f"{text!r} is no length; write metres (1.75) or centimetres (175)") from None
    return metres / 100.0 if metres >= _CENTIMETRES else metres


def options_as(
    name: str, meaning: Callable[..., object], options: Sequence[Callable[[Any], Any]]
) -> Callable[[_Command], _Command]:
    """Give a command options, in this order, and hand it what they mean together as one argument.

    Args:
        name: of the argument.
        meaning: called with the options by its parameters' names.
        options: click's, or decorators that hand over an argument themselves.
    """
    parameters = inspect.signature(meaning).parameters

    def decorate(command: _Command) -> _Command:
        @functools.wraps(command)
        def with_meaning(**arguments: Any) -> Any:
            meant = meaning(**{key: arguments.pop(key) for key in parameters if key in arguments})
            return command(**{name: meant}, **arguments)

        decorated: Any = with_meaning
        for option in reversed(options):
            decorated = option(decorated)
        given: _Command = decorated
        return given

    return decorate


def patient_options(*, legs: bool) -> Callable[[_Command], _Command]:
    """Give a command `--mass` and `--height`, and hand it the patient as the argument `patient`; None without them.

    Args:
        legs: `--thigh` and `--shank` too.
    """
    options = [
        click.option("--mass", type=float, metavar="KG", help="Of the patient, kg."),
        click.option("--height", type=length, metavar="M", help="Of the patient, m (1.75) or cm (175)."),
    ]
    if legs:
        options += [
            click.option(
                "--thigh", type=length, metavar="M", help="Hip to knee, m or cm.  [default: Winter's for the height]"
            ),
            click.option(
                "--shank", type=length, metavar="M", help="Knee to ankle, m or cm.  [default: Winter's for the height]"
            ),
        ]

    return options_as("patient", _patient, options)


def subject_options(command: _Command) -> _Command:
    """Give a command `--mass`, `--height`, `--step-length` and `--step-duration`, handed over as `subject`; None without."""
    step_length, step_duration = DEFAULT_STEP
    options = [
        patient_options(legs=False),
        click.option(
            "--step-length",
            type=length,
            metavar="M",
            help=f"Of the patient's gait, m or cm.  [default: {step_length:g}]",
        ),
        click.option(
            "--step-duration", type=float, metavar="S", help=f"Of the patient's gait, s.  [default: {step_duration:g}]"
        ),
    ]
    return options_as("subject", _subject, options)(command)


def _subject(patient: Patient | None, step_length: float | None, step_duration: float | None) -> Subject | None:
    if patient is None:
        if step_length is not None or step_duration is not None:
            raise click.UsageError("a step of one's own needs a patient: --mass and --height")
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
        raise click.UsageError("a patient needs --mass and --height")
    from atalante_control.model import Patient

    try:
        return Patient(mass, height, thigh, shank)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


@dataclass(frozen=True)
class Target:
    """Where the robot is: an interface of python-can, or embedded: emulated for this program alone."""

    interface: str
    channel: str  # one channel, or a channel map; empty when embedded
    lockstep: bool  # cycles follow the nodes' answers instead of the wall clock

    @property
    def embedded(self) -> bool:
        """The robot is emulated for this program alone, in its process or in one beside it."""
        return self.interface == EMBEDDED

    def __str__(self) -> str:
        """As the user named it."""
        return self.interface if self.embedded else f"{self.interface} {self.channel}"

    @property
    def arguments(self) -> str:
        """The options that make another process of ours find the same bus."""
        return f"-i {self.interface} -c {self.channel}"


def target_options(*, embedded: bool, clock: bool = True) -> Callable[[_Command], _Command]:
    """Give a command `-i`, `-c` and `--lockstep/--wall`, and hand it their meaning as the argument `target`.

    Args:
        embedded: whether an embedded robot is a choice, and then the default.
        clock: whether the command has one.
    """
    interfaces = "socketcan, pcan, kvaser, ..."
    options = [
        click.option(
            "-i",
            "--interface",
            default=EMBEDDED if embedded else "socketcan",
            show_default=True,
            metavar="NAME",
            help=f"{interfaces}{' or embedded: an emulated robot of its own' if embedded else ''}",
        ),
        click.option(
            "-c",
            "--channel",
            default="",
            metavar="CHANNEL",
            help="For all four buses (vcan0), or one each: left_leg=can0,right_leg=can1,left_sense=can2,right_sense=can3.",
        ),
    ]
    if clock:
        default = "lock-step when embedded, else wall" if embedded else "wall"
        options.append(
            click.option(
                "--lockstep/--wall",
                default=None,
                help=f"Wait for the other side in every cycle (slow machines), or run at 1 kHz.  [default: {default}]",
            )
        )

    return options_as("target", functools.partial(_target, embedded=embedded), options)


def _target(interface: str, channel: str, lockstep: bool | None = None, *, embedded: bool) -> Target:
    if interface == EMBEDDED:
        if not embedded:
            raise click.UsageError("this needs a bus that other processes are on: -i socketcan -c vcan0")
        if channel:
            raise click.UsageError(f"the embedded robot has no channel; to use {channel} say -i socketcan -c {channel}")
    elif interface in NO_WIRE:
        raise click.UsageError(
            f"{interface} {NO_WIRE[interface]}: use an adapter, or a vcan of Linux (`atalante doctor -i socketcan -c vcan0`)"
        )
    elif not channel:
        raise click.UsageError(f"{interface} needs a channel: -c vcan0, or a channel map of the four buses")
    return Target(interface, channel, interface == EMBEDDED if lockstep is None else lockstep)
