"""The `atalante` command line: its commands, their console output, and the setup of a run."""
