"""Safety core, which detects faults in each cycle, sets the robot's state and limits the commands to the drives."""
