"""Options of the control law: defaults of the command line and of the controller."""

from __future__ import annotations

import click
import pytest
from click.testing import CliRunner

from atalante_control.airwalk.config import AirwalkConfig
from atalante_tools.cli import cli
from atalante_tools.session.law import Law, law_options


def test_defaults_are_those_of_the_controller():
    assert Law().config() == AirwalkConfig()


def test_intensities_reach_the_controller():
    config = Law(idealization=0.25, feedforward=0.75).config()
    assert (config.idealization, config.feedforward) == (0.25, 0.75)


@pytest.mark.parametrize("option", [[], ["--literal"]])
def test_default_feedforward_is_that_of_the_chosen_law(option: list[str]):
    defaults = {(): Law(), ("--literal",): Law(literal=True, feedforward=AirwalkConfig.literal().feedforward)}

    @click.command()
    @law_options()
    def command(law: Law) -> None:
        assert law == defaults[tuple(option)]

    assert CliRunner().invoke(command, option).exit_code == 0


def test_literal_law_takes_its_parameters_from_the_controller():
    assert Law(feedforward=0.0, literal=True).config() == AirwalkConfig.literal()


@pytest.mark.parametrize("command", [["demo"], ["airwalk"], ["guide", "check"], ["walk"]])
@pytest.mark.parametrize("option", ["--idealization", "--feedforward"])
@pytest.mark.parametrize("intensity", ["-0.1", "1.1", "nan"])
def test_intensity_outside_0_to_1_is_rejected(command: list[str], option: str, intensity: str):
    done = CliRunner().invoke(cli, [*command, option, intensity])
    assert done.exit_code == 2
    assert f"Invalid value for '{option}'" in done.stderr
