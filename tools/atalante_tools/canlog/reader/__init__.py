"""Readers of CAN logs, which return the frames in chunks."""
