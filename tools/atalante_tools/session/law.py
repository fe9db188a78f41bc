"""Options of the control law of `airwalk`, `walk` and `trial`: `--idealization, --feedforward, --literal -> Law`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import click

from atalante_tools.console.options import Between, options_as

if TYPE_CHECKING:
    from atalante_control.airwalk.config import AirwalkConfig

_Command = TypeVar("_Command", bound=Callable[..., Any])


@dataclass(frozen=True)
class Law:
    """Control law of the assisted joints. The field names are keys of summary.json."""

    #: Factor on the torque u_i, 0 to 1. The factor applies while the guide does not act.
    #: The torque u_i of the exoskeleton cancels the gravity, friction, Coriolis and centrifugal torques of the leg.
    idealization: float = 1.0
    #: Factor on the torque u_f, 0 to 1. The factor applies while the guide does not act.
    #: The torque u_f of the exoskeleton accelerates the leg as the gait requires.
    feedforward: float = 1.0
    literal: bool = False  # whether the law follows the paper literally; the guides are then not certified

    def config(self) -> AirwalkConfig:
        """Return the parameters of the airwalk controller."""
        from atalante_control.airwalk.config import AirwalkConfig

        config = AirwalkConfig.literal() if self.literal else AirwalkConfig()
        return replace(config, idealization=self.idealization, feedforward=self.feedforward)


def law_options(*, literal: bool = True) -> Callable[[_Command], _Command]:
    """Return a decorator that adds the options of the control law to a command. The command gets the argument `law`.

    Args:
        literal: Whether to add `--literal`.
    """
    options = [
        click.option(
            "--idealization",
            type=Between(0.0, 1.0),
            default=Law.idealization,
            show_default=True,
            metavar="X",
            help="While the guide does not act, the exoskeleton compensates this share (0 to 1) of the gravity, friction, "
            "Coriolis and centrifugal torques of the leg. The patient must produce the rest.",
        ),
        click.option(
            "--feedforward",
            type=Between(0.0, 1.0),
            metavar="X",
            help="While the guide does not act, the exoskeleton produces this share (0 to 1) of the torques that accelerate "
            "the leg along the gait. The patient must produce the rest.  "
            + ("[default: 1; 0 if --literal is given]" if literal else "[default: 1]"),
        ),
    ]
    if literal:
        options.append(
            click.option(
                "--literal",
                is_flag=True,
                help="Use the control law exactly as the paper prints it, for comparisons. The guides are then not certified.",
            )
        )
    return options_as("law", _law, options)


def _law(idealization: float, feedforward: float | None, literal: bool = False) -> Law:
    return Law(idealization, (0.0 if literal else 1.0) if feedforward is None else feedforward, literal)
