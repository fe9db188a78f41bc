"""Readers of CAN logs, which return consecutive frames in chunks."""
