"""``/api/v1/roles`` and ``/api/v1/sparql``: Roles of the caller's realm as documents, and queries over them."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import parse_qs

import msgspec
from msgspec import Meta

from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME
from relay_server.common.etags import tag_of
from relay_server.http.endpoint import (
    ApiRequest,
    Created,
    Document,
    Endpoint,
    IdempotencyKey,
    Representation,
    Tagged,
    endpoint,
)
from relay_server.http.media_types import FORMS, MediaType, of_any_form, preferred
from relay_server.resources.page import PageQuery
from relay_server.resources.representations import ConversionPool
from relay_server.roles.documents import write
from relay_server.roles.schemas import RoleInfo, RolePage, RoleText, SparqlForm, StoredRole, StoredRoles
from relay_server.roles.service import RoleService
from relay_server.roles.sparql import GRAPH_FORMATS, RESULTS_CSV, RESULTS_JSON, RESULTS_XML

BASE_PATH = "/api/v1/roles"
SPARQL_PATH = "/api/v1/sparql"

MAX_QUERY = 64 * 1024
"""Characters of a query."""

ROWS = tuple(MediaType(each) for each in (RESULTS_JSON, RESULTS_XML, RESULTS_CSV))
GRAPHS = tuple(MediaType(each) for each in GRAPH_FORMATS)

_SECONDS = 15.0
_MORE = (
    "Read only, over the Roles that you may see; each is a named graph. SELECT and ASK give JSON, XML or CSV, "
    "CONSTRUCT and DESCRIBE Turtle, RDF/XML, JSON-LD or N-Triples. At most 5 s, 10,000 rows and 4 MiB."
)


class RoleQuery(PageQuery, frozen=True, forbid_unknown_fields=True):
    """A page of Roles.

    :param element: only Roles that this element belongs to, itself or by mappings: its IRI, or its name in `fierro:`
    """

    element: Annotated[str, Meta(max_length=NAME)] = ""


class SparqlQuery(msgspec.Struct, frozen=True):
    """A query.

    :param query: in SPARQL 1.1
    """

    query: Annotated[str, Meta(max_length=MAX_QUERY)]


class RoleEndpoints:
    """Roles of the caller's realm.

    :param threads: write RDF
    """

    def __init__(self, service: RoleService, threads: ConversionPool) -> None:
        self._service = service
        self._threads = threads

    async def read_body(
        self, request: ApiRequest, endpoint: Endpoint, form: MediaType, name: str = ""
    ) -> RoleText:
        """A document in RDF."""
        try:
            return RoleText(form.media, request.content().decode("utf-8-sig"))
        except UnicodeDecodeError as error:
            raise Invalid(f"the document is not UTF-8 (byte {error.start})") from None

    @endpoint("GET", BASE_PATH, tag="roles", summary="The Roles that you may see", returns="a page")
    async def list(self, request: ApiRequest, query: RoleQuery) -> RolePage:
        found, after = query.page(await self._service.roles(request.principal, query.element), lambda _: ())
        return RolePage([each for _, each in found], after)

    @endpoint(
        "POST",
        BASE_PATH,
        tag="roles",
        summary="Add the Roles of a document",
        more="All of them or none. Each gets the statements that it leads to. 409: one of them exists. 422 lists under "
        "`problems` what the document lacks, each with the statement concerned.",
        returns={201: "added"},
        reads=FORMS,
        key=IdempotencyKey.REFUSED,
        errors=(409, 422),
        seconds=_SECONDS,
    )
    async def add(self, request: ApiRequest, body: RoleText) -> Created[StoredRoles]:
        principal, content = request.principal, body.text.encode()
        stored = await self._service.add(principal, content, body.media, request.address)
        return Created(StoredRoles(stored), location=BASE_PATH)

    @endpoint(
        "GET",
        f"{BASE_PATH}/{{name}}",
        tag="roles",
        summary="One Role",
        more="In JSON without its statements.",
        returns="the Role",
        forms=FORMS,
    )
    async def one(self, request: ApiRequest, name: str) -> Representation[RoleInfo]:
        principal = request.principal
        found = await self._service.role(principal, name)

        async def render(form: MediaType) -> bytes:
            document = await self._service.document(principal, name)
            return await self._threads.run(write, [document], form.media)

        return Representation(found, render)

    @endpoint(
        "PUT",
        f"{BASE_PATH}/{{name}}",
        tag="roles",
        summary="Add a Role, or replace its document",
        more="The document has exactly this Role. To replace one, `If-Match` is needed. 422 lists under `problems` "
        "what the document lacks, each with the statement concerned.",
        returns={201: "added", 200: "replaced"},
        reads=FORMS,
        if_match=True,
        errors=(409, 422, 428),
        seconds=_SECONDS,
    )
    async def put(
        self, request: ApiRequest, name: str, body: RoleText
    ) -> Created[StoredRole] | Tagged[StoredRole]:
        match = of_any_form(request.header("if-match"))
        stored, new = await self._service.put(
            request.principal, name, body.text.encode(), body.media, match, request.address
        )
        etag = tag_of(msgspec.json.encode(stored.role))
        return Created(stored, etag, location=f"{BASE_PATH}/{name}") if new else Tagged(stored, etag)

    @endpoint(
        "DELETE",
        f"{BASE_PATH}/{{name}}",
        tag="roles",
        summary="Remove a Role",
        more="One that is started must be stopped first.",
        returns="removed",
        if_match=True,
        errors=(409,),
    )
    async def remove(self, request: ApiRequest, name: str) -> None:
        match = of_any_form(request.header("if-match"))
        await self._service.remove(request.principal, name, match, request.address)

    @endpoint(
        "GET",
        SPARQL_PATH,
        tag="roles",
        summary="Query Roles with SPARQL",
        more=_MORE,
        returns="the result",
        forms=(*ROWS, *GRAPHS),
        seconds=_SECONDS,
    )
    async def query(self, request: ApiRequest, query: SparqlQuery) -> Document:
        return await self._answer(request, query.query)

    @endpoint(
        "POST",
        SPARQL_PATH,
        tag="roles",
        summary="Query Roles with SPARQL",
        more=f"The body is a form with `query`, or `application/sparql-query`. {_MORE}",
        returns="the result",
        forms=(*ROWS, *GRAPHS),
        raw_body=SparqlForm,
        seconds=_SECONDS,
    )
    async def post_query(self, request: ApiRequest) -> Document:
        media = (request.header("content-type") or "").partition(";")[0].strip().lower()
        try:
            text = request.content().decode()
        except UnicodeDecodeError as error:
            raise Invalid(f"the query is not UTF-8 (byte {error.start})") from None
        if media == "application/x-www-form-urlencoded":
            text = _form_query(text)
        elif media != "application/sparql-query":
            raise Invalid(
                "send the query as 'application/sparql-query', or as a form with the field 'query'; updates are not "
                "supported"
            )
        return await self._answer(request, text)

    async def _answer(self, request: ApiRequest, text: str) -> Document:
        if len(text) > MAX_QUERY:
            raise Invalid(f"the query has {len(text)} characters; {MAX_QUERY} are allowed")
        accept = request.header("accept")
        media, body = await self._service.query(
            request.principal, text, preferred(accept, ROWS).media, preferred(accept, GRAPHS).media
        )
        return Document(body, f"{media}; charset=utf-8")


def _form_query(text: str) -> str:
    try:
        fields = parse_qs(text, max_num_fields=8, strict_parsing=True)
    except ValueError:
        fields = {}
    if len(fields.get("query", ())) != 1 or len(fields) != 1:
        raise Invalid("the form must have the field 'query', once, and no other")
    return fields["query"][0]
