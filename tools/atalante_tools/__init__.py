"""The `atalante` command line: commands, console output, and the assembly of a run."""
