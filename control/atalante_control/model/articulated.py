"""A URDF made here as a Pinocchio model, with the places of our joints in its vectors. `URDF -> ArticulatedModel`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_hal.robot import JOINTS


class ArticulatedModel(NamedTuple):
    """A Pinocchio model with the places of our joints in its vectors."""

    model: Any  # pinocchio.Model
    q: npt.NDArray[np.intp]  # (12,) index of each of JOINTS in a configuration vector
    v: npt.NDArray[np.intp]  # (12,) index of each of JOINTS in a velocity or torque vector


def pinocchio_model(urdf_text: str, fixed_base: bool = True) -> ArticulatedModel:
    """Pinocchio model of a URDF made here, gravity 9.81 m/s2 down; always index it through the joint map.

    Args:
        fixed_base: the pelvis is welded to the world at its origin; otherwise it floats on a `JointModelFreeFlyer`,
            which comes first in q and v.

    Raises:
        ValueError: a joint of `JOINTS` is not in the text.
    """
    if fixed_base:
        model = pinocchio.buildModelFromXML(urdf_text)
    else:
        model = pinocchio.buildModelFromXML(urdf_text, pinocchio.JointModelFreeFlyer())
    if missing := [name for name in JOINTS if not model.existJointName(name)]:
        raise ValueError(f"the URDF lacks joint {missing[0]}; it needs all of {', '.join(JOINTS)}")
    ids = [model.getJointId(name) for name in JOINTS]
    q, v = np.array([model.idx_qs[i] for i in ids], np.intp), np.array([model.idx_vs[i] for i in ids], np.intp)
    return ArticulatedModel(model, q, v)
