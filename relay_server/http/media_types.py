"""Media types of resources, and content negotiation (RFC 9110 sections 12.5.1 and 15.5.7)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from werkzeug.datastructures import MIMEAccept
from werkzeug.http import parse_accept_header, parse_etags

from relay_protocol.errors import Invalid
from relay_server.common.etags import as_given


class MediaType(NamedTuple):
    """One form of a resource.

    :param media: its media type
    :param mark: of a form in RDF, the end of its entity tags, so that the tags of two forms differ
    """

    media: str
    mark: str = ""

    @property
    def is_rdf(self) -> bool:
        """Whether it is one of the forms of RDF."""
        return bool(self.mark)

    def tag(self, base: str) -> str:
        """The entity tag of a state in this form.

        :param base: the entity tag of its JSON
        """
        return f'{base[:-1]}{self.mark}"'

    def bases(self, tags: frozenset[str]) -> frozenset[str]:
        """The tags of JSON for tags of this form. Tags of other forms are left out."""
        others = [each.mark for each in FORMS if each.is_rdf and each is not self]
        found = (each[:-1] for each in tags if each.endswith(f'{self.mark}"'))
        return frozenset(
            each.removesuffix(self.mark) + '"' for each in found if not each.endswith(tuple(others))
        )


JSON = MediaType("application/json")
RDF_XML = MediaType("application/rdf+xml", "-xml")
TURTLE = MediaType("text/turtle", "-ttl")
JSON_LD = MediaType("application/ld+json", "-ld")
FORMS = (JSON, RDF_XML, TURTLE, JSON_LD)
EVENTS = MediaType("text/event-stream")
MSGPACK = MediaType("application/msgpack")


class NotAcceptable(Invalid):
    """The client accepts none of the available forms."""

    code = "not_acceptable"

    def __init__(self, there: Sequence[MediaType]) -> None:
        self.available = [each.media for each in there]
        super().__init__(f"available are {', '.join(self.available)}; 'Accept' names none of them")


class UnsupportedMediaType(Invalid):
    """The media type of a body is not supported."""

    code = "unsupported_media_type"

    def __init__(self, there: Sequence[MediaType]) -> None:
        self.available = [each.media for each in there]
        super().__init__(f"send the body as {', '.join(self.available)}")


def wanted(accept: str | None, there: Sequence[MediaType] = FORMS) -> MediaType:
    """The available form that a client prefers. Among equals, one that it names goes before one that it does not.

    :param accept: the ``Accept`` header
    :raises NotAcceptable: the client accepts none
    """
    if accept is None or not accept.strip():
        return there[0]
    # No form has parameters, so those that a client sends ('charset=utf-8') are ignored.
    listed = [(_bare(name), quality) for name, quality in parse_accept_header(accept, MIMEAccept)]
    named = {name for name, _ in listed}
    accepted = MIMEAccept(listed)
    best = max(there, key=lambda each: (accepted.quality(each.media), each.media in named))
    if accepted.quality(best.media) <= 0:
        raise NotAcceptable(there)
    return best


def preferred(accept: str | None, there: Sequence[MediaType]) -> MediaType:
    """The same, but the first form is sent to a client that accepts none (RFC 9110 section 12.1)."""
    try:
        return wanted(accept, there)
    except NotAcceptable:
        return there[0]


def sent(content_type: str | None, there: Sequence[MediaType] = FORMS) -> MediaType:
    """The form of a request's body.

    :param content_type: its ``Content-Type``
    :param there: forms that are read
    :raises UnsupportedMediaType: the relay does not read this form
    """
    media = _bare(content_type or "")
    for each in there:
        if each.media == media:
            return each
    raise UnsupportedMediaType(there)


def tags_of(header: str | None) -> frozenset[str]:
    """The entity tags that ``If-None-Match`` or ``If-Match`` names."""
    return frozenset(f'"{each}"' for each in as_given(parse_etags(header).as_set(include_weak=True)))


def of_any_form(header: str | None) -> str | None:
    """``If-Match`` with the tags of JSON, whichever form the client has read."""
    if header is None:
        return None
    named = parse_etags(header)
    if named.star_tag:
        return header
    tags = tags_of(header)
    return ", ".join(sorted(frozenset[str]().union(*(each.bases(tags) for each in FORMS)))) or '""'


def _bare(media: str) -> str:
    return media.partition(";")[0].strip().lower()
