"""Emulated robot on a CAN bus: nodes, mechanics in PyBullet, and fault injection."""
