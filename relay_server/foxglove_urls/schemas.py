"""Foxglove URLs, as the HTTP API takes them and answers with them."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

DAY = 24 * 3600.0
DEFAULT_SECONDS = 30 * DAY
SHORTEST_SECONDS = 60.0
LONGEST_SECONDS = 366 * DAY

UrlLevel = Literal["viewer", "operator"]
URL_LEVELS: tuple[UrlLevel, ...] = ("viewer", "operator")


class NewFoxgloveUrl(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A URL to make.

    :param level: the most that it allows; never more than its user may do at that moment
    :param expires_in: seconds; by default 30 days
    :param label: what it is for
    """

    level: UrlLevel = "viewer"
    expires_in: Annotated[float, Meta(ge=SHORTEST_SECONDS, le=LONGEST_SECONDS)] = DEFAULT_SECONDS
    label: Annotated[str, Meta(max_length=100)] = ""


class FoxgloveUrl(msgspec.Struct, frozen=True, kw_only=True):
    """A URL, without its token.

    :param created: Unix seconds
    :param expires: Unix seconds
    :param connections: how many are open by it now
    """

    id: str
    robot: str
    level: UrlLevel
    label: str
    created: float
    expires: float
    connections: int


class MadeFoxgloveUrl(FoxgloveUrl, frozen=True, kw_only=True):
    """A URL that was just made. It is shown only in this answer.

    :param url: with its token, for the dialog "Open connection" of Foxglove or Lichtblick
    :param foxglove: opens it in Foxglove's web app, which sends it to Foxglove's server
    :param foxglove_desktop: opens it in Foxglove's desktop app
    :param lichtblick: opens it in Lichtblick's desktop app
    """

    url: str
    foxglove: str
    foxglove_desktop: str
    lichtblick: str


class FoxgloveUrls(msgspec.Struct, frozen=True):
    """The caller's URLs of a robot, oldest first.

    :param levels: that a new URL of the caller may have
    """

    urls: list[FoxgloveUrl]
    levels: list[UrlLevel]
