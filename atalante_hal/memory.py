"""Memory that two processes share: one process creates an anonymous file and passes its descriptor to the other process."""

from __future__ import annotations

import os
import tempfile


def anonymous_file(label: str, size: int) -> int:
    """Create a zeroed file without a name and return its descriptor.

    The file is in memory if the system supports it. It is removed when the last process has closed it, even after a crash.

    Args:
        label: Name shown in /proc.
        size: Size of the file [bytes].

    Returns:
        File descriptor, owned by the caller.
    """
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create(label, os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor
