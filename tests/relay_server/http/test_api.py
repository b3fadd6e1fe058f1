"""``/api/v1`` on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from relay_server.auth.authenticator import TicketPurpose
from tests.worlds.http_client import HOST, ORIGIN, World

SESSION = "/api/v1/session"
COOKIE = {"Cookie": "sb=ann"}


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site with an empty portal."""
    return World(tmp_path)


@pytest.mark.parametrize(
    ("tls", "listed", "encrypted"),
    [
        (False, (), False),
        (True, (), True),
        (False, (ORIGIN.replace("http", "https"),), True),
        (False, ("https://other.example", ORIGIN), False),
    ],
)
def test_a_login_sets_a_cookie_that_is_for_this_site_alone(
    tmp_path: Path, tls: bool, listed: tuple[str, ...], encrypted: bool
) -> None:
    """It is hidden from scripts, not sent by other sites, and sent over TLS only where relay or proxy has TLS."""
    world = World(tmp_path, tls, listed=listed)
    answer = world.ask("POST", SESSION, {"user": "ann", "password": "correct horse"})
    assert (answer.status, answer.json) == (200, {"user": "ann", "admin": False, "realm": "main"})
    (cookie,) = answer.cookies
    parts = cookie.lower().split("; ")
    assert parts[0] == ("__host-sb=ann" if encrypted else "sb=ann")
    assert not any(each.startswith("domain") for each in parts)
    assert {"httponly", "samesite=strict", "path=/", "max-age=43200"} <= set(parts)
    assert ("secure" in parts) is encrypted
    assert world.ask("POST", SESSION, {"code": "once"}).json["admin"] is True


BEARER = {"Authorization": "Bearer ann"}
PUBLIC = "https://robots.example"


@pytest.mark.parametrize(
    ("headers", "encrypted"),
    [
        ({"Origin": PUBLIC, "Sec-Fetch-Site": "same-origin"}, True),
        ({"Origin": PUBLIC, "Sec-Fetch-Site": "cross-site"}, False),
        ({"Origin": ORIGIN, "Sec-Fetch-Site": "same-origin"}, False),
        ({}, False),
    ],
)
def test_a_proxy_that_ends_tls_may_send_another_host(
    tmp_path: Path, headers: dict[str, str], encrypted: bool
) -> None:
    """The origin of the portal's own page says that its browser uses TLS."""
    world = World(tmp_path, listed=(PUBLIC,))
    login = {"user": "ann", "password": "correct horse"}
    (cookie,) = world.ask("POST", SESSION, login, **headers).cookies
    assert cookie.startswith("__Host-sb=") is ("secure" in cookie.lower()) is encrypted
    session = cookie.partition(";")[0]
    assert world.ask("GET", SESSION, Cookie=session).status == 200
    gone = world.ask("DELETE", SESSION, Cookie=session, **({"Origin": ORIGIN} | headers))
    assert (gone.status, gone.cookies[0].partition("=")[0]) == (204, cookie.partition("=")[0])


@pytest.mark.parametrize(("host", "status"), [("robots.example", 401), (HOST, 200)])
def test_over_tls_a_cookie_without_the_prefix_does_not_count(tmp_path: Path, host: str, status: int) -> None:
    """Another host of the same domain could have set it."""
    world = World(tmp_path, listed=(PUBLIC,))
    assert world.ask("GET", SESSION, Host=host, Cookie="sb=ann").status == status
    assert world.ask("GET", SESSION, Host=host, Cookie="sb=wrong; __Host-sb=ann").status == 200
    assert world.ask("GET", SESSION, Host=host, Cookie="__Host-sb=wrong; sb=ann").status == 401


@pytest.mark.parametrize(("listed", "sent"), [((), False), ((ORIGIN,), False), ((ORIGIN, PUBLIC), True)])
def test_behind_a_proxy_that_ends_tls_hsts_is_sent(
    tmp_path: Path, listed: tuple[str, ...], sent: bool
) -> None:
    answer = World(tmp_path, listed=listed).ask("GET", "/")
    assert ("strict-transport-security" in answer.headers) is sent


@pytest.mark.parametrize("form", ["{}", "W/{}", "{}-gzip", "{}--gzip", "{}-br", "{};gzip", "W/{}-zstd"])
def test_a_tag_that_a_compressing_proxy_changed_is_known(world: World, form: str) -> None:
    tag = world.ask("GET", SESSION, **BEARER).headers["etag"]
    before, _, after = form.partition("{}")
    again = world.ask("GET", SESSION, If_None_Match=f'"x", {before}{tag[:-1]}{after}"', **BEARER)
    assert again.status == 304
    assert again.headers["etag"] == tag
    other = world.ask("GET", SESSION, If_None_Match=f'{before}"x{after}"', **BEARER)
    assert other.status == 200


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        ({"user": "ann", "password": "wrong"}, 401, "bad_credentials"),
        ({"code": "unknown"}, 401, "bad_credentials"),
        ({"user": "ann", "password": "again"}, 429, "too_many_tries"),
        ({"user": "ann"}, 400, "invalid"),
        ({}, 400, "invalid"),
        ({"user": 7, "password": "x"}, 400, "malformed"),
        ([], 400, "malformed"),
    ],
)
def test_a_failed_login_is_problem_details(world: World, body: Any, status: int, code: str) -> None:
    """It sets no cookie. After too many tries the answer says when to retry."""
    answer = world.ask("POST", SESSION, body)
    assert (answer.status, answer.json["status"], answer.json["code"]) == (status, status, code)
    assert answer.headers["content-type"] == "application/problem+json"
    assert not answer.cookies
    assert answer.headers.get("retry-after") == ("60" if status == 429 else None)
    assert (answer.headers.get("www-authenticate") == "Bearer") is (status == 401)


@pytest.mark.parametrize(
    "kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""]
)
def test_a_form_of_another_page_is_no_login(world: World, kind: str) -> None:
    """Only JSON is read, which no form can send."""
    answer = world.ask("POST", SESSION, {"code": "once"}, Content_Type=kind)
    assert (answer.status, answer.cookies) == (400, [])
    assert kind.startswith("multipart") or "Content-Type: application/json" in answer.json["detail"]


@pytest.mark.parametrize(
    "raw", [b"{", b"\xff", b'{"code":"once","code":"once"}', b'{"code":"a","code":', b"[" * 200]
)
def test_a_body_that_is_not_json_is_an_error(world: World, raw: bytes) -> None:
    assert world.ask("POST", SESSION, raw=raw).status == 400


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:9091", None])
def test_a_cookie_changes_nothing_without_the_own_origin(world: World, origin: str | None) -> None:
    """Logging out and requesting tickets are refused, reading is not; a token needs no Origin."""
    given = {"Origin": origin} if origin else {}
    assert world.ask("DELETE", SESSION, **COOKIE, **given).status == 403
    assert world.ask("POST", "/api/v1/tickets", {"robot": "rover"}, **COOKIE, **given).status == 403
    assert world.ask("GET", SESSION, **COOKIE, **given).status == 200
    assert world.ask("POST", "/api/v1/tickets", {"robot": "rover"}, Authorization="Bearer ann").status == 201


def test_the_session_is_shown_while_the_database_hangs(world: World) -> None:
    """The portal needs it to show its stop button."""
    world.service.up = False
    answer = world.ask("GET", SESSION, **COOKIE)
    assert (answer.status, answer.json["user"]) == (200, "ann")
    assert world.ask("GET", "/api/v1/robots", **COOKIE).status == 503


def test_logging_out_ends_the_session_and_removes_the_cookie(world: World) -> None:
    answer = world.ask("DELETE", SESSION, Origin=ORIGIN, **COOKIE)
    assert (answer.status, answer.body) == (204, b"")
    assert "max-age=0" in answer.cookies[0].lower()
    assert world.ask("GET", SESSION, **COOKIE).status == 401


def test_robots_and_tickets(world: World) -> None:
    """The list has the principal's robots; a robot that does not exist is not found."""
    token = {"Authorization": "Bearer ann"}
    assert world.ask("GET", "/api/v1/robots", **token).json == {
        "robots": [{"name": "rover", "seen by": "ann"}],
        "next": "",
    }
    assert world.ask("GET", "/api/v1/robots/rover", **token).json["name"] == "rover"
    assert world.ask("GET", "/api/v1/robots/tank", **token).status == 404
    ticket = world.ask("POST", "/api/v1/tickets", {"robot": "rover"}, **token)
    assert ticket.json == {
        "ticket": "ticket of ann",
        "expires_in": 60,
        "robot": "rover",
        "for": "robot",
        "camera": "",
    }
    assert world.ask("POST", "/api/v1/tickets", {"robot": "tank"}, **token).status == 404
    assert world.ask("POST", "/api/v1/tickets", {}, **token).status == 400
    for path in ("/api/v1/robots", "/api/v1/robots/rover", "/api/v1/robots/stream", "/metrics"):
        assert world.ask("GET", path).status == 401


def test_robots_come_in_pages_with_entity_tags(world: World) -> None:
    """A new ping does not change the tag. An unknown parameter is an error."""
    token = {"Authorization": "Bearer ann"}
    assert world.ask("GET", "/api/v1/robots?name=t*", **token).json == {"robots": [], "next": ""}
    for wrong in ("limit=0", "type=x", "name=rover&name=rover", "name=" + "*a" * 40):
        assert world.ask("GET", f"/api/v1/robots?{wrong}", **token).status == 400, wrong
    for path in ("/api/v1/robots", "/api/v1/robots/rover"):
        tag = world.ask("GET", path, **token).headers["etag"]
        assert tag.startswith('W/"')
        for known in (tag, tag.removeprefix("W/"), f'"another", {tag}'):
            again = world.ask("GET", path, If_None_Match=known, **token)
            assert (again.status, again.body, again.headers["etag"]) == (304, b"", tag)
        assert world.ask("GET", path, If_None_Match='"another"', **token).status == 200
    form = world.ask("GET", "/api/v1/robots/rover", Accept="text/csv", **token)
    assert form.status == 406 and "text/turtle" in form.json["available"]


@pytest.mark.parametrize(
    ("fields", "opens"),
    [
        ({}, TicketPurpose("rover")),
        ({"for": "robot"}, TicketPurpose("rover")),
        ({"for": "video"}, TicketPurpose("rover", video=True)),
        ({"for": "video", "camera": "/eye"}, TicketPurpose("rover", video=True, camera="/eye")),
        ({"camera": "/eye"}, None),
        ({"for": "everything"}, None),
        ({"for": "video", "camera": "x" * 1000}, None),
    ],
)
def test_a_ticket_is_for_the_websocket_or_for_cameras(
    world: World, fields: dict[str, str], opens: TicketPurpose | None
) -> None:
    """Other purposes get an error."""
    answer = world.ask("POST", "/api/v1/tickets", {"robot": "rover", **fields}, Authorization="Bearer ann")
    assert answer.status == (400 if opens is None else 201)
    assert world.service.tickets == ([] if opens is None else [opens])


def test_health_shows_whether_the_database_answers(world: World) -> None:
    """It needs no credentials. Other requests get 503 while the database does not answer."""
    for path in ("/healthz", "/readyz", "/livez"):
        assert world.ask("GET", path).json == {"status": "ok"}
    world.service.up = False
    answer = world.ask("GET", "/healthz")
    assert (answer.status, answer.json["title"]) == (503, "Unavailable")
    # Robots can be stopped, so a load balancer goes on sending clients here.
    assert world.ask("GET", "/readyz").status == 200
    assert world.ask("GET", "/api/v1/robots", Authorization="Bearer ann").status == 503


def test_metrics_are_for_administrators(world: World) -> None:
    assert world.ask("GET", "/metrics", Authorization="Bearer ann").status == 403
    answer = world.ask("GET", "/metrics", Authorization="Bearer root")
    assert answer.status == 200
    assert answer.headers["content-type"].startswith("text/plain")


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/api/v1/nothing", 404),
        ("GET", "/api/", 404),
        ("PUT", SESSION, 405),
        ("DELETE", "/healthz", 405),
    ],
)
def test_unknown_path_answers_problem_details(world: World, method: str, path: str, status: int) -> None:
    """404 and 405 too."""
    answer = world.ask(method, path)
    assert (answer.status, answer.json["status"]) == (status, status)
    assert answer.headers["content-type"] == "application/problem+json"


def test_an_error_of_the_relay_discloses_nothing(world: World) -> None:
    """500, with a general message."""
    answer = world.ask("POST", SESSION, {"code": "break"})
    assert answer.status == 500
    assert b"insides" not in answer.body
