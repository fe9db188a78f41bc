"""The `atalante` command line and everything it shows."""
