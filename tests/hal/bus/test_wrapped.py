from __future__ import annotations

import numpy as np
import pytest

from atalante_hal.bus import BusDown
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import new_frames


def test_wrapped_bus_forwards_every_call() -> None:
    near, far = lockstep_pair(names=("near", "far"))
    bus, frames = WrappedBus(near), new_frames(2)
    frames["can_id"], frames["len"] = (1, 2), 8
    bus.send(frames)
    assert far.receive(frames) == 2
    near.now_ns, near.dropped = 5, 3
    far.send(frames)
    assert bus.receive(frames) == 2
    assert (bus.name, bus.dropped) == ("near", 3)
    np.testing.assert_array_equal(bus.stamps[:2], 5)


def test_closing_the_wrapper_closes_the_bus() -> None:
    near, _ = lockstep_pair()
    bus, frames = WrappedBus(near), new_frames(1)
    bus.close()
    for use in (bus.send, bus.receive):
        with pytest.raises(BusDown):
            use(frames)
