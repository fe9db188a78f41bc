"""The other end of the bus: nodes, PyBullet body and the faults they can have."""
