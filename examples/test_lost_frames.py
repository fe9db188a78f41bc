"""Test that four consecutive lost frames of a drive leave the robot in ACTIVE, and that five lost frames lead to HOLD.

Run it:  pytest examples/test_lost_frames.py

The fixtures `loop` and `faults` are in the pytest plugin of this project. Prints the result of pytest.
"""

from atalante_hal.types import SupervisorState


def test_five_lost_frames_end_in_hold(loop, faults):
    """Drop frames of the left knee drive while the robot is ACTIVE."""
    loop.until(SupervisorState.ACTIVE)
    faults.drop("LEFT_SK_STATE", frames=4)
    assert loop.run(20).supervisor is SupervisorState.ACTIVE
    faults.drop("LEFT_SK_STATE", frames=5)
    assert loop.run(20).supervisor is SupervisorState.HOLD
    assert "NODE_TIMEOUT" in loop.codes
