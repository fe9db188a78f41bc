"""Pinocchio model of a URDF, with the index of each joint in the vectors of Pinocchio: `URDF -> ArticulatedModel`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_hal.robot import JOINTS


class ArticulatedModel(NamedTuple):
    """Pinocchio model with the index of each of `JOINTS` in the vectors of Pinocchio."""

    model: Any  # pinocchio.Model
    q: npt.NDArray[np.intp]  # (12,) index of each of JOINTS in a configuration vector
    v: npt.NDArray[np.intp]  # (12,) index of each of JOINTS in a velocity or torque vector


def pinocchio_model(urdf_text: str, fixed_base: bool = True) -> ArticulatedModel:
    """Build the Pinocchio model of a URDF, with gravity of 9.81 m/s2 (`GRAVITY`) downwards.

    The joint order of Pinocchio can differ from `JOINTS`. Index Pinocchio vectors only with `ArticulatedModel.q` and `.v`.

    Args:
        urdf_text: URDF with all joints of `JOINTS`.
        fixed_base: whether the pelvis is fixed to the world at its origin. If not, the pelvis floats on a
            `JointModelFreeFlyer`, whose coordinates come first in q and v.

    Raises:
        ValueError: If a joint of `JOINTS` is missing in the URDF.
    """
    if fixed_base:
        model = pinocchio.buildModelFromXML(urdf_text)
    else:
        model = pinocchio.buildModelFromXML(urdf_text, pinocchio.JointModelFreeFlyer())
    if missing := [name for name in JOINTS if not model.existJointName(name)]:
        raise ValueError(f"the URDF must contain the joints {', '.join(JOINTS)}, got no joint {missing[0]}")
    ids = [model.getJointId(name) for name in JOINTS]
    q, v = np.array([model.idx_qs[i] for i in ids], np.intp), np.array([model.idx_vs[i] for i in ids], np.intp)
    return ArticulatedModel(model, q, v)
