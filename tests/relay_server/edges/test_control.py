"""Control over HTTP, on transports in memory."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_server.access import Principal
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.control import http as module
from relay_server.control.commands import NotDone
from relay_server.control.service import StopResult, TakeResult
from relay_server.control.stopping import StoppedSince
from relay_server.control.types import ControlReply
from relay_server.http_sessions.pool import LINGER_SECONDS
from tests.relay_server.edges.http_client import ORIGIN, World

HERE = "/api/v1/robots/rover"
ANN = {"Authorization": "Bearer ann"}
STOPPED = {"by": "ann", "why": "smoke", "since": 5.0, "told": True, "again": None}


class Console:
    """Keeps what it is asked.

    :ivar fails: what goes wrong
    """

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.done = True
        self.fails: Exception | None = None

    def _keep(self, what: str, principal: Principal, *asked: Any) -> None:
        assert principal.name == "ann"
        if self.fails is not None and what != "control":
            raise self.fails
        self.asked.append((what, *asked))

    async def control(self, principal: Principal, robot: str, address: str) -> dict[str, Any]:
        """Who moves it."""
        if robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")
        return {"robot": robot, "stopped": STOPPED}

    async def take(
        self, principal: Principal, robot: str, why: str, address: str, seconds: float
    ) -> TakeResult:
        """Keep it."""
        self._keep("take", principal, robot, why, address, seconds)
        return TakeResult(ControlReply(self.done, "you have control"), {"robot": robot})

    async def let_go(self, principal: Principal, robot: str, address: str) -> None:
        """Keep it."""
        self._keep("let go", principal, robot, address)

    async def release(self, principal: Principal, robot: str, why: str, address: str) -> ControlReply:
        """Keep it."""
        self._keep("release", principal, robot, why, address)
        return ControlReply(True, "control is given back")

    async def grant(
        self, principal: Principal, robot: str, why: str, address: str, client: int
    ) -> ControlReply:
        """Keep it."""
        self._keep("grant", principal, robot, why, address, client)
        raise NotDone("nobody asks for control")

    async def refuse(
        self, principal: Principal, robot: str, why: str, address: str, client: int
    ) -> ControlReply:
        """Keep it."""
        self._keep("refuse", principal, robot, why, address, client)
        return ControlReply(True, "you keep control")

    async def stop(self, principal: Principal, robot: str, why: str, address: str) -> StopResult:
        """Keep it."""
        if isinstance(self.fails, NotDone):
            return StopResult(False, STOPPED, str(self.fails))
        self._keep("stop", principal, robot, why, address)
        return StopResult(self.done, {**STOPPED, "told": self.done})

    async def resume(self, principal: Principal, robot: str, why: str, address: str, sent: int) -> None:
        """Keep it."""
        self._keep("resume", principal, robot, why, address, sent)

    async def suppress(self, principal: Principal, robot: str, resource: str, ms: int, address: str) -> None:
        """Keep it."""
        self._keep("suppress", principal, robot, resource, ms, address)

    async def inhibit(
        self, principal: Principal, robot: str, resource: str, ms: int, hold: bool, address: str
    ) -> None:
        """Keep it."""
        self._keep("inhibit", principal, robot, resource, ms, hold, address)


class Site(World):
    """A relay's site with control behind it."""

    def __init__(self, folder: Path, rate: float = 0.0) -> None:
        super().__init__(folder, rate=rate)
        self.console = Console()
        self.now = 1000
        self.moments = FreshnessTokens(lambda: self.now)
        self.below.update(
            {part: partial(module.below, self.console, self.moments, part) for part in module.PARTS}
        )

    def post(self, part: str, body: Any = None, **headers: str) -> Any:
        """One request with ann's token."""
        dated = {HEADER: self.moments.now()} if part == "resume" else {}
        return self.ask("POST", f"{HERE}/{part}", body, **{**ANN, **dated, **headers})


@pytest.fixture
def site(tmp_path: Path) -> Site:
    """A site."""
    return Site(tmp_path)


def test_who_moves_a_robot_is_told(site: Site) -> None:
    """Of one that is there for the caller."""
    answer = site.ask("GET", f"{HERE}/control", **ANN)
    assert (answer.status, answer.json["robot"]) == (200, "rover")
    assert answer.headers["cache-control"] == "no-store"
    assert site.ask("GET", "/api/v1/robots/other/control", **ANN).status == 404
    assert site.ask("GET", f"{HERE}/control").status == 401


def test_control_is_given_back_handed_over_and_kept(site: Site) -> None:
    """With a reason or without any body."""
    assert site.post("control/release", {"why": "done"}).json == {
        "success": True,
        "message": "control is given back",
    }
    refused = site.post("control/grant")
    assert (refused.status, refused.json["detail"]) == (409, "nobody asks for control")
    assert refused.headers["content-type"] == "application/problem+json"
    assert site.post("control/refuse", {"why": "no", "client": 7}).json["success"] is True
    assert site.console.asked == [
        ("release", "rover", "done", "192.0.2.9"),
        ("grant", "rover", "", "192.0.2.9", 0),
        ("refuse", "rover", "no", "192.0.2.9", 7),
    ]
    assert site.post("control/grant", {"client": -1}).status == 400
    assert site.post("control/grant", {"client": "bob"}).status == 400
    assert site.post("control/take").status == 404


def test_control_is_taken_or_asked_for(site: Site) -> None:
    """With a reason and a wait, or without; the answer says which, until when, and gives a first command's moment."""
    taken = site.ask("PUT", f"{HERE}/control", {"why": "delivery"}, **ANN, Prefer="wait=7")
    assert (taken.status, taken.headers["preference-applied"]) == (200, "wait=7")
    assert taken.json == {
        "success": True,
        "message": "you have control",
        "kept": LINGER_SECONDS,
        "control": {"robot": "rover"},
    }
    assert taken.headers[HEADER] == site.moments.now()
    site.console.done = False
    asked = site.ask("PUT", f"{HERE}/control", **ANN)
    assert (asked.status, asked.json["success"]) == (202, False)
    assert site.console.asked == [
        ("take", "rover", "delivery", "192.0.2.9", 7.0),
        ("take", "rover", "", "192.0.2.9", 0.0),
    ]
    assert site.ask("PUT", f"{HERE}/control", {"why": 7}, **ANN).status == 400
    assert site.ask("PUT", f"{HERE}/control", raw=b"{", **ANN).status == 400
    assert len(site.console.asked) == 2


def test_control_that_was_taken_is_let_go(site: Site) -> None:
    """Though the database is gone: that stops a robot."""
    site.desk.up = False
    for _ in range(3):
        answer = site.ask("DELETE", f"{HERE}/control", **ANN)
        assert (answer.status, answer.body) == (204, b"")
        assert answer.headers[HEADER] == site.moments.now()
    assert site.console.asked == [("let go", "rover", "192.0.2.9")] * 3
    assert site.ask("PUT", f"{HERE}/control", **ANN).status == 503


def test_what_was_taken_is_let_go_however_much_was_asked(tmp_path: Path) -> None:
    """Taking counts as other requests do."""
    site = Site(tmp_path, rate=0.1)
    assert [site.ask("PUT", f"{HERE}/control", **ANN).status for _ in range(2)] == [200, 429]
    assert [site.ask("DELETE", f"{HERE}/control", **ANN).status for _ in range(3)] == [204] * 3


def test_a_stop_says_whether_it_is_done(site: Site) -> None:
    """202 for a robot that will be stopped when it is back."""
    answer = site.post("stop", {"why": "smoke"})
    assert (answer.status, answer.json) == (200, {"stopped": STOPPED})
    site.console.done = False
    answer = site.post("stop")
    assert (answer.status, answer.json["stopped"]["told"]) == (202, False)
    assert site.post("resume", {"why": "clear"}).json == {"stopped": None}
    assert [asked[0] for asked in site.console.asked] == ["stop", "stop", "resume"]


def test_who_resumes_says_when_he_asks(site: Site) -> None:
    """By the moment of an answer about control; every one of these has one, also of what was refused."""
    told = [
        site.ask("GET", f"{HERE}/control", **ANN),
        site.post("stop"),
        site.ask("POST", f"{HERE}/resume", **ANN),
    ]
    assert [each.status for each in told] == [200, 200, 428]
    assert told[2].json["code"] == "moment_needed"
    site.now += 1
    for each in told:
        moment = each.headers[HEADER]
        assert site.ask("POST", f"{HERE}/resume", **ANN, **{HEADER: moment}).status == 200
    site.console.fails = NotDone("no contactor")
    assert site.post("stop").headers[HEADER] == site.moments.now()
    site.console.fails = StoppedSince("rover was stopped after you asked for this")
    refused = site.post("resume")
    assert (refused.status, refused.json["code"]) == (412, "stopped_since")
    assert [asked[-1] for asked in site.console.asked if asked[0] == "resume"] == [1000] * 3
    assert site.ask("POST", f"{HERE}/resume", **ANN, **{HEADER: "ff.0"}).status == 428


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (NotDone("robot rover could not do it: the contactor does not answer"), 409),
        (Refused("only who has control of the robot, and its owners, may resume it"), 403),
        (Unavailable("robot rover is offline"), 503),
        (NotFound("there is no such robot, or you have no right on it"), 404),
    ],
)
def test_what_goes_wrong_is_told_in_words(site: Site, error: Exception, status: int) -> None:
    """As problem details; with a stop that is not all done, how the robot stands."""
    site.console.fails = error
    for part in ("stop", "resume", "suppress", "inhibit", "hold", "control/release"):
        answer = site.post(part, {"resource": "/cmd_vel"})
        assert (answer.status, answer.json["detail"]) == (status, str(error)), part
        assert answer.headers["content-type"] == "application/problem+json"
    for method in ("PUT", "DELETE"):
        answer = site.ask(method, f"{HERE}/control", **ANN)
        assert (answer.status, answer.json["detail"]) == (status, str(error)), method
    if status == 409:
        assert site.post("stop").json["stopped"] == STOPPED


def test_who_is_known_stops_a_robot_though_the_database_is_gone(site: Site) -> None:
    """Nothing else is done for him."""
    site.desk.up = False
    assert site.post("stop").status == 200
    assert site.post("resume").status == 503
    assert site.post("stop", Authorization="Bearer nobody").status == 401


def test_topics_are_suppressed_inhibited_and_held(site: Site) -> None:
    """With the times that are usual where none is given."""
    assert site.post("suppress", {"resource": "/cmd_vel"}).json == {"resource": "/cmd_vel", "ms": 100}
    site.post("suppress", {"resource": "/cmd_vel", "ms": 0})
    assert site.post("inhibit", {"resource": "/scan", "ms": 5000}).json == {"resource": "/scan", "ms": 5000}
    assert site.post("hold", {"resource": "/scan"}).json == {"resource": "/scan", "ms": 1000}
    assert site.console.asked == [
        ("suppress", "rover", "/cmd_vel", 100, "192.0.2.9"),
        ("suppress", "rover", "/cmd_vel", 0, "192.0.2.9"),
        ("inhibit", "rover", "/scan", 5000, False, "192.0.2.9"),
        ("inhibit", "rover", "/scan", 1000, True, "192.0.2.9"),
    ]
    refused = site.post("inhibit", {"resource": "/scan", "hold": True})
    assert (refused.status, len(site.console.asked)) == (400, 4)
    assert "hold" in refused.json["detail"]


@pytest.mark.parametrize(
    "body", [{}, {"resource": ""}, {"resource": "/x" * 200}, {"resource": "/x", "ms": "1"}, [], "x", 3]
)
def test_bodies_that_make_no_sense_are_refused(site: Site, body: Any) -> None:
    """Nothing is done."""
    assert site.post("suppress", body).status == 400
    assert site.post("inhibit", body).status == 400
    assert site.post("hold", body).status == 400
    assert site.console.asked == []


def test_a_body_that_is_no_json_is_refused_but_for_none_at_all(site: Site) -> None:
    """Also one that says to be something else."""
    dated = {**ANN, HEADER: site.moments.now()}
    assert site.ask("POST", f"{HERE}/resume", raw=b"{", **dated).status == 400
    assert site.ask("POST", f"{HERE}/resume", raw=b"why=x", **dated, Content_Type="text/plain").status == 400
    assert site.post("resume", {"why": "x" * 5000}).status == 400
    assert site.console.asked == []


@pytest.mark.parametrize(
    ("body", "why"),
    [
        (b'{"why": "smoke"}', "smoke"),
        (b'{"why": null}', ""),
        (b'{"why": 7}', ""),
        (b'["smoke"]', ""),
        (b"{", ""),
        (b"why=smoke", ""),
        (b"\xff\xfe", ""),
        (b'{"why": "\\ud83d"}', ""),
        (b'{"why": "%s"}' % (b"x" * 5000), "x" * 500),
    ],
)
def test_no_stop_is_refused_for_its_reason(site: Site, body: bytes, why: str) -> None:
    """Nor for the form it comes in: what can't be used is left out."""
    for kind in ("application/json", "application/x-www-form-urlencoded"):
        assert site.ask("POST", f"{HERE}/stop", raw=body, **ANN, Content_Type=kind).status == 200
    assert site.console.asked == [("stop", "rover", why, "192.0.2.9")] * 2


def test_a_cookie_counts_only_with_a_listed_origin(site: Site) -> None:
    """Another site's page can't resume a robot, nor stop it."""
    cookie = {"Cookie": "sb=ann"}
    for part in ("stop", "resume", "suppress", "inhibit", "hold", "control/release"):
        body = {"resource": "/x"} if part in ("suppress", "inhibit", "hold") else {}
        assert site.ask("POST", f"{HERE}/{part}", body, **cookie).status == 403
        assert site.ask("POST", f"{HERE}/{part}", body, **cookie, Origin="https://evil.example").status == 403
    for method in ("PUT", "DELETE"):
        assert site.ask(method, f"{HERE}/control", **cookie).status == 403
    assert site.console.asked == []
    assert site.ask("POST", f"{HERE}/stop", {}, **cookie, Origin=ORIGIN).status == 200


ORDERS = ("stop", "resume", "suppress", "inhibit", "hold", "control/grant")


@pytest.mark.parametrize(
    ("part", "methods", "takes"),
    [
        *((part, ("GET", "HEAD", "PUT", "DELETE", "PATCH"), "POST") for part in ORDERS),
        ("control", ("POST", "PATCH"), "DELETE, GET, HEAD, PUT"),
    ],
)
def test_addresses_take_their_own_methods(
    site: Site, part: str, methods: tuple[str, ...], takes: str
) -> None:
    """Of others they say so to who knows the robot, and to nobody else; nothing is done."""
    for method in methods:
        answer = site.ask(method, f"{HERE}/{part}", **ANN)
        assert (answer.status, answer.headers["allow"]) == (405, takes), method
        assert answer.headers["content-type"] == "application/problem+json"
        assert method == "HEAD" or takes in answer.json["detail"]
        strange = site.ask(method, f"{HERE.replace('rover', 'other')}/{part}", **ANN)
        assert (strange.status, "allow" in strange.headers) == (404, False), method
        assert site.ask(method, f"{HERE}/{part}").status == 401, method
    assert site.console.asked == []


def test_there_is_nothing_below_these_addresses(site: Site) -> None:
    """By no method."""
    for path in ("stop/now", "stop/release", "hold/grant", "control/now", "control/grant/now"):
        for method in ("GET", "POST"):
            answer = site.ask(method, f"{HERE}/{path}", **ANN)
            assert (answer.status, "allow" in answer.headers) == (404, False), (method, path)
    assert site.console.asked == []
