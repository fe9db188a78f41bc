"""The paper: model, gait, baseline controller, virtual guide, haptics. Knows no CAN."""
