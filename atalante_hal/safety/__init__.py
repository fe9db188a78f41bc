"""Safety core: detects faults in each cycle, derives the robot state, and limits the commands sent to the drives."""
