"""Roles with a real relay: documents over HTTP and by the command line, rights, and queries."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from rdflib import Graph
from rdflib.compare import isomorphic

from tests.worlds.relay_process import Relay

LISTING = Path("docs/examples/roles/gamepad.rdf").read_bytes()
NAME = "GamePad-Drive-Motors"
ROLE = f"/api/v1/roles/{NAME}"
XML = {"Content-Type": "application/rdf+xml"}
QUERY = "SELECT ?role { GRAPH ?role { ?s fierro:subject ?o } }"


class People:
    """A relay with the robot ``pad``, an administrator, an operator of ``pad``, and a user without rights."""

    def __init__(self, relay: Relay) -> None:
        self.relay = relay
        relay.cli("robot", "add", "pad")
        tokens = {name: relay.user(name, admin=name == "root") for name in ("root", "ann", "bob")}
        relay.cli("right", "grant", "ann", "pad", "operator")
        self.clients = {
            name: httpx.Client(
                base_url=f"http://127.0.0.1:{relay.http_port}",
                headers={"Authorization": f"Bearer {token}"},
                timeout=60,
            )
            for name, token in tokens.items()
        }

    def names(self, user: str, **query: str) -> list[str]:
        """Names of the Roles that a user sees."""
        answer = self.clients[user].get("/api/v1/roles", params=query)
        assert answer.status_code == 200, answer.text
        return [each["name"] for each in answer.json()["roles"]]


@pytest.fixture(scope="module")
def people(tmp_path_factory: pytest.TempPathFactory) -> Iterator[People]:
    relay = Relay(tmp_path_factory.mktemp("roles"))
    made = People(relay)
    yield made
    for client in made.clients.values():
        client.close()
    relay.stop()


@pytest.fixture
def stored(people: People) -> Iterator[httpx.Response]:
    """The Role of the listing, stored by the administrator."""
    answer = people.clients["root"].put(ROLE, content=LISTING, headers=XML)
    assert answer.status_code == 201, answer.text
    yield answer
    people.clients["root"].delete(ROLE)


def test_a_role_comes_back_as_it_was_put(people: People, stored: httpx.Response) -> None:
    before = Graph().parse(data=LISTING, format="xml")
    for media in ("application/rdf+xml", "text/turtle", "application/ld+json"):
        answer = people.clients["ann"].get(ROLE, headers={"Accept": media})
        assert answer.status_code == 200, answer.text
        assert isomorphic(Graph().parse(data=answer.content, format=media), before)
    plain = people.clients["root"].get(ROLE)
    assert plain.json() == stored.json()["role"]
    assert (plain.json()["revision"], plain.json()["robots"]) == (1, ["pad"])
    assert plain.headers["etag"] == stored.headers["etag"]


def test_only_users_with_a_right_on_its_robots_see_a_role(people: People, stored: httpx.Response) -> None:
    assert [people.names(each) for each in ("root", "ann", "bob")] == [[NAME], [NAME], []]
    assert people.clients["bob"].get(ROLE).status_code == 404
    rows = {
        each: people.clients[each]
        .get("/api/v1/sparql", params={"query": QUERY})
        .json()["results"]["bindings"]
        for each in people.clients
    }
    assert [len(rows[each]) for each in ("root", "ann", "bob")] == [1, 1, 0]
    assert people.clients["ann"].put(ROLE, content=LISTING, headers=XML).status_code == 403
    assert people.clients["ann"].delete(ROLE).status_code == 403
    assert people.clients["bob"].delete(ROLE).status_code == 404
    hidden = people.clients["bob"].put(ROLE, content=LISTING, headers=XML)
    assert (hidden.status_code, hidden.json()["code"]) == (409, "name_unavailable")
    for name in (NAME, "Nothing"):
        put = people.clients["bob"].put(
            f"/api/v1/roles/{name}", content=LISTING.replace(NAME.encode(), name.encode()),
            headers={**XML, "If-Match": "*"},
        )  # fmt: skip
        assert put.status_code == 412, put.text


def test_an_element_leads_to_its_role(people: People, stored: httpx.Response) -> None:
    assert people.names("ann", element="AXIS_0") == [NAME]
    assert people.names("ann", element="fierro:GamePadX") == [NAME]
    assert people.names("ann", element="AXIS_9") == []


def test_a_change_needs_the_state_that_was_read(people: People, stored: httpx.Response) -> None:
    root = people.clients["root"]
    assert root.put(ROLE, content=LISTING, headers=XML).status_code == 428
    assert root.put(ROLE, content=LISTING, headers={**XML, "If-Match": '"old"'}).status_code == 412
    read = root.get(ROLE, headers={"Accept": "text/turtle"})
    again = root.put(ROLE, content=LISTING, headers={**XML, "If-Match": read.headers["etag"]})
    assert (again.status_code, again.json()["role"]["revision"]) == (200, 2)


def test_a_document_adds_all_of_its_roles_or_none(people: People) -> None:
    root, turtle = people.clients["root"], {"Content-Type": "text/turtle"}
    text = "@prefix fierro: <fierro:> ." + "".join(
        f"fierro:{name} a fierro:role ; fierro:subject fierro:A ; fierro:action fierro:B ; "
        "fierro:directObject fierro:C ."
        for name in ("First", "Second")
    )
    added = root.post("/api/v1/roles", content=text, headers=turtle)
    assert (added.status_code, [each["role"]["name"] for each in added.json()["roles"]]) == (
        201,
        ["First", "Second"],
    )
    root.delete("/api/v1/roles/First")
    refused = root.post("/api/v1/roles", content=text, headers=turtle)
    assert (refused.status_code, "a Role Second already" in refused.json()["detail"]) == (409, True)
    assert people.names("root") == ["Second"]
    root.delete("/api/v1/roles/Second")


def test_missing_parts_are_listed(people: People) -> None:
    answer = people.clients["root"].put(
        "/api/v1/roles/R",
        content="<fierro:R> a <fierro:role> ; <fierro:subjekt> <fierro:S> .",
        headers={"Content-Type": "text/turtle"},
    )
    assert (answer.status_code, len(answer.json()["problems"])) == (422, 1)
    other = people.clients["root"].put("/api/v1/roles/R", content=LISTING, headers=XML)
    assert (other.status_code, NAME in other.json()["detail"]) == (400, True)


@pytest.mark.parametrize(
    ("body", "accept", "expected"),
    [
        (
            {"content": QUERY, "headers": {"Content-Type": "application/sparql-query", "Accept": "text/csv"}},
            "text/csv",
            f"role\r\nfierro:{NAME}\r\n",
        ),
        ({"data": {"query": "ASK { ?s ?p ?o }"}}, "application/sparql-results+json", '"boolean":true'),
        (
            {
                "data": {"query": "CONSTRUCT WHERE { ?s fierro:port ?o }"},
                "headers": {"Accept": "application/rdf+xml"},
            },
            "application/rdf+xml",
            "fierro:Port_5",
        ),
    ],
)
def test_queries_have_the_forms_of_the_protocol(
    people: People, stored: httpx.Response, body: dict[str, Any], accept: str, expected: str
) -> None:
    answer = people.clients["ann"].post("/api/v1/sparql", **body)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"].startswith(accept)
    assert expected in answer.text


def test_bad_queries_are_refused_with_a_reason(people: People) -> None:
    root = people.clients["root"]
    for query in ("SELECT", "DROP ALL", "SELECT * " + "{" * 5000 + "}" * 5000):
        answer = root.post("/api/v1/sparql", data={"query": query})
        assert answer.status_code == 400, answer.text
    answer = root.post("/api/v1/sparql", data={"update": "DROP ALL"})
    assert (answer.status_code, "'query'" in answer.json()["detail"]) == (400, True)


def test_the_command_line_and_the_relay_have_the_same_roles(people: People, tmp_path: Path) -> None:
    relay = people.relay
    assert relay.cli("role", "load", "docs/examples/roles/gamepad.rdf")[0]["name"] == NAME
    assert people.names("ann", element="AXIS_0") == [NAME]
    assert [each["name"] for each in relay.cli("role", "list", "--element", "Port_6")] == [NAME]
    saved = tmp_path / "saved.ttl"
    assert relay.run_cli("role", "save", NAME, "-o", str(saved)).returncode == 0
    assert isomorphic(Graph().parse(saved), Graph().parse(data=LISTING, format="xml"))
    assert "fierro:GamePadX" in relay.run_cli("role", "show", NAME).stdout
    rows = relay.run_cli("role", "query", "SELECT ?port { ?p fierro:port ?port }").stdout.split()
    assert sorted(rows) == ["fierro:Port_5", "fierro:Port_6", "port"]
    relay.cli("role", "remove", NAME, "--yes")
    assert people.names("root", element="AXIS_0") == []
    actions = [each["action"] for each in relay.cli("audit", "list")]
    assert [each for each in actions if each.startswith("role.")][-2:] == ["role.save", "role.remove"]
