"""Emulated robot on a CAN bus: nodes, mechanics in PyBullet or MuJoCo, and fault injection."""
