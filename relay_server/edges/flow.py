"""Twisted's push producer interface in front of whoever wants to know whether a transport takes bytes."""

from __future__ import annotations

from typing import Protocol


class Pausable(Protocol):
    """Who writes to a transport."""

    def pause(self) -> None:
        """The transport's buffer is full."""

    def resume(self) -> None:
        """The transport takes bytes again."""


class Flow:
    """Register this with a transport (``streaming``)."""

    __slots__ = ("_writes",)

    def __init__(self, writes: Pausable) -> None:
        self._writes = writes

    def pauseProducing(self) -> None:
        """As Twisted says it."""
        self._writes.pause()

    def resumeProducing(self) -> None:
        """As Twisted says it."""
        self._writes.resume()

    def stopProducing(self) -> None:
        """The connection is gone; Twisted tells its protocol too."""
