"""Recorder of the frames that the HALs in a test send. Each HAL has its own file, which `command_limits` checks.

Frames are written as soon as they are sent, so the frames of a killed process are kept. `start` records the HALs of this
process, and stores the path of the files in an environment variable. Every Python subprocess imports `sitecustomize`, which
is in the folder of this module and records the HALs of the subprocess.
"""

from __future__ import annotations

import importlib.abc
import importlib.util
import itertools
import os
import sys
from typing import Any

MODULE = "atalante_hal.transceiver"
FOLDER = "ATALANTE_WITNESS"
#: Numbers for the HALs of this process.
_numbers = itertools.count()


def watch(transceiver_type: type[Any]) -> None:
    """Make every transceiver of this class record what it sends. Raises AttributeError if the class has no `send`."""
    make, send = transceiver_type.__init__, transceiver_type.send

    def init(transceiver: Any, *arguments: Any, **options: Any) -> None:
        transceiver.witness = None
        make(transceiver, *arguments, **options)

    def send_and_write(transceiver: Any, batch: Any) -> Any:
        if transceiver.witness is None:
            folder = os.environ[FOLDER]
            path = os.path.join(folder, f"{os.getpid()}-{next(_numbers)}.frames")
            transceiver.witness = os.open(
                path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_EXCL | os.O_CLOEXEC, 0o600
            )
            _close_with(transceiver)
        sent = send(transceiver, batch)  # raises if the transmit table denies a frame
        os.write(transceiver.witness, batch.frames.tobytes())
        return sent

    transceiver_type.__init__, transceiver_type.send = init, send_and_write


def _close_with(transceiver: Any) -> None:
    import weakref

    weakref.finalize(transceiver, os.close, transceiver.witness)


class _Finder(importlib.abc.MetaPathFinder):
    """Import hook that records the HALs as soon as their module is imported."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
        if name != MODULE:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.loader is not None
        execute = spec.loader.exec_module

        def execute_and_watch(module: Any) -> None:
            execute(module)
            watch(module.Transceiver)

        spec.loader.exec_module = execute_and_watch  # type: ignore[method-assign]
        return spec


def install() -> None:
    """Record the HALs of this process, even if their module is imported later; a second call has no effect."""
    if getattr(sys, "_atalante_witness", False):
        return
    sys._atalante_witness = True  # type: ignore[attr-defined]
    if MODULE in sys.modules:
        watch(sys.modules[MODULE].Transceiver)
    else:
        sys.meta_path.insert(0, _Finder())


def start(folder: str) -> None:
    """Record the HALs of this process and of every process that it starts later."""
    here = os.path.dirname(__file__)
    known = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path and path != here]
    os.environ["PYTHONPATH"] = os.pathsep.join([here, *known])
    os.environ[FOLDER] = folder
    install()
