"""Tokens by OAuth 2.0, with a real relay, a real robot and httpx."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.worlds.http_requests import ask
from tests.worlds.waiting import wait_for

SCOPE = "viewer@rover"


@pytest.fixture(scope="module")
def oauth_client(world: Any) -> Any:
    """An OAuth client of the operator, limited to its scope."""
    return world.relay.cli(
        "oauth-client", "add", "operator", "--scope", f"{SCOPE} call:/reset", "--label", "reader"
    )


@pytest.fixture
def http(world: Any) -> Iterator[httpx.Client]:
    """Requests to the relay."""
    with httpx.Client(base_url=f"http://127.0.0.1:{world.relay.http_port}") as client:
        yield client


def by_digest(http: httpx.Client, oauth_client: Any, **fields: str) -> httpx.Response:
    """A token for the OAuth client, which authenticates by Digest."""
    auth = httpx.DigestAuth(oauth_client["key"], oauth_client["secret"])
    return http.post("/oauth/token", data={"grant_type": "client_credentials", **fields}, auth=auth)


def test_an_oauth_client_proves_itself_by_digest_and_reads_the_robot(
    world: Any, http: httpx.Client, oauth_client: Any
) -> None:
    """Its secret is not sent. Its token follows the scope: it reads the robot and does not move it."""
    challenge = http.post("/oauth/token")
    assert challenge.status_code == 401
    assert "algorithm=SHA-256" in challenge.headers.get_list("www-authenticate")[0]
    # With an empty body curl also asks before it answers.
    assert challenge.json()["error"] == "invalid_client"
    token = by_digest(http, oauth_client).json()["access_token"]
    with world.relay.connect("rover", token) as client:
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        client.until(op="publish", topic="/odom")
        client.send(op="set_level", level="error")
        client.drive(0.3)
        assert "outside the scope of your token" in client.until(op="status")["msg"]


def test_a_token_does_not_show_robots_outside_its_scope(
    world: Any, http: httpx.Client, oauth_client: Any
) -> None:
    """The answers equal those for missing robots."""
    token = by_digest(http, oauth_client, scope="viewer@rov*").json()
    assert token["error"] == "invalid_scope"
    narrow = world.relay.cli("token", "create", "operator", "--scope", "viewer@elsewhere")["token"]
    with pytest.raises(InvalidStatus) as caught:
        world.relay.connect("rover", narrow)
    assert caught.value.response.status_code == 403
    assert ask(world.relay.http_port, "GET", "/api/v1/robots", token=narrow).json == {
        "robots": [],
        "next": "",
    }


def test_a_user_logs_in_refreshes_and_logs_out(world: Any, http: httpx.Client) -> None:
    """A password returns two tokens; the refresh token returns the next two; revoking it cuts open
    connections.
    """
    said = {"grant_type": "password", "username": "viewer", "password": "correct horse"}
    first = http.post("/oauth/token", data=said).json()
    second = http.post(
        "/oauth/token", data={"grant_type": "refresh_token", "refresh_token": first["refresh_token"]}
    ).json()
    bearer = {"Authorization": f"Bearer {world.viewer}"}
    left = http.post("/oauth/introspect", data={"token": second["access_token"]}, headers=bearer).json()
    assert left["active"] and left["username"] == "viewer" and 3590 <= left["expires_in"] <= 3600
    with world.relay.connect("rover", second["access_token"]) as client:
        client.call("/relay/ping")
        answer = http.post("/oauth/revoke", data={"token": second["refresh_token"]}, headers=bearer)
        assert answer.status_code == 200
        with pytest.raises(ConnectionClosed) as caught:
            while True:
                client.receive()
    assert caught.value.rcvd is not None and caught.value.rcvd.code == 4401
    left = http.post("/oauth/introspect", data={"token": second["access_token"]}, headers=bearer).json()
    assert left == {"active": False}


def test_an_oauth_client_that_is_revoked_is_cut(world: Any, http: httpx.Client) -> None:
    """With all its tokens, at once."""
    made = world.relay.cli("oauth-client", "add", "viewer")
    token = by_digest(http, made).json()["access_token"]
    with world.relay.connect("rover", token) as client:
        client.call("/relay/ping")
        world.relay.cli("oauth-client", "revoke", str(made["id"]))
        with pytest.raises(ConnectionClosed):
            while True:
                client.receive()
    assert by_digest(http, made).status_code == 401


@pytest.mark.parametrize(
    ("body", "kind", "status", "error"),
    [
        (b"grant_type=password", "application/x-www-form-urlencoded", 400, "invalid_request"),
        (b"grant_type=a&grant_type=b", "application/x-www-form-urlencoded", 400, "invalid_request"),
        (b"{}", "application/json", 400, "invalid_request"),
        (b"grant_type=%ff", "application/x-www-form-urlencoded", 400, "invalid_request"),
        (
            b"&".join(b"f%d=1" % n for n in range(40)),
            "application/x-www-form-urlencoded",
            400,
            "invalid_request",
        ),
        (b"grant_type=magic", "application/x-www-form-urlencoded", 400, "unsupported_grant_type"),
        (b"client_id=a&client_secret=b", "application/x-www-form-urlencoded", 401, "invalid_client"),
    ],
)
def test_unreadable_request_is_refused_with_a_reason(
    http: httpx.Client, body: bytes, kind: str, status: int, error: str
) -> None:
    """With codes of RFC 6749 section 5.2, never to be cached."""
    answer = http.post("/oauth/token", content=body, headers={"content-type": kind})
    assert (answer.status_code, answer.json()["error"]) == (status, error)
    assert answer.json()["error_description"]
    assert answer.headers["cache-control"] == "no-store"


def test_other_credentials_are_refused(world: Any, http: httpx.Client) -> None:
    """Cookies and other methods are refused, and introspection needs credentials."""
    assert http.get("/oauth/token").status_code == 405
    assert http.post("/oauth/elsewhere").status_code == 404
    assert http.post("/oauth/introspect", data={"token": world.viewer}).status_code == 401
    wrong = {"Authorization": "Bearer swb_wrong"}
    assert http.post("/oauth/revoke", data={"token": world.viewer}, headers=wrong).status_code == 401
    wait_for("the token is still good", lambda: world.relay.connect("rover", world.viewer).close() is None)


def test_rules_of_alerts_take_a_token_for_everything(world: Any) -> None:
    """A token for a single robot must not send alerts of all others elsewhere."""
    narrow = world.relay.cli("token", "create", "operator", "--scope", "owner@rover")["token"]
    port = world.relay.http_port
    for method, path in (
        ("GET", "/api/v1/alerts/rules"),
        ("POST", "/api/v1/alerts/rules"),
        ("DELETE", "/api/v1/alerts/rules/1"),
        ("POST", "/api/v1/alerts/rules/1/test"),
    ):
        body = {"label": "all", "channel": "portal"} if method == "POST" else None
        answer = ask(port, method, path, body, token=narrow)
        assert (answer.status, answer.json["detail"]) == (
            403,
            "this needs an access token without a scope",
        )
    assert ask(port, "GET", "/api/v1/alerts/rules", token=world.operator).status == 200
