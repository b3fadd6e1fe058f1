"""Freshness tokens: proof that a request was sent after an answer of this relay (SPEC 1.13).

Requests carry no trustworthy sending time, and a proxy may keep a connection open. But a client that returns the token
of an answer has sent its request after it read that answer (as with pings, see
:mod:`relay_server.sessions.keepalive`).
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable

from relay_protocol.errors import Refused

HEADER = "switchboard-freshness"
"""Header field of answers and requests."""

PARAMETER = "freshness"
"""Query parameter of requests that may move a robot, for clients that can't set a header."""

NEEDED = f"prove that this is fresh: give back the '{HEADER}' of this or the latest answer"
"""Error text for a request that needs a token and has none."""

_KEY_BYTES = 32
_SIGNATURE = 16
"""Hexadecimal digits. A client that guesses them can only make its own commands seem younger."""


class FreshnessTokenRequired(Refused):
    """A request that moves or resumes a robot has no freshness token of this relay."""

    code = "freshness_required"


class FreshnessTokenExpired(Refused):
    """A request that moves a robot may have been sent too long ago."""

    code = "too_old"


class FreshnessTokens:
    """Makes and reads freshness tokens. Tokens of an earlier run of the relay are not valid.

    :param clock_ns: the relay's monotonic nanoseconds
    """

    def __init__(self, clock_ns: Callable[[], int]) -> None:
        self._clock_ns = clock_ns
        self._key = secrets.token_bytes(_KEY_BYTES)

    def now(self) -> str:
        """A token for an answer that is sent now."""
        text = format(self._clock_ns(), "x")
        return f"{text}.{self._sign(text)}"

    def read(self, text: str | None) -> int | None:
        """When a token was made, monotonic nanoseconds; ``None``: there is no token.

        :raises FreshnessTokenRequired: it is no token of this relay
        """
        if text is None:
            return None
        made_at, _, signature = text.strip().partition(".")
        if not hmac.compare_digest(signature.encode(), self._sign(made_at).encode()):
            raise FreshnessTokenRequired(
                f"'{HEADER}' is no token of this relay; give back the one of its latest answer"
            )
        return int(made_at, 16)

    def needed(self, text: str | None) -> int:
        """As :meth:`read`, for a request that needs a token.

        :raises FreshnessTokenRequired: there is no token, or it is no token of this relay
        """
        made_at = self.read(text)
        if made_at is None:
            raise FreshnessTokenRequired(NEEDED)
        return made_at

    def _sign(self, text: str) -> str:
        return hmac.digest(self._key, text.encode(), "sha256").hex()[:_SIGNATURE]
