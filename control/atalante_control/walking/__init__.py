"""Walking on the ground: walking controller, phases of a walk, ankle stabiliser, steering, kinematics and attitude observer."""
