"""Emulated robot at the other end of the bus: nodes, PyBullet body and injected faults."""
