"""Roles of realms: which users may see, change and query them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import msgspec
from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred, DeferredLock

from relay_db import queries
from relay_db.queries import NewRole, QuotaExceeded, RoleRecord
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_server.access import Access, Principal
from relay_server.common.database import AsyncDatabase
from relay_server.common.etags import PreconditionFailed, check_match, tag_of
from relay_server.common.token_bucket import Buckets
from relay_server.roles.bindings import Binding, binding_of
from relay_server.roles.documents import FORMATS, LoadedRole
from relay_server.roles.plan import RolePart
from relay_server.roles.process import RoleProcess
from relay_server.roles.schemas import RoleElement, RoleInfo, StoredRole
from relay_server.roles.vocabulary import FIERRO, canonical

ROLES_PER_REALM = 20_000
ROLES_PER_USER = 5_000
STATEMENTS_PER_REALM = 2_000_000

CHANGES_PER_SECOND = 10.0
CHANGES_BURST = 100
USERS = 10_000

RUNNING_PER_USER = 2
"""Documents and queries of one user that run or wait; so one user can't keep all others waiting."""

DOCUMENTS_AT_ONCE = 100
"""Documents that are read from the database at a time."""

NO_ROLE = "there is no such Role, or none that you may see"
"""One answer for both cases."""


class RoleMatchNeeded(Refused):
    """A request that changes a Role lacks ``If-Match``."""

    code = "match_needed"
    http_status = 428


class TooManyRoleChanges(Refused):
    """A user changes Roles too often."""

    code = "too_often"
    http_status = 429


class RoleNameUnavailable(Refused):
    """A name can't be given to a new Role. The error does not say more: the user may not see the Role that has it."""

    code = "name_unavailable"
    http_status = 409


class RoleStarted(Refused):
    """A started Role can't be removed."""

    code = "started"
    http_status = 409


class ElementBindings(NamedTuple):
    """Resources of an element, and of those that are mapped to it."""

    own: list[Binding]
    mapped: list[Binding]


class _GraphContent(NamedTuple):
    """The content of a realm in the process."""

    generation: int
    version: tuple[int, int, int]
    roles: dict[str, RoleRecord]


class RoleService:
    """Roles of all realms.

    A user sees the Roles that they own, and those that refer to robots, if they have a right on all of these.
    Administrators see all of their realm. Owners and administrators may change a Role.

    :param wall: Unix time in seconds
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        database: AsyncDatabase,
        access: Access,
        process: RoleProcess,
        wall: Callable[[], float] = time.time,
        seconds: Callable[[], float] = time.monotonic,
    ) -> None:
        self._database = database
        self._access = access
        self._process = process
        self._wall = wall
        self._buckets = Buckets(CHANGES_PER_SECOND, CHANGES_BURST, USERS, seconds)
        self._running: Counter[int] = Counter()
        self._known: dict[str, _GraphContent] = {}
        self._locks: dict[str, DeferredLock] = {}

    def close(self) -> Deferred[None]:
        """End the process that reads and queries Roles; fires when it has ended."""
        return self._process.close()

    # --- reading ------------------------------------------------------------------------------------------

    async def roles(self, principal: Principal, element: str = "") -> dict[str, RoleInfo]:
        """The Roles that a user may see, by name.

        :param element: only Roles that this element belongs to; its IRI, or its name in ``fierro:``
        :raises Unavailable: the database does not answer
        """
        records = await self._database.read(queries.list_roles, principal.realm)
        found = await self._visible(principal, records)
        if element:
            roles = await self._resolve(principal, element)
            found = [each for each in found if each.name in roles]
        return {each.name: self._info(principal, each) for each in found}

    async def role(self, principal: Principal, name: str) -> RoleInfo:
        """One Role.

        :raises NotFound: there is none that the user may see
        """
        record = await self._database.read(queries.find_role, principal.realm, name)
        if record is None or not await self._visible(principal, [record]):
            raise NotFound(NO_ROLE)
        return self._info(principal, record)

    async def document(self, principal: Principal, name: str) -> str:
        """The statements of a Role, in N-Triples.

        :raises NotFound: there is none that the user may see
        """
        await self.role(principal, name)
        for _, document in await self._database.read(queries.role_documents, principal.realm, [name]):
            return document
        raise NotFound(NO_ROLE)

    async def bindings(self, principal: Principal, name: str, element: str) -> ElementBindings:
        """The resources of an element of a Role.

        :param element: its IRI, or its name in ``fierro:``
        :raises NotFound: there is no such Role that the user may see, or it has no such element
        """
        await self.role(principal, name)
        await self._synchronise(principal.realm)
        iri = iri_of(element)
        found = await self._process.ask("bindings", realm=principal.realm, name=name, text=iri)
        if found is None:
            raise NotFound(f"the Role {name} has no element {element[:100]}")
        own: list[Binding] = []
        mapped: list[Binding] = []
        for item, resource in found:
            binding = binding_of(resource)
            if binding is not None:
                (own if item == iri else mapped).append(binding)
        return ElementBindings(own, mapped)

    async def elements(self, principal: Principal, name: str) -> list[RoleElement]:
        """The named elements of a Role, by name.

        :raises NotFound: there is no such Role that the user may see
        """
        await self.role(principal, name)
        await self._synchronise(principal.realm)
        found = await self._process.ask("elements", realm=principal.realm, name=name)
        elements = [
            RoleElement(
                name=each["iri"].removeprefix(FIERRO),
                types=sorted(each["types"]),
                resources=each["resources"],
                mappings=[iri.removeprefix(FIERRO) for iri in each["mappings"]],
            )
            for each in found
        ]
        return sorted(elements, key=lambda each: each.name)

    async def resources_elsewhere(
        self, principal: Principal, name: str, elements: list[str]
    ) -> dict[str, dict[str, list[str]]]:
        """Resources that elements have in other Roles that the user may see: by the element's and the Role's name.

        :param name: of the Role itself
        """
        if not elements:
            return {}
        names, iris = await self._names(principal), {iri_of(each): each for each in elements}
        answer = await self._process.ask("resources_of", realm=principal.realm, names=names, items=list(iris))
        found: dict[str, dict[str, list[str]]] = {}
        for iri, role, resource in answer:
            if role != name:
                found.setdefault(iris[iri], {}).setdefault(role, []).append(resource)
        return found

    async def missing(self, principal: Principal, name: str) -> list[str]:
        """Sentences about what a Role that the user may see lacks to be started."""
        return list(await self._process.ask("missing", realm=principal.realm, name=name))

    # --- changes ------------------------------------------------------------------------------------------

    async def put(
        self, principal: Principal, name: str, body: bytes, media: str, match: str | None, origin: str
    ) -> tuple[StoredRole, bool]:
        """Add a Role, or replace one; whether it is new.

        :param media: media type of the body
        :param match: ``If-Match``; needed to replace one
        :param origin: the client's address
        :raises InvalidRole: the document lacks what a Role needs
        :raises Refused: the user may not replace this Role, or it has changed
        """
        self.count_change(principal)
        loaded = await self._load(principal, body, media)
        if [each.name for each in loaded] != [name]:
            names = ", ".join(each.name for each in loaded)
            raise Invalid(f"the document is of {names}; put each Role to the address with its name")
        visible = await self._visibility(principal)
        record, new = await self._database.write(self._store, principal, visible, loaded[0], match, origin)
        return StoredRole(self._info(principal, record), loaded[0].notes), new

    async def add(self, principal: Principal, body: bytes, media: str, origin: str) -> list[StoredRole]:
        """Add all Roles of a document, or none of them.

        :param media: media type of the body
        :param origin: the client's address
        :raises InvalidRole: the document lacks what a Role needs
        :raises AlreadyExists: there is one of the Roles
        :raises Refused: one of them can't be added
        """
        self.count_change(principal)
        loaded = await self._load(principal, body, media)
        visible = await self._visibility(principal)
        records = await self._database.write(self._store_new, principal, visible, loaded, origin)
        return [
            StoredRole(self._info(principal, record), each.notes)
            for record, each in zip(records, loaded, strict=True)
        ]

    async def _load(self, principal: Principal, body: bytes, media: str) -> list[LoadedRole]:
        if media not in FORMATS:
            raise Invalid(f"'{media[:40]}' is no form of Roles; use {', '.join(FORMATS)}")
        with self._turn(principal):
            values = await self._process.ask("load", body=body, media=media)
        return [LoadedRole(**each) for each in values]

    async def remove(self, principal: Principal, name: str, match: str | None, origin: str) -> None:
        """Remove a Role.

        :raises NotFound: there is none that the user may see
        :raises Refused: the user may not remove it, or it has changed
        """
        self.count_change(principal)
        await self.role(principal, name)
        await self._database.write(self._remove, principal, name, match, origin)

    def _store(
        self,
        s: Session,
        principal: Principal,
        visible: Callable[[RoleRecord], bool],
        new: LoadedRole,
        match: str | None,
        origin: str,
    ) -> tuple[RoleRecord, bool]:
        old = queries.find_role(s, principal.realm, new.name)
        if match is not None and (old is None or not visible(old)):
            raise PreconditionFailed("it does not exist; read it again")
        if old is not None and not visible(old):
            raise RoleNameUnavailable(f"the name {new.name} can't be used; choose another one")
        if old is not None:
            self._check_change(principal, old, match)
        roles, statements, own = queries.role_totals(s, principal.realm, principal.user_id)
        more = new.statements - (0 if old is None else old.statements)
        if old is None and (roles >= ROLES_PER_REALM or own >= ROLES_PER_USER):
            raise QuotaExceeded(f"a realm has {ROLES_PER_REALM} Roles at most, and a user {ROLES_PER_USER}")
        if statements + more > STATEMENTS_PER_REALM:
            raise QuotaExceeded(f"the Roles of a realm have {STATEMENTS_PER_REALM} statements at most")
        record = store(s, principal.realm, new, principal.user_id, principal.full, self._wall())
        self._audit(s, principal, "role.save", record.name, origin, record.revision)
        return record, old is None

    def _store_new(
        self,
        s: Session,
        principal: Principal,
        visible: Callable[[RoleRecord], bool],
        loaded: list[LoadedRole],
        origin: str,
    ) -> list[RoleRecord]:
        records = []
        for each in loaded:
            old = queries.find_role(s, principal.realm, each.name)
            if old is not None and visible(old):
                raise queries.AlreadyExists(
                    f"there is a Role {each.name} already; remove it first, or replace it alone"
                )
            records.append(self._store(s, principal, visible, each, None, origin)[0])
        return records

    def _remove(self, s: Session, principal: Principal, name: str, match: str | None, origin: str) -> None:
        old = queries.find_role(s, principal.realm, name)
        if old is None:
            raise NotFound(NO_ROLE)
        self._check_change(principal, old, old_match(match))
        check_not_started(s, principal.realm, name)
        queries.remove_role(s, principal.realm, name)
        self._audit(s, principal, "role.remove", name, origin, old.revision)

    def _check_change(self, principal: Principal, old: RoleRecord, match: str | None) -> None:
        if not _is_owner(principal, old):
            raise Refused(
                f"the Role {old.name} belongs to another user; only they and administrators may change it"
            )
        if match is None:
            raise RoleMatchNeeded(f"the Role {old.name} exists; send 'If-Match' with its ETag to replace it")
        if match != "*":
            check_match(tag_of(jsontext.encode(self._info(principal, old))), match)

    def _audit(
        self, s: Session, principal: Principal, action: str, name: str, origin: str, revision: int
    ) -> None:
        queries.append_audit(
            s,
            at=self._wall(),
            actor=f"user:{principal.full}",
            action=action,
            target=f"{name}@{principal.realm}",
            origin=origin,
            data={"revision": revision},
        )

    def count_change(self, principal: Principal) -> None:
        """Count a change of a Role, or a command to an element of one.

        :raises TooManyRoleChanges: the user sends too many
        """
        if not self._buckets.take(principal.user_id):
            raise TooManyRoleChanges("you change Roles too often; try again in a moment")

    # --- queries ------------------------------------------------------------------------------------------

    async def query(
        self, principal: Principal, text: str, rows_media: str, graph_media: str
    ) -> tuple[str, bytes]:
        """Carry out a SPARQL query over the Roles that a user may see: media type and body of the result.

        :raises Invalid: it is not valid, takes too long, or has too many results
        """
        fields: dict[str, Any] = {
            "realm": principal.realm,
            "text": text,
            "media": rows_media,
            "graph_media": graph_media,
        }
        with self._turn(principal):
            names = await self._names(principal)
            media, body = await self._process.ask("query", names=names, **fields)
        return media, body

    @contextmanager
    def _turn(self, principal: Principal) -> Iterator[None]:
        user = principal.user_id
        if self._running[user] >= RUNNING_PER_USER:
            raise Unavailable(
                f"{RUNNING_PER_USER} documents and queries of yours are in progress; wait for one"
            )
        self._running[user] += 1
        try:
            yield
        finally:
            self._running[user] -= 1
            self._running += Counter()

    async def _resolve(self, principal: Principal, element: str) -> frozenset[str]:
        names, iri = await self._names(principal), iri_of(element)
        found = await self._process.ask("roles_of", realm=principal.realm, names=names, text=iri)
        if found is None:
            with self._turn(principal):
                found = await self._process.ask("all_roles_of", realm=principal.realm, names=names, text=iri)
        return frozenset(found)

    async def _names(self, principal: Principal) -> list[str] | None:
        """Names of the Roles that a user may see; ``None`` for all. The graph is up to date then."""
        records = await self._synchronise(principal.realm)
        if principal.admin:
            return None
        return [each.name for each in await self._visible(principal, records.values())]

    async def _synchronise(self, realm: str) -> dict[str, RoleRecord]:
        """Bring the graph of a realm up to the database; the Roles that it has then, by name."""
        lock = self._locks.setdefault(realm, DeferredLock())
        await lock.acquire()
        try:
            self._process.start_process()
            generation, known = self._process.generation, self._known.get(realm)
            version = await self._database.read(queries.role_version, realm)
            if known is not None and (known.generation, known.version) == (generation, version):
                return known.roles
            before = known.roles if known is not None and known.generation == generation else {}
            records = await self._database.read(queries.list_roles, realm)
            now = {each.name: each for each in records}
            await self._send_changes(realm, before, now)
            self._known[realm] = _GraphContent(generation, version, now)
            return now
        except BaseException:
            # Some of it may have arrived; what the process has is no longer known.
            self._known.pop(realm, None)
            raise
        finally:
            lock.release()

    async def _send_changes(
        self, realm: str, before: dict[str, RoleRecord], now: dict[str, RoleRecord]
    ) -> None:
        for name in before.keys() - now.keys():
            await self._process.ask("drop", realm=realm, name=name)
        changed = [name for name, each in now.items() if before.get(name) != each]
        for start in range(0, len(changed), DOCUMENTS_AT_ONCE):
            part = changed[start : start + DOCUMENTS_AT_ONCE]
            for name, document in await self._database.read(queries.role_documents, realm, part):
                await self._process.ask("put", realm=realm, name=name, text=document)

    # --- rights -------------------------------------------------------------------------------------------

    async def _visible(self, principal: Principal, records: Iterable[RoleRecord]) -> list[RoleRecord]:
        return list(filter(await self._visibility(principal), records))

    async def _visibility(self, principal: Principal) -> Callable[[RoleRecord], bool]:
        """Says of a Role whether a user may see it."""
        if principal.admin:
            return lambda record: True
        robots = {each.name for each, _ in await self._access.robots(principal)}
        return lambda record: (
            _is_owner(principal, record) or (bool(record.robots) and robots.issuperset(record.robots))
        )

    @staticmethod
    def _info(principal: Principal, record: RoleRecord) -> RoleInfo:
        return RoleInfo.of(record, _is_owner(principal, record))


def iri_of(element: str) -> str:
    """The IRI of an element by its name in ``fierro:``; an IRI is one already."""
    return canonical(element) if ":" in element else f"{FIERRO}{element}"


def check_not_started(s: Session, realm: str, name: str) -> None:
    """:raises RoleStarted: the Role is started, or parts of it could not be stopped, so it can't be removed"""
    for run in queries.list_role_runs(s, realm, name):
        if not run.reason:
            raise RoleStarted(f"the Role {name} is started; stop it before you remove it")
        if any(each.still_runs for each in msgspec.json.decode(run.parts, type=list[RolePart])):
            raise RoleStarted(
                f"parts of the Role {name} could not be stopped; stop it again before you remove it"
            )


def old_match(match: str | None) -> str:
    """``If-Match`` of a removal, which does not need one."""
    return "*" if match is None else match


def store(s: Session, realm: str, new: LoadedRole, owner_id: int | None, by: str, at: float) -> RoleRecord:
    """Store a Role that was read; see :func:`relay_db.queries.store_role`."""
    values: Any = NewRole(new.name, new.document, new.statements, new.robots)
    return queries.store_role(s, realm, values, owner_id=owner_id, by=by, at=at)


def _is_owner(principal: Principal, record: RoleRecord) -> bool:
    return principal.admin or (principal.scope is None and record.owner_id == principal.user_id)
