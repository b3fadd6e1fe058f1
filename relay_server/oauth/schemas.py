"""Bodies of requests and answers of ``/oauth``."""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict


class TokenInfo(TypedDict):
    """A token (RFC 6749 section 5.1).

    :param expires_in: seconds
    """

    access_token: str
    token_type: Literal["Bearer"]
    expires_in: int
    scope: NotRequired[str]
    refresh_token: NotRequired[str]


class TokenForm(TypedDict, total=False):
    """The form of a request for a token."""

    grant_type: Literal["password", "client_credentials", "refresh_token"]
    username: str
    password: str
    refresh_token: str
    scope: str
    realm: str
    client_id: str
    client_secret: str


class AboutToken(TypedDict):
    """The token in question. Key and secret of the calling OAuth client may be sent here too."""

    token: str
    client_id: NotRequired[str]
    client_secret: NotRequired[str]


class Introspection(TypedDict):
    """The state of a token (RFC 7662).

    :param iat: Unix seconds
    :param exp: Unix seconds
    :param expires_in: seconds
    """

    active: bool
    token_type: NotRequired[str]
    username: NotRequired[str]
    sub: NotRequired[str]
    realm: NotRequired[str]
    iat: NotRequired[int]
    scope: NotRequired[str]
    client_id: NotRequired[str]
    exp: NotRequired[int]
    expires_in: NotRequired[int]


class Nothing(TypedDict):
    """An empty object."""


class OAuthProblem(TypedDict):
    """An error as in RFC 6749 section 5.2, which is problem details (RFC 9457) as well."""

    type: str
    title: str
    status: int
    detail: str
    error: str
    error_description: str
