"""Command `atalante model`: print, draw, export and check the model of exoskeleton and patient."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from atalante_tools.console.options import OutputFile, json_option, patient_options
from atalante_tools.console.outcome import Failed
from atalante_tools.console.terminal import print_message, show_json, table
from atalante_tools.session.extra import require_matplotlib

if TYPE_CHECKING:
    from atalante_control.model import Link, Patient


@click.command()
@patient_options
@click.option(
    "--urdf",
    "urdf_file",
    type=OutputFile(".urdf", ".xml"),
    metavar="FILE",
    help="Write the URDF to this file, for PyBullet, Pinocchio and viewers.",
)
@click.option(
    "--show",
    "picture",
    type=OutputFile(".png", ".svg", ".pdf"),
    is_flag=False,
    flag_value=Path("model.png"),
    metavar="[FILE]",
    help="Draw the model from behind and from the side to this .png, .svg or .pdf file.  [FILE if omitted: model.png]",
)
@json_option
def command(patient: Patient | None, urdf_file: Path | None, picture: Path | None, as_json: bool) -> None:  # fmt: skip
    """Print the links of the model and check its consistency. The exit code is 1 if a check fails.

    With --mass and --height the model is the exoskeleton with a patient. Without these options the model is the empty
    exoskeleton. The controller cancels the dynamics of the empty exoskeleton (joint idealization). Masses are in kg, centres of
    mass in m in the frame of the link, moments of inertia in kg m2 about the centre of mass.

    \b
    Example: atalante model --mass 75 --height 175
             atalante model --mass 58 --height 1.62 --thigh 0.41 --urdf worn.urdf --show
    """
    if picture is not None:
        require_matplotlib()
    from atalante_control.model import ExoskeletonParameters, links, urdf
    from atalante_hal.robot import load_robot
    from atalante_tools.model.checks import model_checks

    robot, parameters = load_robot(), ExoskeletonParameters()
    bodies = links(parameters, patient)
    found = list(model_checks(parameters, robot, patient))
    if as_json:
        for body in bodies:
            show_json({"link": body.name, "parent": body.parent or None, "joint": body.joint, **_numbers(body)})
        for check in found:
            show_json({"check": check.name, "ok": check.ok, "text": check.text})
    else:
        click.echo(_table(bodies))
        click.echo()
        for check in found:
            click.echo(f"{'ok  ' if check.ok else '--  ' if check.ok is None else 'FAIL'}  {check.name}: {check.text}")
    if urdf_file is not None:
        urdf_file.write_text(urdf(parameters, robot, patient), encoding="utf-8")
        print_message(f"URDF in {urdf_file}")
    if picture is not None:
        _draw(picture, bodies)
    if failed := [check.name for check in found if check.ok is False]:
        raise Failed(f"the model is inconsistent: {', '.join(failed)}")


def _numbers(body: Link) -> dict[str, object]:
    return {
        "mass": body.inertia.mass,
        "centre": [value + 0.0 for value in body.inertia.centre],  # the term + 0.0 replaces -0.0 with 0.0
        "origin": [value + 0.0 for value in body.origin],
        "inertia": {
            name: value + 0.0
            for name, value in zip(("xx", "xy", "xz", "yy", "yz", "zz"), body.inertia.tensor, strict=True)
        },
    }


def _table(bodies: tuple[Link, ...]) -> str:
    head = ["link", "on", "by", "mass", "x", "y", "z", "Ixx", "Iyy", "Izz"]
    rows = []
    for body in bodies:
        inertia = body.inertia
        mass = f"{inertia.mass:.4f}" if inertia.mass else "-"
        centre = [f"{value + 0.0:.4f}" if inertia.mass else "-" for value in inertia.centre]
        moments = [f"{inertia.tensor[i]:.5f}" if inertia.mass else "-" for i in (0, 3, 5)]
        rows.append([body.name, body.parent or "world", body.joint or "fixed", mass, *centre, *moments])
    return table([head, *rows])


def _draw(picture: Path, bodies: tuple[Link, ...]) -> None:
    from atalante_tools.model.picture import draw

    draw(bodies, picture)
    print_message(f"picture in {picture}")
