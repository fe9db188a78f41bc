"""Shared parts of the commands: options, output, exit codes and stop requests."""
