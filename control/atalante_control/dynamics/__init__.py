"""Dynamics of the exoskeleton on the ground and suspended in the air, its gravity torques, and the gait network."""
