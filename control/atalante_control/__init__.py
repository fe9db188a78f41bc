"""Control laws of the paper: model, gait, baseline controller, virtual guide and haptics, independent of CAN."""
