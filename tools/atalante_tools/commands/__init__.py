"""Subcommands of `atalante` that run, emulate or observe the robot. Each command has its own module."""
