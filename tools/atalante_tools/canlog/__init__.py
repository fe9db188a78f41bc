"""Commands that decode and validate CAN logs."""
