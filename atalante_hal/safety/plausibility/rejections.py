"""Error counters of the joints and the IMUs, which detect a sensor with frequent implausible values.

Single implausible values of a joint or an IMU are tolerated: the robot uses the previous values. If every new value is
implausible, the check that rejects the values confirms its diagnostic. If good values arrive in between, this check does not
confirm its diagnostic, because each good value ends the fault. So each sensor has an error counter, called leaky bucket: each
rejected value fills the bucket, and each good value empties it a little. The bucket has the same size as the buckets in
`message_monitor`. The bucket becomes full if more than a fifth of the values are rejected. Then the diagnostic is confirmed,
until 16 values in a row are good.
"""

from __future__ import annotations

from collections.abc import Mapping

from atalante_hal.dbc_names import IMU_NODES, JOINT_NODES
from atalante_hal.robot import IMUS, JOINTS
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.wire.e2e import SETTLED, Qualification, qualify

#: Names and nodes of the sensors whose values can be rejected, by sensor index.
_SENSORS = (*(f"encoder of {joint}" for joint in JOINTS), *(f"{imu} IMU" for imu in IMUS))
_NODES = (*JOINT_NODES, *IMU_NODES)


class Rejections:
    """Leaky bucket (error counter) of each sensor.

    The index of a sensor is a joint index, or the number of joints plus an IMU index.
    """

    def __init__(self) -> None:
        #: Bucket and last diagnostic of each sensor, by sensor index. A sensor without an entry has an empty bucket.
        self._buckets: dict[int, tuple[Qualification, Dtc]] = {}

    @property
    def pending(self) -> bool:
        """Return whether any bucket is not empty, so that `update` must be called in each cycle."""
        return bool(self._buckets)

    def update(self, rejected: Mapping[int, Dtc]) -> None:
        """Update all leaky buckets at the end of a cycle.

        Args:
            rejected: pending diagnostic of each sensor whose new values were rejected in this cycle, by sensor index.
        """
        for sensor, cause in {**{sensor: dtc for sensor, (_, dtc) in self._buckets.items()}, **rejected}.items():
            before, _ = self._buckets.pop(sensor, (SETTLED, cause))
            bucket = qualify(before, good=sensor not in rejected)
            if bucket is not SETTLED:
                self._buckets[sensor] = bucket, cause

    def forget(self, sensor: int) -> None:
        """Empty the leaky bucket of a sensor.

        Args:
            sensor: index of the sensor.
        """
        self._buckets.pop(sensor, None)

    def findings(self) -> tuple[Finding, ...]:
        """Return a finding for each sensor whose values are rejected too often."""
        return tuple(
            _often_rejected(sensor, dtc) for sensor, (bucket, dtc) in self._buckets.items() if not bucket.trusted
        )


def _often_rejected(sensor: int, dtc: Dtc) -> Finding:
    text = f"the values of the {_SENSORS[sensor]} are implausible: more than a fifth of them were rejected"
    return Finding(dtc, _NODES[sensor], 0.0, True, text)
