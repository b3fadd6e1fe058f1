"""Answers with an entity tag, and none to who has it already (RFC 9110 sections 8.8.3 and 13.1.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
from twisted.web.server import Request

from relay_protocol import jsontext
from relay_server.http.api import STREAMED
from relay_server.http.openapi.operation import Response
from relay_server.http.request_params import known_tags
from relay_server.resources.etags import tag_of

TAGGED = {"ETag": "names this state"}


def answers(words: str, body: Any, headers: Mapping[str, str] = TAGGED) -> dict[int, Response]:
    """How such answers are described, for an operation that takes ``KNOWN``.

    :param body: its type
    """
    return {
        200: Response(words, body, headers=headers),
        304: Response("it is as it is known", headers=headers),
    }


def known(request: Request, etag: str) -> bool:
    """Whether who asks has it already, which he is told then; the answer has the tag in any case.

    :param etag: as it goes out; one that is weak is known by what is strong in it
    """
    request.setHeader("etag", etag)
    if etag.removeprefix("W/") not in known_tags(request):
        return False
    request.setResponseCode(304)
    return True


def told(request: Request, body: bytes, etag: str) -> Any:
    """JSON that was asked for, unless who asks has it already.

    :param etag: as in :func:`known`
    """
    return STREAMED if known(request, etag) else msgspec.Raw(body)


def told_facts(request: Request, facts: Any) -> Any:
    """The same of what is another as soon as its JSON is."""
    body = jsontext.encode(facts)
    return told(request, body, tag_of(body))


def changed(request: Request, facts: Any) -> Any:
    """What something is now that it was changed, with the tag that it has from then on."""
    body = jsontext.encode(facts)
    request.setHeader("etag", tag_of(body))
    return msgspec.Raw(body)
