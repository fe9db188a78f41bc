"""A run of the robot: rig, emulated body, pendant, run folder and figures."""
