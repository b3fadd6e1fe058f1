"""The forms a resource is told in, and which of them a request wants (RFC 9110 sections 12.5.1 and 15.5.7)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from werkzeug.datastructures import MIMEAccept
from werkzeug.http import parse_accept_header, parse_etags

from relay_protocol.errors import Invalid


class MediaType(NamedTuple):
    """One of them.

    :param media: its media type
    :param mark: end of its entity tags, so that those of two forms differ; none for JSON
    """

    media: str
    mark: str = ""

    def tag(self, base: str) -> str:
        """The entity tag of a state in this form.

        :param base: that of its JSON
        """
        return f'{base[:-1]}{self.mark}"'

    def bases(self, tags: frozenset[str]) -> frozenset[str]:
        """What tags of this form have as JSON; those of other forms are left out."""
        others = [each.mark for each in FORMS if each.mark and each is not self]
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


class NotAcceptable(Invalid):
    """A request takes none of the forms there are."""

    code = "not_acceptable"

    def __init__(self, there: Sequence[MediaType]) -> None:
        self.available = [each.media for each in there]
        super().__init__(f"this is there as {', '.join(self.available)}; 'Accept' names none of them")


class UnsupportedMediaType(Invalid):
    """A request's body is in a form that is not read."""

    code = "unsupported_media_type"

    def __init__(self) -> None:
        self.available = [each.media for each in FORMS]
        super().__init__(f"send the body as {', '.join(self.available)}")


def wanted(accept: str | None, there: Sequence[MediaType] = FORMS) -> MediaType:
    """The form that a request wants most; the first of those it wants alike, but one that it names before others.

    :param accept: its ``Accept``
    :raises NotAcceptable: there is none that it takes
    """
    if accept is None or not accept.strip():
        return there[0]
    # No form has parameters: who names some ('charset=utf-8') means the form.
    asked = [(_bare(name), quality) for name, quality in parse_accept_header(accept, MIMEAccept)]
    named = {name for name, _ in asked}
    accepted = MIMEAccept(asked)
    best = max(there, key=lambda each: (accepted.quality(each.media), each.media in named))
    if accepted.quality(best.media) <= 0:
        raise NotAcceptable(there)
    return best


def preferred(accept: str | None, there: Sequence[MediaType]) -> MediaType:
    """The same where the first is for everybody, whatever he says he takes (RFC 9110 section 12.1)."""
    try:
        return wanted(accept, there)
    except NotAcceptable:
        return there[0]


def sent(content_type: str | None) -> MediaType:
    """The form a request's body is in.

    :param content_type: its ``Content-Type``
    :raises UnknownForm: it is none that is read
    """
    media = _bare(content_type or "")
    for each in FORMS:
        if each.media == media:
            return each
    raise UnsupportedMediaType


def tags_of(header: str | None) -> frozenset[str]:
    """The entity tags that ``If-None-Match`` names."""
    return frozenset(f'"{each}"' for each in parse_etags(header).as_set(include_weak=True))


def of_any_form(header: str | None) -> str | None:
    """``If-Match`` with the tags that the state has as JSON, whichever form they were read in."""
    if header is None:
        return None
    named = parse_etags(header)
    if named.star_tag:
        return header
    # A weak one is never the same (RFC 9110 section 13.1.1).
    tags = frozenset(f'"{each}"' for each in named.as_set())
    return ", ".join(sorted(frozenset[str]().union(*(each.bases(tags) for each in FORMS)))) or '""'


def _bare(media: str) -> str:
    return media.partition(";")[0].strip().lower()
