"""When a request can't have been sent before: it gives back the moment that an earlier answer named.

Requests carry no sending time one could trust, and a connection says nothing where a proxy keeps it open. But whoever
gives back a moment has sent his request after he had read it (as with pings, see
:mod:`relay_server.sessions.message_age`).
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable

from relay_protocol.errors import Refused

HEADER = "switchboard-moment"
"""The header field, of answers and of requests."""

NEEDED = f"say when this was sent, by giving back the '{HEADER}' of this or the latest answer"
"""What those are told who do not."""

_KEY_BYTES = 32
_SIGNATURE = 16
"""Hexadecimal digits; whoever guesses right makes his own commands seem younger, and no others."""


class FreshnessTokenRequired(Refused):
    """A request that moves a robot, or lets it move again, does not say when it was sent."""

    code = "moment_needed"


class FreshnessTokenExpired(Refused):
    """A request that moves a robot may have been sent too long ago."""

    code = "too_old"


class FreshnessTokens:
    """Makes and reads them. Those of a relay that ran before mean nothing to this one.

    :param clock_ns: the relay's monotonic nanoseconds
    """

    def __init__(self, clock_ns: Callable[[], int]) -> None:
        self._clock_ns = clock_ns
        self._key = secrets.token_bytes(_KEY_BYTES)

    def now(self) -> str:
        """This moment."""
        text = format(self._clock_ns(), "x")
        return f"{text}.{self._sign(text)}"

    def read(self, text: str | None) -> int | None:
        """The monotonic nanoseconds of a moment, if a request names one.

        :raises MomentNeeded: it is none of this relay's
        """
        if text is None:
            return None
        said, _, signature = text.strip().partition(".")
        if not hmac.compare_digest(signature.encode(), self._sign(said).encode()):
            raise FreshnessTokenRequired(
                f"'{HEADER}' is no moment of this relay; give back the one of its latest answer"
            )
        return int(said, 16)

    def needed(self, text: str | None) -> int:
        """The same where nothing is done without one.

        :raises MomentNeeded: the request names none, or none of this relay's
        """
        moment = self.read(text)
        if moment is None:
            raise FreshnessTokenRequired(NEEDED)
        return moment

    def _sign(self, text: str) -> str:
        return hmac.digest(self._key, text.encode(), "sha256").hex()[:_SIGNATURE]
