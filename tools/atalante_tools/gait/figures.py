"""Figures of a gait: a plot of angles, torques, centre of pressure and clearance, and an animated stick figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pinocchio

from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.gait import Gait, motion
from atalante_control.model import BASE_LINK, LEG_LINKS, ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_hal.robot import LEG_JOINTS, SIDES, load_robot
from atalante_hal.types import Vector

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.patches import Rectangle

_SAMPLES = 101
_FRAMES_A_SECOND = 25
_COLOURS = {"left": "tab:orange", "right": "tab:blue"}


class _Demands(NamedTuple):
    """Joint angles, torques, centre of pressure and swing clearance of a step with n samples."""

    phase: Vector  # time divided by the step duration, 0 to 1, shape (n,)
    q: Vector  # joint angles [rad], shape (n, 12)
    torque: Vector  # joint torques [Nm], shape (n, 12)
    #: vector from the sole centre to the centre of pressure [m], columns: x and y of the stance foot, shape (n, 2)
    pressure: Vector
    clearance: Vector  # height of the lowest corner of the swing sole above the ground [m], shape (n,)


def draw_plot(gait: Gait, patient: Patient, picture: Path) -> None:
    """Plot joint angles, joint torques, centre of pressure and swing clearance over the time of a step.

    Args:
        gait: gait to draw.
        patient: patient in the exoskeleton.
        picture: file to write; the suffix sets the format.
    """
    demands, exo, robot = _demands(gait, patient), ExoskeletonParameters(), load_robot()
    figure, axes = plt.subplots(2, 3, figsize=(13.0, 7.0))
    time = demands.phase * gait.duration
    legs = {"stance leg (right)": slice(len(LEG_JOINTS), None), "swing leg (left)": slice(0, len(LEG_JOINTS))}
    for row, (values, unit) in enumerate(((np.degrees(demands.q), "angle [deg]"), (demands.torque, "torque [Nm]"))):
        for column, (leg, joints) in enumerate(legs.items()):
            axis = axes[row, column]
            for joint, line in zip(LEG_JOINTS, values[:, joints].T, strict=True):
                axis.plot(time, line, label=joint)
            axis.set(title=leg, xlabel="time [s]", ylabel=unit)
            axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8, ncols=2)
    used = np.abs(demands.torque).max(axis=0) / robot.torque_max
    axes[1, 0].set_title(f"stance leg (right), at most {100 * used.max():.0f} % of a limit")

    axis = axes[0, 2]
    length, width = exo.sole_size
    for share, style in ((1.0, "-"), (0.6, ":")):
        corner, size = (-share * width / 2, -share * length / 2), (share * width, share * length)
        axis.add_patch(Rectangle(corner, *size, fill=False, linestyle=style))
    axis.plot(-demands.pressure[:, 1], demands.pressure[:, 0], color=_COLOURS["right"])
    axis.plot(-demands.pressure[0, 1], demands.pressure[0, 0], "o", color=_COLOURS["right"], label="start")
    axis.set(title="centre of pressure, stance sole from above", xlabel="to the right [m]", ylabel="forward [m]")
    axis.set_aspect("equal")
    axis.legend(fontsize=8)

    axis = axes[1, 2]
    axis.plot(time, 1e3 * demands.clearance, color=_COLOURS["left"])
    axis.set(title="swing sole, lowest corner above the ground", xlabel="time [s]", ylabel="clearance [mm]")
    axis.grid(alpha=0.3)
    figure.suptitle(gait.name)
    figure.tight_layout()
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def draw_animation(gait: Gait, patient: Patient, picture: Path) -> None:
    """Animate the step as a stick figure in real time, seen from the side and from behind.

    Args:
        gait: gait to animate.
        patient: patient in the exoskeleton.
        picture: GIF file to write.
    """
    frames = max(2, round(gait.duration * _FRAMES_A_SECOND) + 1)
    q, _, _ = motion(gait.coefficients, gait.duration, np.linspace(0.0, 1.0, frames))
    sticks = _Sticks(patient)
    poses = [sticks.points(pose) for pose in q]
    figure, axes = plt.subplots(1, 2, figsize=(7.0, 4.6), sharey=True)
    everything = np.concatenate([np.concatenate(list(pose.values())) for pose in poses])
    lines = []
    for axis, (across, title) in zip(axes, ((0, "from the side"), (1, "from behind")), strict=True):
        axis.axhline(0.0, color="0.6", linewidth=0.8)
        low, high = everything[:, across].min() - 0.1, everything[:, across].max() + 0.1
        axis.set(xlim=(low, high), ylim=(-0.05, everything[:, 2].max() + 0.1), title=title, aspect="equal")
        lines.append({name: axis.plot([], [], "o-", markersize=3, color=_colour(name))[0] for name in poses[0]})
    axes[1].invert_xaxis()  # in a view from behind, the left leg is on the left
    figure.suptitle(gait.name, fontsize=9)
    figure.tight_layout()

    def show(frame: int) -> list[Any]:
        for drawn, across in zip(lines, (0, 1), strict=True):
            for name, points in poses[frame].items():
                drawn[name].set_data(points[:, across], points[:, 2])
        return [line for drawn in lines for line in drawn.values()]

    animation = FuncAnimation(figure, show, frames=frames, blit=True)
    animation.save(picture, writer=PillowWriter(fps=_FRAMES_A_SECOND))
    plt.close(figure)


def _colour(name: str) -> str:
    return _COLOURS.get(name, "black")


class _Sticks:
    """Stick figure of the robot. The origin of the drawing is on the ground below the ankle of the stance leg."""

    def __init__(self, patient: Patient) -> None:
        self._exo = ExoskeletonParameters()
        self._articulated = pinocchio_model(urdf(self._exo, load_robot(), patient))
        self._data = self._articulated.model.createData()
        self._walking = pinocchio.SE3(
            pinocchio.utils.rotate("z", -self._exo.toe_out), np.array([0.0, 0.0, -self._exo.sole_centre[1]])
        )
        self._trunk = np.array([[-0.05, 0.0, 0.0], [-0.05, 0.0, 0.55]])  # in the pelvis frame [m]

    def points(self, pose: Vector) -> dict[str, Vector]:
        """Return the points of the stick figure [m] for the joint angles `pose` [rad], shape (12,).

        Returns:
            Polyline of "trunk", "left" and "right" (leg). Each polyline has n points, shape (n, 3).
        """
        model, data = self._articulated.model, self._data
        q = pinocchio.neutral(model)
        q[self._articulated.q] = pose
        pinocchio.framesForwardKinematics(model, data, q)
        foot = LEG_LINKS["HA"]
        to_walking = self._walking * data.oMf[model.getFrameId(f"{SIDES[1]}_{foot}")].inverse()
        found = {"trunk": self._placed(to_walking * data.oMf[model.getFrameId(BASE_LINK)], self._trunk)}
        length, (x, z) = self._exo.sole_size[0], self._exo.sole_centre
        sole = np.array([[0.0, 0.0, 0.0], [x - length / 2, 0.0, z], [x + length / 2, 0.0, z], [0.0, 0.0, 0.0]])
        for side in SIDES:
            chain = [data.oMf[model.getFrameId(f"{side}_{link}")] for link in LEG_LINKS.values()]
            joints = np.array([(to_walking * frame).translation for frame in chain])
            hips = (to_walking * data.oMf[model.getFrameId(BASE_LINK)]).translation[None, :]
            found[side] = np.concatenate([hips, joints, self._placed(to_walking * chain[-1], sole)])
        return found

    @staticmethod
    def _placed(frame: Any, points: Vector) -> Vector:
        return np.asarray(points @ frame.rotation.T + frame.translation)


def _demands(gait: Gait, patient: Patient) -> _Demands:
    exo, dynamics = ExoskeletonParameters(), stance_dynamics(load_robot(), patient)
    phase = np.linspace(0.0, 1.0, _SAMPLES)
    states = motion(gait.coefficients, gait.duration, phase)
    forces = [dynamics.forces(*state) for state in zip(*states, strict=True)]
    force, moment = np.array([f.force for f in forces]), np.array([f.moment for f in forces])
    x, z = exo.sole_centre
    about_centre = moment - np.cross([x, 0.0, z], force)
    pressure = np.stack([-about_centre[:, 1], about_centre[:, 0]], axis=1) / force[:, 2:]
    length, width = exo.sole_size
    corners = np.array([(x + i * length / 2, j * width / 2, z) for i in (1, -1) for j in (1, -1)])
    feet = [dynamics.swing_foot(pose) for pose in states[0]]
    clearance = [float((corners @ foot.rotation.T + foot.translation)[:, 2].min() - z) for foot in feet]
    return _Demands(phase, states[0], np.array([f.torque for f in forces]), pressure, np.array(clearance))
