"""States of resources as they are told: values with what is to be known of them."""

from __future__ import annotations

import hashlib
from typing import NamedTuple

from werkzeug.http import parse_etags

from relay_protocol import jsontext
from relay_protocol.errors import Refused


class PreconditionFailed(Refused):
    """What was to be changed is not as the asker believes."""

    code = "not_as_before"


class TopicState(NamedTuple):
    """What a topic says.

    Said twice it is the same state, and is told as known: a map that comes anew each time somebody listens is not sent
    again to who has it. Its time differs, so the entity tag is a weak one (RFC 9110 section 8.8.1).

    :param at: Unix seconds at which the relay got it
    :param value: JSON
    """

    topic: str
    type: str
    at: float
    value: bytes

    @property
    def etag(self) -> str:
        """The same for the same value."""
        return tag_of(self.value)

    def json(self) -> bytes:
        """As JSON."""
        return _with_value({"topic": self.topic, "type": self.type, "at": round(self.at, 3)}, self.value)


class ParamState(NamedTuple):
    """A parameter.

    :param name: ``<node>:<parameter>``
    :param value: JSON
    """

    name: str
    value: bytes

    @property
    def etag(self) -> str:
        """The same for the same value."""
        return tag_of(self.value)

    def json(self) -> bytes:
        """As JSON."""
        return _with_value({"name": self.name}, self.value)


def tag_of(value: bytes) -> str:
    """A strong entity tag (RFC 9110 section 8.8.3)."""
    return f'"{hashlib.sha256(value).hexdigest()[:24]}"'


def weak(etag: str) -> str:
    """The tag of a representation that differs in what does not count."""
    return f"W/{etag}"


def see_match(etag: str, match: str) -> None:
    """See that a state is one of those that ``If-Match`` names (RFC 9110 section 13.1.1).

    :raises NotAsBefore: it is none of them
    """
    if not parse_etags(match).contains(etag.strip('"')):
        raise PreconditionFailed("it has changed since you read it; read it again")


def _with_value(head: dict[str, object], value: bytes) -> bytes:
    return jsontext.encode(head)[:-1] + b',"value":' + value + b"}"
