"""What a request to a resource asks for, in its address and its headers."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta
from twisted.web.server import Request
from werkzeug.http import parse_dict_header, parse_etags

from relay_protocol.errors import Invalid
from relay_server.http.media_types import EVENTS, JSON, preferred
from relay_server.http.openapi.operation import header, query
from relay_server.http.time_limit import allow
from relay_server.resources.page import LONGEST, PAGE

WAIT = 60.0
"""Longest that a request may wait for something, seconds."""

APPLIED = "preference-applied"
"""The header of an answer that names what was preferred, and is so (RFC 7240 section 3)."""

LISTING = (
    query("name", "a name, with shell wildcards"),
    query("type", "a type"),
    query("limit", f"most of an answer; {PAGE} where left out", Annotated[int, Meta(ge=1, le=LONGEST)]),
    query("after", "the name behind which the page begins"),
)
"""What a page is asked for by (:class:`relay_server.resources.page.PageQuery`)."""

UNTYPED = tuple(each for each in LISTING if each.name != "type")
"""The same where the members have no types."""

KNOWN = header("If-None-Match", "entity tags of what is known already")


def query_of(request: Request) -> dict[str, str]:
    """The parameters of the address.

    :raises Invalid: a parameter twice, or not in UTF-8
    """
    found = {}
    for name, values in request.args.items():
        if len(values) > 1:
            raise Invalid(f"the parameter '{name.decode(errors='replace')[:40]}' is there more than once")
        try:
            found[name.decode()] = values[0].decode()
        except UnicodeDecodeError as error:
            raise Invalid(f"a parameter is not in UTF-8: {error.reason}") from None
    return found


def number_in(query: dict[str, str], name: str, least: float, most: float) -> float | None:
    """One of the parameters.

    :raises Invalid: it is no number, or outside of its bounds
    """
    if name not in query:
        return None
    number = _number(query[name])
    if not least <= number <= most:
        raise Invalid(f"'{name}' must be a number from {least:g} to {most:g}")
    return number


def field(request: Request, name: str) -> str | None:
    """A header whose value is a list: all lines of it as one (RFC 9110 section 5.3)."""
    lines = request.requestHeaders.getRawHeaders(name)
    return None if lines is None else ", ".join(lines)


def known_tags(request: Request) -> frozenset[str]:
    """The entity tags that the asker has already (``If-None-Match``)."""
    tags = parse_etags(field(request, "if-none-match"))
    return frozenset(f'"{each}"' for each in tags.as_set(include_weak=True))


def wait_preferred(request: Request, least: float = 0.0) -> float | None:
    """How long an answer may be waited for, seconds, as ``Prefer: wait`` says (RFC 7240 section 4.3).

    The answer is told that it is so. What is no number or less than the least is passed over, as preferences are
    (``None``), and no wait is longer than :data:`WAIT`.

    :raises Invalid: the header is not in UTF-8
    """
    try:
        said = parse_dict_header(field(request, "prefer") or "")
    except UnicodeDecodeError as error:
        raise Invalid(f"'prefer' is not in UTF-8: {error.reason}") from None
    text = next((text for name, text in said.items() if name.lower() == "wait"), None)
    seconds = _number((text or "").partition(";")[0])
    if not seconds >= least:
        return None
    seconds = min(seconds, WAIT)
    allow(request, seconds)
    request.setHeader(APPLIED, f"wait={seconds:g}")
    return seconds


def streams(request: Request) -> bool:
    """Whether what happens is wanted as server-sent events."""
    return preferred(field(request, "accept"), (JSON, EVENTS)) is EVENTS


def _number(text: str) -> float:
    """What stands there; no number is ``nan``."""
    try:
        return float(text)
    except ValueError:
        return float("nan")
