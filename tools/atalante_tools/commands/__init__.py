"""Subcommands of `atalante` that run, emulate or observe the robot, one module per command."""
