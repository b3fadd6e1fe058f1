"""Real proxies with the configurations of docs/operate/behind_a_proxy.md, between clients, a relay and a robot."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, expect
from websockets.exceptions import ConnectionClosed

from robot_client.apps.blocking_websocket import BlockingWebsocket
from tests.worlds.browser import portal
from tests.worlds.certificates import Authority
from tests.worlds.processes import running
from tests.worlds.proxies import HOST, Proxy, path_stripping_proxy, proxy
from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import SmallRobot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

PASSWORD = "correct horse"
ORIGIN = f"https://{HOST}"
BEHIND = ("--origin", ORIGIN, "--requests-per-second", "0", "--connections-per-network", "20000")
API = "/api/v1/robots/rover"
TEXT = "0123456789abcdef" * 131_072
"""2 MiB: more than nginx accepts by default."""

REQUEST = 40 * 1024
ANSWER = 512 * 1024
"""Bytes of it in the answer of a service; a robot's JSON is at most a MiB."""


class Site:
    """A proxy in front of a relay with one robot, which connects by the proxy where that takes robots.

    :param server: see :func:`tests.worlds.proxies.proxy`
    """

    def __init__(self, server: str, folder: Path, parts: ExitStack) -> None:
        authority = Authority(folder, "ca")
        chain, key = folder / "chain.pem", folder / "key.pem"
        authority.certify(chain, key)
        own = () if server in ("nginx", "haproxy") else ("--tls-cert", str(chain), "--tls-key", str(key))
        self.relay = Relay(folder / "relay", *BEHIND, *own)
        parts.callback(self.relay.stop)
        self.proxy: Proxy = parts.enter_context(proxy(server, self.relay, authority, folder / "proxy"))
        self.token = self.relay.user("dora")
        encoded, picture = cv2.imencode(".jpg", np.full((24, 32, 3), 90, np.uint8))
        assert encoded
        self.robot = SmallRobot(
            self.relay,
            "rover",
            {"/say": lambda *_: {"success": True, "message": TEXT[:ANSWER]}},
            port=self.proxy.robots_port,
            context=self.proxy.context,
        )
        self.relay.cli("right", "grant", "dora", "rover", "operator")
        self.robot.picture = picture.tobytes()
        self.robot.comes()
        parts.callback(self.robot.goes)

    def _dial(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.proxy.port), PATIENCE)

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> http.client.HTTPResponse:
        """The answer to a request; its body may still come."""
        connection = http.client.HTTPConnection(HOST)
        connection.sock = self.proxy.context.wrap_socket(self._dial(), server_hostname=HOST)
        sent = {"Authorization": f"Bearer {self.token}", "Content-Type": "application/json", **headers}
        connection.request(method, path, None if body is None else json.dumps(body), sent)
        return connection.getresponse()

    def connect(self, query: str = "", **headers: str) -> Client:
        """A websocket to the robot."""
        return Client(
            BlockingWebsocket(
                f"wss://{HOST}/robots/rover{query}",
                sock=self._dial(),
                ssl=self.proxy.context,
                additional_headers=headers,
                open_timeout=PATIENCE,
                max_size=None,
            )
        )


@pytest.fixture(scope="module", params=["nginx", "haproxy", "caddy", "apache2"])
def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Each proxy, for all tests."""
    with ExitStack() as parts:
        site = Site(request.param, tmp_path_factory.mktemp(request.param), parts)
        yield site
        # First, since some proxies wait for open connections when they end.
        site.relay.stop()


def test_a_login_has_a_strict_cookie_and_pages_of_others_are_refused(site: Site) -> None:
    login = {"user": "dora", "password": PASSWORD}
    refused = site.ask("POST", "/api/v1/session", login, Origin="https://elsewhere.example", Authorization="")
    assert refused.status == 403
    answer = site.ask("POST", "/api/v1/session", login, Origin=ORIGIN, Authorization="")
    assert answer.status == 200, answer.read()
    cookie = answer.headers["Set-Cookie"]
    assert cookie.startswith("__Host-") and "; Secure" in cookie
    assert "max-age" in answer.headers["Strict-Transport-Security"]
    sent = {"Cookie": cookie.partition(";")[0], "Origin": ORIGIN}
    assert site.ask("GET", "/api/v1/session", Authorization="", **sent).status == 200
    with site.connect(**sent) as client:
        assert client.call("/say")["result"]
    # The portal's page and its files.
    page = site.ask("GET", "/login", Authorization="").read().decode()
    assert "<title>Switchboard</title>" in page


def test_messages_of_any_size_pass_both_ways(site: Site) -> None:
    with site.connect(Authorization=f"Bearer {site.token}") as client:
        assert client.call("/say")["values"]["message"] == TEXT[:ANSWER]
        client.send(op="publish", topic="/mode", type="std_msgs/msg/String", msg={"data": TEXT})
        wait_for("the robot has the message", lambda: {"data": TEXT} in site.robot.heard)
    # In the path the slash of a name is encoded.
    sent = site.ask("POST", f"{API}/topics/%2Fmode", {"value": {"data": TEXT[:REQUEST]}})
    assert sent.status == 204, sent.read()
    wait_for("the robot has that too", lambda: {"data": TEXT[:REQUEST]} in site.robot.heard)


def test_events_and_pictures_come_at_once_though_nothing_follows(site: Site) -> None:
    events = site.ask("GET", "/api/v1/events?robot=rover", Accept="text/event-stream")
    assert events.status == 200
    published = site.ask(
        "POST", "/api/v1/events", {"kind": "greeted", "robot": "rover", "data": {"person": "ann"}}
    )
    assert published.status in (200, 201, 204), published.read()
    while b"greeted" not in events.readline():
        pass
    events.close()
    stream = site.ask("GET", "/robots/rover/video/stream?topic=/camera")
    assert stream.status == 200, stream.read()
    seen = b""
    while site.robot.picture not in seen:
        seen += stream.read1()
    stream.close()


def test_a_cut_has_its_code_and_reason(site: Site) -> None:
    made = site.relay.cli("token", "create", "dora", "--ttl", "1h")
    with site.connect(Authorization=f"Bearer {made['token']}") as client:
        client.call("/say", {})
        site.relay.cli("token", "revoke", str(made["id"]))
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                client.receive()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 4401
    assert closed.value.rcvd.reason


def test_tickets_are_not_logged(site: Site) -> None:
    ticket = json.loads(site.ask("POST", "/api/v1/tickets", {"robot": "rover"}).read())["ticket"]
    with site.connect(f"?ticket={ticket}") as client:
        client.call("/say", {})
    if site.proxy.log.exists():
        wait_for("the request is logged", lambda: "/robots/rover" in site.proxy.log.read_text())
        assert ticket not in site.proxy.log.read_text()


@pytest.fixture(scope="module")
def below_a_path(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Relay, str]]:
    """A relay, and its URL at a proxy that strips a path."""
    folder = tmp_path_factory.mktemp("below")
    relay = Relay(folder / "relay")
    with running(relay), path_stripping_proxy(relay, folder / "proxy") as url:
        yield relay, url


def test_below_a_path_the_portal_says_that_it_needs_a_host(
    below_a_path: tuple[Relay, str], browser: Browser
) -> None:
    portal()
    relay, url = below_a_path
    said = "It needs a host of its own"
    with closing(browser.new_page()) as page:
        page.goto(url)
        expect(page.get_by_text(said)).to_be_visible()
        page.goto(f"http://127.0.0.1:{relay.http_port}/")
        expect(page.locator("input[type=password]")).to_be_visible()
        expect(page.get_by_text(said)).to_have_count(0)


def test_below_a_path_an_answer_to_digest_is_refused_with_both_addresses(
    below_a_path: tuple[Relay, str],
) -> None:
    relay, url = below_a_path
    relay.user("dora")
    client = relay.cli("oauth-client", "add", "dora")
    answer = httpx.post(
        url + "oauth/token",
        data={"grant_type": "client_credentials"},
        auth=httpx.DigestAuth(client["key"], client["secret"]),
    )
    assert answer.status_code == 400
    assert "'/robots/oauth/token'" in answer.json()["detail"]
    assert "came to '/oauth/token'" in answer.json()["detail"]
