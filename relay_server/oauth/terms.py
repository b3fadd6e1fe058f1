"""What is asked for, what is issued, and what is wrong with it (RFC 6749)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from relay_protocol.errors import Refused
from relay_protocol.scopes import Scope


class OAuthError(Refused):
    """No token, and why, in the words of RFC 6749 section 5.2.

    :param error: such as ``invalid_grant``
    """

    code = "oauth"

    def __init__(self, error: str, words: str) -> None:
        super().__init__(words)
        self.error = error


@dataclass(frozen=True)
class TokenAsk:
    """The body of a request for a token.

    :param scope: what it is to be used for; ``None`` for all that is possible
    :param realm: in which a program wants to act, where that is not the one of its user
    """

    grant_type: str
    username: str = ""
    password: str = ""
    refresh_token: str = ""
    scope: str | None = None
    realm: str | None = None


@dataclass(frozen=True)
class Granted:
    """What is issued.

    :param expires_in: seconds
    :param refresh_token: ``None`` where there is none: a program has its secret
    """

    access_token: str
    expires_in: float
    scope: Scope | None
    refresh_token: str | None = None

    def told(self) -> dict[str, Any]:
        """As JSON (section 5.1)."""
        told: dict[str, Any] = {
            "access_token": self.access_token,
            "token_type": "Bearer",
            "expires_in": int(self.expires_in),
        }
        if self.scope is not None:
            told["scope"] = str(self.scope)
        if self.refresh_token is not None:
            told["refresh_token"] = self.refresh_token
        return told
