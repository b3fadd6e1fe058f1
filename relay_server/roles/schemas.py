"""Shapes of Roles over HTTP."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from relay_db.queries import RoleRecord
from relay_protocol.limits import NAME


class RoleInfo(msgspec.Struct, frozen=True):
    """A Role without its statements.

    :param revision: grows with each change
    :param statements: how many there are
    :param robots: names of the robots that it refers to
    :param by: full name of the user who changed it last
    :param at: Unix seconds of that change
    :param yours: whether you may change it
    """

    name: str
    revision: int
    statements: int
    robots: list[str]
    by: str
    at: float
    yours: bool

    @classmethod
    def of(cls, record: RoleRecord, yours: bool) -> RoleInfo:
        """The info of a record."""
        return cls(
            record.name, record.revision, record.statements, record.robots, record.by, record.at, yours
        )


class RolePage(msgspec.Struct, frozen=True):
    """A page of Roles.

    :param next: ``after`` of the next page, or empty
    """

    roles: list[RoleInfo]
    next: str


class RoleElement(msgspec.Struct, frozen=True):
    """A named element of a Role.

    :param name: in `fierro:`, or its IRI
    :param types: such as `field` or `process`
    :param resources: that it is bound to, as the document has them
    :param mappings: elements that it is mapped to
    """

    name: str
    types: list[str]
    resources: list[str]
    mappings: list[str]


class RoleElementPage(msgspec.Struct, frozen=True):
    """A page of elements.

    :param next: `after` of the next page, or empty
    """

    elements: list[RoleElement]
    next: str


class ElementValue(msgspec.Struct, frozen=True):
    """The value of an element.

    :param resource: that it was read from
    :param value: of a topic the newest message, or its field; of a module or pipe its state
    """

    role: str
    element: str
    resource: str
    value: Any


class NewElementValue(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A value to set.

    :param value: of the element's field. For a whole message an object, or the value of its field `data`
    :param type: of a topic that no node has yet
    """

    value: Any
    type: Annotated[str, Meta(max_length=NAME)] = ""


class ElementCall(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of a call.

    :param args: an object, or a list in the order of the fields
    :param timeout: seconds
    """

    args: Any = {}
    timeout: Annotated[float, Meta(ge=0.1, le=300.0)] = 10.0


class ElementDone(msgspec.Struct, frozen=True):
    """A command that was carried out.

    :param resource: that took it
    :param values: the answer of a service; null for others
    :param state: of a module or pipe, as far as it is known
    """

    role: str
    element: str
    command: str
    resource: str
    values: Any = None
    state: str = ""


RunState = Literal["stopped", "starting", "running", "partial", "ended"]


class RolePartState(msgspec.Struct, frozen=True):
    """A part of a Role that is started.

    :param element: its name; of a mapping, both names
    :param resource: a module, a pipe, or a topic or service of a device
    :param state: of the module or pipe; `on` for a device; `failed` if it could not be started
    :param why: what it waits for, or why it failed
    """

    element: str
    resource: str
    state: str
    why: str


class RoleRunState(msgspec.Struct, frozen=True):
    """Whether a Role is started.

    :param state: `running`: all parts are up; `starting`: some are coming; `partial`: some are not up and will not be;
        `ended`: the relay ended it, or a stop could not stop all parts
    :param why: why it has ended
    :param by: the user who started it, by whose rights it runs
    :param at: Unix seconds of its start
    :param parts: in the order of starting; of a Role that is stopped or has ended, those that failed. Empty for
        other users than the one who started it and those who may change the Role
    """

    role: str
    state: RunState
    why: str = ""
    by: str = ""
    at: float | None = None
    parts: list[RolePartState] = []


class StoredRole(msgspec.Struct, frozen=True):
    """A Role that was stored.

    :param notes: sentences about statements that are unusual, but allowed
    """

    role: RoleInfo
    notes: list[str]


class StoredRoles(msgspec.Struct, frozen=True):
    """The Roles of a document, which were added."""

    roles: list[StoredRole]


class RoleText(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A document of a Role within JSON.

    :param media: ``application/rdf+xml``, ``text/turtle`` or ``application/ld+json``
    """

    media: str
    text: str


class SparqlForm(msgspec.Struct, frozen=True):
    """A query as a form or as ``application/sparql-query``."""

    query: str
