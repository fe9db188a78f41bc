"""Readers of CAN logs. They return consecutive frames in chunks."""
