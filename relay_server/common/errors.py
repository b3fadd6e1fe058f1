"""Errors that several features raise."""

from __future__ import annotations

from relay_protocol.errors import SwitchboardError, Unavailable


class NothingReceived(Unavailable):
    """A subscription or a stream is open, but nothing was received in time."""

    code = "nothing_came"


class NotDone(SwitchboardError):
    """A valid request was not carried out; the message says why."""

    code = "not_done"
