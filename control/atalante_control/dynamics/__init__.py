"""Inverse dynamics on the ground and in the air, gravity torques of the suspended exoskeleton, and gait network."""
