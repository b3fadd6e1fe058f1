"""The HTTP API over real sockets: authentication, cookies, and rights."""

from __future__ import annotations

import http.client
import json
import re
import stat
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tests.worlds.http_requests import Answer, ask
from tests.worlds.relay_process import Relay
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

PASSWORD = "correct horse"


def own_origin(relay: Any) -> dict[str, str]:
    """The Origin of the relay's own portal."""
    return {"Origin": f"http://127.0.0.1:{relay.http_port}"}


def log_in(relay: Any, user: str, password: str = PASSWORD) -> Answer:
    """Logs in by password, as the portal does."""
    body = {"user": user, "password": password}
    return ask(relay.http_port, "POST", "/api/v1/session", body, headers=own_origin(relay))


@pytest.fixture
def cookie(world: Any) -> dict[str, str]:
    """A new session of the operator, as a header."""
    return {"Cookie": log_in(world.relay, "operator").cookie}


def ticket(world: Any, robot: str = "rover") -> str:
    """A websocket ticket of the operator."""
    answer = ask(world.relay.http_port, "POST", "/api/v1/tickets", {"robot": robot}, token=world.operator)
    assert answer.status == 201
    return str(answer.json["ticket"])


# --- logging in -------------------------------------------------------------------------------------------


def test_the_first_start_prints_a_link_that_makes_one_administrator_once(tmp_path: Path) -> None:
    """A relay without users who can log in prints a one-time link; its second use is refused with a reason."""
    relay = Relay(tmp_path)
    try:
        assert relay.process is not None
        found = re.search(r"http://127\.0\.0\.1:(\d+)/login#code=(\S+)", relay.process.said())
        assert found is not None
        assert int(found[1]) == relay.http_port
        first = ask(relay.http_port, "POST", "/api/v1/session", {"code": found[2]}, headers=own_origin(relay))
        assert first.status == 200
        assert first.json == {"user": "admin", "admin": True, "realm": "main"} | {
            "realm": first.json["realm"]
        }
        again = ask(relay.http_port, "POST", "/api/v1/session", {"code": found[2]}, headers=own_origin(relay))
        assert again.status == 401
        assert "already used" in again.json["detail"]
        session = ask(relay.http_port, "GET", "/api/v1/session", headers={"Cookie": first.cookie})
        assert session.json["user"] == "admin"
        assert found[2] not in relay.log
    finally:
        relay.stop()


def test_a_password_gives_a_session_in_a_cookie_that_scripts_and_other_sites_never_see(world: Any) -> None:
    """The cookie is HttpOnly and SameSite=Strict, and authenticates alone."""
    answer = log_in(world.relay, "operator")
    assert answer.status == 200
    assert answer.json["user"] == "operator"
    flags = {each.strip().lower() for each in answer.headers["Set-Cookie"].split(";")[1:]}
    assert {"httponly", "samesite=strict", "path=/"} <= flags
    session = ask(world.relay.http_port, "GET", "/api/v1/session", headers={"Cookie": answer.cookie})
    assert session.json["user"] == "operator"
    assert ask(world.relay.http_port, "GET", "/api/v1/session").status == 401


def test_an_unknown_user_and_a_wrong_password_get_the_same_answer(world: Any) -> None:
    """The answer does not disclose which users exist."""
    unknown = log_in(world.relay, "no-such-user", "wrong password")
    wrong = log_in(world.relay, "viewer", "wrong password")
    assert unknown.status == wrong.status == 401
    assert unknown.body == wrong.body
    assert unknown.headers.keys() == wrong.headers.keys()


def test_the_eleventh_wrong_password_is_refused_before_it_is_hashed(world: Any) -> None:
    """Ten failures, then 429 with Retry-After, even for the right password, without hashing; other users are
    not affected.
    """
    world.relay.user("forgetful")
    relay = psutil.Process(world.relay.process.popen.pid)

    def cpu() -> float:
        times = relay.cpu_times()
        return float(times.user + times.system)

    begun = cpu()
    assert [log_in(world.relay, "forgetful", "wrong password").status for _ in range(10)] == [401] * 10
    hashed = cpu() - begun
    begun = cpu()
    refused = [log_in(world.relay, "forgetful", "wrong password") for _ in range(10)]
    cheap = cpu() - begun
    assert {each.status for each in refused} == {429}
    assert 0 < int(refused[0].headers["Retry-After"]) <= 900
    assert "try again in" in refused[0].json["detail"]
    assert log_in(world.relay, "forgetful").status == 429
    assert log_in(world.relay, "operator").status == 200
    assert cheap < hashed / 2


def test_a_login_from_a_foreign_page_or_in_another_form_is_refused(world: Any) -> None:
    """A page elsewhere cannot log its visitor in here, neither by script nor by a form."""
    body = {"user": "operator", "password": PASSWORD}
    foreign = {"Origin": "https://evil.example"}
    assert ask(world.relay.http_port, "POST", "/api/v1/session", body, headers=foreign).status == 403
    form = {**own_origin(world.relay), "Content-Type": "text/plain"}
    answer = ask(world.relay.http_port, "POST", "/api/v1/session", body, headers=form)
    assert answer.status == 400
    assert "application/json" in answer.json["detail"]


# --- cookies ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", [None, "https://evil.example", "null", "http://127.0.0.1:1"])
def test_a_cookie_changes_nothing_without_the_relays_own_origin(
    world: Any, cookie: dict[str, str], origin: str | None
) -> None:
    """A request that changes state by cookie needs a listed Origin, with the port."""
    headers = {**cookie, **({"Origin": origin} if origin else {})}
    answer = ask(world.relay.http_port, "POST", "/api/v1/tickets", {"robot": "rover"}, headers=headers)
    assert answer.status == 403
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert ask(world.relay.http_port, "DELETE", "/api/v1/session", headers=headers).status == 403
    good = {**cookie, **own_origin(world.relay)}
    assert (
        ask(world.relay.http_port, "POST", "/api/v1/tickets", {"robot": "rover"}, headers=good).status == 201
    )


def test_a_websocket_by_cookie_needs_the_relays_own_origin(world: Any, cookie: dict[str, str]) -> None:
    """From the portal it opens; a program gets 403, a foreign page 4403 with a reason."""
    url = world.relay.url("rover")
    with Client(connect(url, additional_headers=cookie, origin=own_origin(world.relay)["Origin"])) as client:
        assert client.call("/relay/ping")["result"]
    with pytest.raises(InvalidStatus) as refused:
        Client(connect(url, additional_headers=cookie))
    assert refused.value.response.status_code == 403
    with connect(url, additional_headers=cookie, origin="https://evil.example") as foreign:
        with pytest.raises(ConnectionClosed) as closed:
            foreign.recv(PATIENCE)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4403
        assert "--origin" in closed.value.rcvd.reason


def test_logging_out_ends_the_session_and_the_websockets_opened_with_it(
    world: Any, cookie: dict[str, str]
) -> None:
    """Websockets opened by its cookie or ticket are closed with 4401; other sessions stay."""
    headers = {**cookie, **own_origin(world.relay)}
    issued = ask(world.relay.http_port, "POST", "/api/v1/tickets", {"robot": "rover"}, headers=headers).json
    url = world.relay.url("rover")
    opened = [
        Client(connect(url, additional_headers=cookie, origin=headers["Origin"])),
        Client(connect(f"{url}?ticket={issued['ticket']}")),
    ]
    unused = ask(world.relay.http_port, "POST", "/api/v1/tickets", {"robot": "rover"}, headers=headers).json
    with world.relay.connect("rover", world.operator) as other:
        for client in opened:
            assert client.call("/relay/ping")["result"]
        answer = ask(world.relay.http_port, "DELETE", "/api/v1/session", headers=headers)
        assert answer.status == 204
        for client in opened:
            with pytest.raises(ConnectionClosed) as closed:
                client.receive()
                client.receive()
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 4401
            client.close()
        assert ask(world.relay.http_port, "GET", "/api/v1/session", headers=cookie).status == 401
        with pytest.raises(InvalidStatus):
            Client(connect(f"{url}?ticket={unused['ticket']}"))
        assert other.call("/relay/ping")["result"]


# --- robots -----------------------------------------------------------------------------------------------


def test_everyone_sees_the_robots_they_have_a_right_on_and_no_other(world: Any) -> None:
    """The list has state and level; without rights it is empty, and a robot without a right is not found."""
    port = world.relay.http_port
    newcomer = world.relay.user("newcomer")
    world.relay.cli("right", "grant", "newcomer", "rover", "viewer")
    world.robot.wait_online()
    mine = ask(port, "GET", "/api/v1/robots", token=newcomer).json["robots"]
    assert [(each["name"], each["level"]) for each in mine] == [("rover", "viewer")]
    assert mine[0]["state"] in ("online", "in_use")
    assert mine[0]["platform"] == "ros2"
    assert ask(port, "GET", "/api/v1/robots", token=world.stranger).json == {"robots": [], "next": ""}
    assert ask(port, "GET", "/api/v1/robots/rover", token=world.viewer).json["name"] == "rover"
    foreign = ask(port, "GET", "/api/v1/robots/rover", token=world.stranger)
    missing = ask(port, "GET", "/api/v1/robots/none", token=world.stranger)
    assert foreign.status == missing.status == 404
    assert foreign.body == missing.body
    assert ask(port, "GET", "/api/v1/robots").status == 401


def test_robots_are_listed_in_pages_each_once(world: Any) -> None:
    """By name, with a cursor; a request with the entity tag of an unchanged list gets 304."""
    port = world.relay.http_port
    names = [f"shelf-{each}" for each in "abc"]
    reader = world.relay.user("shelf-reader")
    for name in names:
        world.relay.cli("robot", "add", name)
        world.relay.cli("right", "grant", "shelf-reader", name, "viewer")

    def listed(query: str) -> tuple[list[str], str]:
        page = ask(port, "GET", f"/api/v1/robots{query}", token=reader).json
        return [each["name"] for each in page["robots"]], page["next"]

    assert listed("") == listed("?name=shelf-*") == (names, "")
    assert listed("?limit=2") == (names[:2], names[1])
    assert listed(f"?limit=2&after={names[1]}") == (names[2:], "")
    assert listed("?name=*-b") == ([names[1]], "")
    refused = ask(port, "GET", "/api/v1/robots?state=online", token=reader)
    assert refused.status == 400 and "'state'" in refused.json["detail"]
    for path in ("/api/v1/robots", "/api/v1/robots?limit=1", f"/api/v1/robots/{names[0]}"):
        known = {"If-None-Match": ask(port, "GET", path, token=reader).headers["ETag"]}
        assert ask(port, "GET", path, token=reader, headers=known).status == 304
        world.relay.cli("robot", "describe", names[0], f"told at {path}")
        look = partial(ask, port, "GET", path, token=reader, headers=known)
        wait_for("it is another", lambda look=look: look().status == 200)
        assert f"told at {path}" in look().body.decode()


def states(stream: http.client.HTTPResponse) -> Iterator[str]:
    """States of the rover in a stream of events, one after the other."""
    while line := stream.readline():
        if line.startswith(b"data: "):
            # Alerts arrive on the same stream.
            robots = json.loads(line.removeprefix(b"data: ")).get("robots", ())
            yield from (each["state"] for each in robots if each["name"] == "rover")


def test_the_stream_reports_robots_that_leave_and_return(world: Any) -> None:
    """Server-sent events have the state of the caller's robots: offline when the daemon ends, then online."""
    connection = http.client.HTTPConnection("127.0.0.1", world.relay.http_port, timeout=60)
    headers = {"Authorization": f"Bearer {world.viewer}"}
    try:
        connection.request("GET", "/api/v1/robots/stream", headers=headers)
        stream = connection.getresponse()
        assert stream.getheader("Content-Type") == "text/event-stream"
        reported = states(stream)
        assert next(reported) != "offline"
        assert world.robot.daemon.stop() == 0
        assert next(each for each in reported if each == "offline")
        world.robot.start_daemon()
        assert next(each for each in reported if each == "online")
    finally:
        connection.close()
        world.wait_known()


def test_a_page_follows_by_websocket_until_its_session_ends(world: Any, cookie: dict[str, str]) -> None:
    """By its cookie and the relay's own origin; other pages are closed, and a robot's ticket is refused."""
    url = f"ws://127.0.0.1:{world.relay.http_port}/api/v1/robots/stream"
    headers = {**cookie, **own_origin(world.relay)}
    with connect(url, additional_headers=cookie, origin=headers["Origin"]) as page:
        reported = json.loads(page.recv(PATIENCE))
        assert reported["event"] == "robots"
        (rover,) = (each for each in reported["data"]["robots"] if each["name"] == "rover")
        listed = ask(world.relay.http_port, "GET", "/api/v1/robots/rover", headers=cookie).json
        assert rover.keys() == listed.keys()
        assert json.loads(page.recv(PATIENCE))["event"] == "alerts"
        assert ask(world.relay.http_port, "DELETE", "/api/v1/session", headers=headers).status == 204
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                page.recv(PATIENCE)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4401
    with connect(url, additional_headers=cookie, origin="http://evil.example") as page:
        with pytest.raises(ConnectionClosed) as closed:
            page.recv(PATIENCE)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4403
    with pytest.raises(InvalidStatus) as refused:
        connect(f"{url}?ticket={ticket(world)}").__enter__()
    assert refused.value.response.status_code == 401


def test_a_ticket_opens_one_websocket_to_one_robot(world: Any) -> None:
    """A second use and another robot are refused, and a user without a right gets no ticket."""
    single = ticket(world)
    with Client(connect(f"{world.relay.url('rover')}?ticket={single}")) as client:
        assert client.call("/relay/ping")["result"]
    for url in (
        f"{world.relay.url('rover')}?ticket={single}",
        f"{world.relay.url('x')}?ticket={ticket(world)}",
    ):
        with pytest.raises(InvalidStatus) as refused:
            Client(connect(url))
        assert refused.value.response.status_code == 401
    denied = ask(world.relay.http_port, "POST", "/api/v1/tickets", {"robot": "rover"}, token=world.stranger)
    assert denied.status == 404


def test_a_plain_get_of_a_robots_websocket_names_its_protocol(world: Any) -> None:
    """The first request of rosbridge clients is answered with product and version."""
    about = ask(world.relay.http_port, "GET", "/robots/rover")
    assert about.status == 200
    assert about.json["product"] == "switchboard"
    assert re.fullmatch(r"\d+\.\d+\.\d+.*", about.json["version"])


# --- operations -------------------------------------------------------------------------------------------


def test_health_is_for_everyone_and_metrics_for_administrators(world: Any) -> None:
    """/healthz answers without credentials, /metrics only to an administrator, with real values."""
    port = world.relay.http_port
    chief = world.relay.user("chief", admin=True)
    assert ask(port, "GET", "/healthz").json == {"status": "ok"}
    assert ask(port, "GET", "/metrics").status == 401
    assert ask(port, "GET", "/metrics", token=world.operator).status == 403
    with world.relay.connect("rover", world.viewer) as client:
        assert client.call("/relay/ping")["result"]
        # Other robots may exist, and a delayed robot reconnects over time.
        for figure in (r"switchboard_clients", r'switchboard_robots\{state="in_use"\}'):
            pattern = re.compile(rf"^{figure} [1-9]", re.MULTILINE)
            wait_for(
                f"{figure} is told",
                lambda pattern=pattern: pattern.search(
                    ask(port, "GET", "/metrics", token=chief).body.decode()
                ),
            )


def test_missing_resource_answers_problem_details(world: Any) -> None:
    """Unknown addresses and methods get reasons, and no path leads out of the portal's folder."""
    port = world.relay.http_port
    for path in ("/api/v1/nothing", "/nothing", "/assets/../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd"):
        answer = ask(port, "GET", path)
        assert answer.status == 404
        assert answer.headers["Content-Type"] == "application/problem+json"
        assert answer.json["detail"]
    assert ask(port, "PUT", "/api/v1/robots", {}).status == 405


def test_the_portal_comes_with_headers_that_close_what_browsers_leave_open(world: Any) -> None:
    """A strict content security policy, no sniffing, no framing, no referrer."""
    page = ask(world.relay.http_port, "GET", "/")
    assert page.status == 200
    policy = page.headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "script-src" not in policy
    assert "frame-ancestors 'none'" in policy
    assert page.headers["X-Content-Type-Options"] == "nosniff"
    assert page.headers["Referrer-Policy"] == "no-referrer"


def test_secrets_are_in_no_log_no_process_list_and_no_file_others_can_read(world: Any) -> None:
    """Tokens, passwords, cookies, tickets and codes."""
    relay = world.relay
    session = log_in(relay, "operator")
    code = relay.cli("robot", "add", "secretive")["enrolment_code"]
    done = world.robot.enroll(code, relay.robots_port, "--replace")
    assert code not in done.stdout + done.stderr
    single = ticket(world)
    with connect(f"{relay.url('rover')}?ticket={single}"):
        pass
    ask(relay.http_port, "GET", f"/api/v1/session?token={world.operator}")
    secrets = [PASSWORD, world.operator, world.viewer, session.cookie.partition("=")[2], single, code]
    lines = [" ".join(each.info["cmdline"] or []) for each in psutil.process_iter(["cmdline"])]
    daemon_log = world.robot.daemon.log.read_text()
    assert relay.log
    assert daemon_log
    for secret in secrets:
        assert secret not in relay.log
        assert secret not in daemon_log
        assert not any(secret in line for line in lines)
    for folder in (relay.data, world.robot.state):
        assert folder.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO) == 0, f"{folder.name} is open to others"


def test_the_relay_has_logged_no_failure_of_its_own(world: Any) -> None:
    """The requests above caused no failure of the relay."""
    wait_for("the relay answers", lambda: ask(world.relay.http_port, "GET", "/healthz").status == 200)
    assert "Traceback" not in world.relay.log
