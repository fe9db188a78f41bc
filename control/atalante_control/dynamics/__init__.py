"""Dynamics of the exoskeleton: gravity, on the ground and suspended in the air, and the gait network."""
