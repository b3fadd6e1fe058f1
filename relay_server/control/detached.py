"""Work that is finished whoever stops waiting for it: who asked may hang up, what was ordered may not be forgotten."""

from __future__ import annotations

from collections.abc import Coroutine
from typing import Any, TypeVar

from twisted.internet.defer import Deferred

T = TypeVar("T")


def detached(work: Coroutine[Deferred[Any], Any, T]) -> Deferred[T]:
    """Start a piece of work; what comes back fires with its result, and may be cancelled without ending it."""
    waiting: Deferred[T] = Deferred()
    # A Deferred that was cancelled passes over the one result that still comes.
    Deferred.fromCoroutine(work).addCallbacks(waiting.callback, waiting.errback)
    return waiting
