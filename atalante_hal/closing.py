"""Base class of objects that hold a resource until they are closed: files, processes, memory, sessions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Closing(ABC):
    """Context manager that calls `close()` at the end of the block, even after an exception."""

    @abstractmethod
    def close(self) -> object:
        """Release the resource."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
