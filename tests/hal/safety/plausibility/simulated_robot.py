"""A simulated robot with healthy sensors, whose decoded signals a test can change before the plausibility checks run."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio
import pytest

import atalante_dbc
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, load_robot
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding, Plausibility
from atalante_hal.safety.plausibility.inertial import turn_rate, upward
from atalante_hal.safety.plausibility.signals import Signals, signals_of
from atalante_hal.types import GRAVITY
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.frame import new_frames
from atalante_hal.wire.process_image import ReceiveImage

MESSAGES = [m for m in atalante_dbc.load().received_by("HAL") if m.cycle_ms == 1]
CODEC = Codec(MESSAGES)
ROBOT = load_robot()
#: Robot whose soles may have any tilt, because the ankles of the simulated robot do not hold its soles level.
UNEVEN = replace(ROBOT, sensors=replace(ROBOT.sensors, sole_tilt=1.0))
PERIOD = 1e-3  # s
#: Motor angle per joint angle, with the sign of the polarity.
GEAR = ROBOT.gear * ROBOT.polarity
#: Middle of the range of each joint [rad].
MIDDLE = (ROBOT.position_min + ROBOT.position_max) / 2.0
#: Largest change of each joint position in one cycle that is not regarded as a jump [rad].
REACH = ROBOT.top_speed * PERIOD + 3.0 * ROBOT.encoder_noise

MODEL = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT))
DATA = MODEL.model.createData()
_IMU_FRAMES = [MODEL.model.getFrameId(f"imu_{imu}") for imu in IMUS]
_NOISE = [signals_of(CODEC, row) for row in np.random.default_rng(1).standard_normal((1021, CODEC.size))]
_NO_FRAMES = new_frames(len(MESSAGES))

joints = pytest.mark.parametrize("joint", range(len(JOINTS)), ids=JOINTS)
imus = pytest.mark.parametrize("imu", range(len(IMUS)), ids=IMUS)
cells = pytest.mark.parametrize(("foot", "cell"), [(f, c) for f in range(len(FEET)) for c in range(len(CELLS))])
signs = pytest.mark.parametrize("sign", [1.0, -1.0])

#: Function that changes the signals of a cycle in place.
Change = Callable[[Signals], object]


def row(name: str) -> int:
    """Return the row of the state message of a joint, IMU or foot."""
    return CODEC.rows[f"{name.upper()}_STATE"]


def attitudes(position: np.ndarray) -> np.ndarray:
    """Return the quaternions wxyz of the four IMUs at these joint positions [rad], computed with Pinocchio."""
    q = pinocchio.neutral(MODEL.model)
    q[MODEL.q] = position
    pinocchio.framesForwardKinematics(MODEL.model, DATA, q)
    quaternions = [pinocchio.Quaternion(DATA.oMf[frame].rotation).coeffs() for frame in _IMU_FRAMES]
    return np.array([[w, x, y, z] for x, y, z, w in quaternions])


def specific_force(quaternion: np.ndarray) -> np.ndarray:
    """Return the specific force at rest in the frame of an IMU with this attitude wxyz, shape (3,) [m/s2]."""
    return GRAVITY * np.array(upward(quaternion))


def signals() -> Signals:
    """Return new signals, all of them zero."""
    return signals_of(CODEC, np.zeros(CODEC.size))


def only(found: tuple[Finding, ...]) -> Finding:
    """Return the single finding."""
    assert len(found) == 1, found
    return found[0]


def must_not_be_called(*_: object) -> None:
    """Fail the test. A test puts this in place of a function that must not be called."""
    raise AssertionError


@dataclass
class SimulatedRobot:
    """A robot whose joints swing slowly, and whose sensors are healthy except for the change that a test makes.

    The signals are written to the process image without frames.
    """

    cycles: int = 0
    missing: set[int] = field(default_factory=set)  # rows without a frame in this cycle
    late: dict[int, int] = field(default_factory=dict)  # row -> age of its values [cycles]
    gaps: set[int] = field(default_factory=set)  # rows with a frame after lost frames
    amplitude: float = 0.05  # rad
    standing: bool = False  # whether both feet carry load

    def __post_init__(self) -> None:
        self.image = ReceiveImage(MESSAGES, np.zeros(CODEC.size))
        self.now = signals_of(CODEC, self.image.values)
        self.checks = Plausibility(UNEVEN, self.image, PERIOD)
        self.attitudes = attitudes(MIDDLE)
        self.rates = np.zeros((len(IMUS), 3))  # angular velocity of each IMU [rad/s]
        #: Attitudes in the last eight cycles, with the changes that the test made.
        self.reported = deque([self.attitudes] * 8, maxlen=8)
        self.run(1)

    @property
    def time(self) -> float:
        """Return the time since the first cycle [s]."""
        return self.cycles * PERIOD

    @property
    def rejected(self) -> dict[int, int]:
        """Return row -> age of its values [cycles], for each row whose new values were rejected in this cycle."""
        rows = np.flatnonzero(self.image.check == Check.IMPLAUSIBLE).tolist()
        assert not rows or not self.image.all_fresh
        return {row: int(self.image.age[row]) for row in rows}

    def position(self) -> np.ndarray:
        """Return the true joint positions [rad]."""
        return MIDDLE + self.amplitude * math.sin(3.0 * self.time)

    def cycle(self, change: Change = lambda now: None) -> tuple[Finding, ...]:
        """Simulate one cycle, change its signals, and return the findings."""
        image, now, noise = self.image, self.now, _NOISE[self.cycles % len(_NOISE)]
        image.accept(_NO_FRAMES, 0)
        values, age = image.values, image.age
        position = self.position()
        now.position[:] = position * GEAR
        now.velocity[:] = self.amplitude * 3.0 * math.cos(3.0 * self.time) * GEAR
        # Without motion the torque is constant, because a varying torque would show that the encoders are stuck.
        swing = 20.0 * math.sin(50.0 * self.time) if self.amplitude else 0.0
        now.torque[:] = swing + 0.05 * noise.torque
        if self.cycles % 8 == 0:  # the cycles in which the attitudes may be checked
            before, self.attitudes = self.attitudes, attitudes(position)
            self.rates = np.array([turn_rate(*pair, 8.0 * PERIOD) for pair in zip(before, self.attitudes, strict=True)])
        now.quaternion[:] = self.attitudes
        now.gyro[:] = self.rates + 4e-3 * noise.gyro
        now.accel[:] = [specific_force(quaternion) for quaternion in self.attitudes] + 0.05 * noise.accel
        now.force[:] = 3.0 * noise.force
        if self.standing:
            now.force[:, :, 2] += 100.0
        gyro, accel = now.gyro.copy(), now.accel.copy()
        change(now)
        for imu in np.flatnonzero((now.quaternion != self.attitudes).any(axis=1)).tolist():
            # The test turns this IMU, so gyroscope and accelerometer measure the turn, unless the test changes them, too.
            if (now.gyro[imu] == gyro[imu]).all():
                turn = turn_rate(self.reported[0][imu], now.quaternion[imu], 8.0 * PERIOD)
                now.gyro[imu] = turn + 4e-3 * noise.gyro[imu]
            if (now.accel[imu] == accel[imu]).all():
                now.accel[imu] = 0.05 * noise.accel[imu] + specific_force(now.quaternion[imu])
        self.reported.append(now.quaternion.copy())
        missing = list(self.missing)
        lost = np.isin(CODEC.row_of, missing)
        values[lost] = image.values_before[lost]
        age[np.isin(range(len(age)), missing, invert=True)] = 0
        image.check.fill(Check.OK)
        image.check[missing] = Check.NO_DATA
        for row, cycles in self.late.items():
            age[row] = cycles
        image.check[list(self.gaps)] = Check.SOME_LOST
        image.all_fresh = not (self.missing or self.late or self.gaps)
        found = self.checks.check()
        assert found is self.checks.findings
        self.cycles += 1
        return found

    def run(self, cycles: int, change: Change = lambda now: None) -> tuple[Finding, ...]:
        """Simulate cycles with the same change, and return the findings of the last cycle."""
        found: tuple[Finding, ...] = ()
        for _ in range(cycles):
            found = self.cycle(change)
        return found

    def until_found(self, dtc: Dtc, cycles: int, change: Change) -> int:
        """Return the number of cycles from the first faulty cycle, which counts as 1, until the finding is confirmed."""
        for cycle in range(1, cycles + 1):
            if any(f.dtc is dtc and f.confirmed for f in self.cycle(change)):
                return cycle
        raise AssertionError(f"no {dtc} in {cycles} cycles, but {self.checks.findings}")
