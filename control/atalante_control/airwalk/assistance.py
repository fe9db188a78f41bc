"""Idealization u_i and feedforward u_f of the assisted joints, SH and SK of the swing leg. `model, gait -> u_i, u_f`."""

from __future__ import annotations

import numpy as np

from atalante_control.gait.gait import PERIOD, Gait, bezier
from atalante_control.joint.idealization import AssistedInertia, Friction, Law, law_of
from atalante_control.structured import Records
from atalante_hal.robot import LEG_JOINTS
from atalante_hal.types import Vector

_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")


class Assistance:
    """Idealization and feedforward of SH and SK of the swing leg.

    Attributes:
        inertia: mass matrix and separate inertias of SH and SK.
        feedforward: Bezier control points of u_f, which acts on the same inertias as u_v, shape (2, 8) [Nm]; None: no u_f.
        laws: parameters of `idealization.merge`, shape (1,).
        rows: u_f of SH and SK for each cycle, shape (n, 2) [Nm].
    """

    def __init__(
        self, inertia: AssistedInertia, gait: Gait, friction: Friction, *, decoupled: bool, feedforward: bool
    ) -> None:
        """Compute the parameters of the idealization, and sample u_f at every cycle.

        Args:
            inertia: mass matrix and separate inertias of SH and SK.
            gait: right-stance step that repeats.
            friction: friction to compensate.
            decoupled: whether u_f + u_v are torques on the separate inertias.
            feedforward: whether u_f of the gait is applied; False: u_f is zero.
        """
        self.inertia = inertia
        self.feedforward = swing_feedforward(gait, inertia, decoupled) if feedforward else None
        time: Vector = np.arange(gait.cycles + 1, dtype=np.float64) * PERIOD
        self.laws: Records[Law] = law_of(friction, inertia, decoupled)
        self.rows: Vector = np.zeros((len(time), 2))
        if self.feedforward is not None:
            self.rows[:] = bezier(self.feedforward, time / gait.duration)


def swing_feedforward(gait: Gait, inertia: AssistedInertia, decoupled: bool) -> Vector | None:
    """Return u_f of SH and SK of the swing leg as Bezier control points, shape (2, 8) [Nm]; None if the gait has none.

    The feedforward of the gait applies to the coupled pair. For the separate inertias it is converted with the mass matrix
    along the nominal trajectory and fitted again.

    Args:
        gait: right-stance step that repeats.
        inertia: mass matrix and separate inertias of SH and SK.
        decoupled: whether the result applies to the separate inertias; False: to the coupled pair.
    """
    swing = [_SH, _SK]
    if gait.feedforward is None or not decoupled:
        return None if gait.feedforward is None else gait.feedforward[swing]
    table = gait.tables()
    ideal = [
        inertia.ideal(float(q[_SK]), float(qd[_SH]), float(qd[_SK]), (float(uf[_SH]), float(uf[_SK])))
        for q, qd, uf in zip(table.q, table.qd, table.uf, strict=True)
    ]
    degree = gait.feedforward.shape[1] - 1
    basis = bezier(np.eye(degree + 1), np.arange(gait.cycles + 1) / gait.cycles)
    return np.asarray(np.linalg.lstsq(basis, np.array(ideal), rcond=None)[0].T)
