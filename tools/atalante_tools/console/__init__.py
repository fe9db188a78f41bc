"""Parts that all commands share: options, output, exit codes and stop requests."""
