"""CAN logs: decode and validate them."""
