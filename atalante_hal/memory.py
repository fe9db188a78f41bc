"""Memory that two processes share: an anonymous file, whose descriptor one hands to the other."""

from __future__ import annotations

import os
import tempfile


def anonymous_file(label: str, size: int) -> int:
    """Descriptor of a zeroed file without a name, in memory where the system can: nothing is left whoever crashes.

    Args:
        label: what /proc shows it as.
        size: bytes.
    """
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create(label, os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor
