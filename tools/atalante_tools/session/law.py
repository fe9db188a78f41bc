"""Options of the control law of `airwalk` and `walk`: `--idealization, --feedforward, --literal -> Law`."""

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

    idealization: float = 1.0  # intensity of the joint idealization u_i while the guide does not act, 0 to 1
    feedforward: float = 1.0  # intensity of the feedforward u_f while the guide does not act, 0 to 1
    literal: bool = False  # whether the law follows the paper literally; the guides are then not certified

    def config(self) -> AirwalkConfig:
        """Return the parameters of the airwalk controller."""
        from atalante_control.airwalk.config import AirwalkConfig

        config = AirwalkConfig.literal() if self.literal else AirwalkConfig()
        return replace(config, idealization=self.idealization, feedforward=self.feedforward)


def law_options() -> Callable[[_Command], _Command]:
    """Return a decorator that adds the options of the control law to a command. The command gets the argument `law`."""
    options = [
        click.option(
            "--idealization",
            type=Between(0.0, 1.0),
            default=Law.idealization,
            show_default=True,
            metavar="X",
            help="Intensity of the joint idealization (gravity, friction, velocity torques) from 0 to 1 while the guide does not "
            "act. At a lower intensity, the patient must carry more of the weight of the leg.",
        ),
        click.option(
            "--feedforward",
            type=Between(0.0, 1.0),
            metavar="X",
            help="Intensity of the feedforward (inertia of the leg along the gait) from 0 to 1 while the guide does not act. "
            "At a lower intensity, the patient must produce more of the torque that accelerates the leg.  "
            "[default: 1; 0 if --literal is given]",
        ),
        click.option(
            "--literal",
            is_flag=True,
            help="Use the control law exactly as the paper prints it, for comparisons. The guides are then not certified.",
        ),
    ]
    return options_as("law", _law, options)


def _law(idealization: float, feedforward: float | None, literal: bool) -> Law:
    return Law(idealization, (0.0 if literal else 1.0) if feedforward is None else feedforward, literal)
