"""Control over HTTP, on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_server.access import Principal
from relay_server.common.errors import NotDone
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.control.gateway import TakeResult
from relay_server.control.http import ControlEndpoints
from relay_server.control.service import StopResult
from relay_server.control.stopping import StoppedSince
from relay_server.control.types import ControlReply
from relay_server.in_process_sessions.pool import LINGER_SECONDS
from tests.worlds.http_client import ORIGIN, World

HERE = "/api/v1/robots/rover"
ANN = {"Authorization": "Bearer ann"}
STOPPED = {"by": "ann", "why": "smoke", "since": 5.0, "confirmed": True, "again": None}


class Console:
    """Records calls.

    :ivar fails: the error to raise
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
        """The robot's control."""
        if robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")
        return {"robot": robot, "stopped": STOPPED}

    async def take(
        self, principal: Principal, robot: str, why: str, address: str, seconds: float
    ) -> TakeResult:
        """Records the call."""
        self._keep("take", principal, robot, why, address, seconds)
        return TakeResult(ControlReply(self.done, "you have control"), {"robot": robot})

    async def release_own(self, principal: Principal, robot: str, address: str) -> None:
        """Records the call."""
        self._keep("let go", principal, robot, address)

    async def release(self, principal: Principal, robot: str, why: str, address: str) -> ControlReply:
        """Records the call."""
        self._keep("release", principal, robot, why, address)
        return ControlReply(True, "control is released")

    async def grant(
        self, principal: Principal, robot: str, why: str, address: str, client: int
    ) -> ControlReply:
        """Records the call."""
        self._keep("grant", principal, robot, why, address, client)
        raise NotDone("there is no request for control")

    async def refuse(
        self, principal: Principal, robot: str, why: str, address: str, client: int
    ) -> ControlReply:
        """Records the call."""
        self._keep("refuse", principal, robot, why, address, client)
        return ControlReply(True, "you keep control")

    async def stop(
        self, principal: Principal, robot: str, why: str, address: str, stop_id: str
    ) -> StopResult:
        """Records the call."""
        if isinstance(self.fails, NotDone):
            return StopResult(False, STOPPED, str(self.fails))
        self._keep("stop", principal, robot, why, address, *filter(None, [stop_id]))
        return StopResult(self.done, {**STOPPED, "confirmed": self.done})

    async def resume(
        self, principal: Principal, robot: str, why: str, address: str, earliest_sent: int
    ) -> None:
        """Records the call."""
        self._keep("resume", principal, robot, why, address, earliest_sent)

    async def suppress(self, principal: Principal, robot: str, resource: str, ms: int, address: str) -> None:
        """Records the call."""
        self._keep("suppress", principal, robot, resource, ms, address)

    async def inhibit(
        self, principal: Principal, robot: str, resource: str, ms: int, hold: bool, address: str
    ) -> None:
        """Records the call."""
        self._keep("inhibit", principal, robot, resource, ms, hold, address)


class Site(World):
    """A relay's site with the fake control service."""

    def __init__(self, folder: Path, rate: float = 0.0) -> None:
        self.now = 1000
        self.moments = FreshnessTokens(lambda: self.now)
        super().__init__(folder, rate=rate, tokens=self.moments)
        self.console = Console()
        self.router.add(ControlEndpoints(cast(Any, self.console)))

    def post(self, part: str, body: Any = None, **headers: str) -> Any:
        """Sends a request with ann's token."""
        dated = {HEADER: self.moments.now()} if part == "resume" else {}
        return self.ask("POST", f"{HERE}/{part}", body, **{**ANN, **dated, **headers})


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_controller_of_a_robot_is_listed(site: Site) -> None:
    """If the caller has a right on it."""
    answer = site.ask("GET", f"{HERE}/control", **ANN)
    assert (answer.status, answer.json["robot"]) == (200, "rover")
    assert answer.headers["cache-control"] == "no-store"
    assert site.ask("GET", "/api/v1/robots/other/control", **ANN).status == 404
    assert site.ask("GET", f"{HERE}/control").status == 401


def test_control_is_released_handed_over_and_refused(site: Site) -> None:
    """With a reason, or without a body."""
    assert site.post("control/release", {"why": "done"}).json == {
        "success": True,
        "message": "control is released",
    }
    refused = site.post("control/grant")
    assert (refused.status, refused.json["detail"]) == (409, "there is no request for control")
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
    """Reason and wait are optional. The answer names the result, its end, and a freshness token for the first
    command.
    """
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


def test_control_that_was_taken_is_released(site: Site) -> None:
    """A release stops the robot, so it needs no database."""
    site.service.up = False
    for _ in range(3):
        answer = site.ask("DELETE", f"{HERE}/control", **ANN)
        assert (answer.status, answer.body) == (204, b"")
        assert answer.headers[HEADER] == site.moments.now()
    assert site.console.asked == [("let go", "rover", "192.0.2.9")] * 3
    assert site.ask("PUT", f"{HERE}/control", **ANN).status == 503


def test_taken_control_is_released_after_many_requests(tmp_path: Path) -> None:
    """Taking control counts for the rate limit."""
    site = Site(tmp_path, rate=0.1)
    assert [site.ask("PUT", f"{HERE}/control", **ANN).status for _ in range(2)] == [200, 429]
    assert [site.ask("DELETE", f"{HERE}/control", **ANN).status for _ in range(3)] == [204] * 3


class UnreachableHome:
    """The robot is at another relay, which can't be reached."""

    def __init__(self) -> None:
        self.forwarder = self

    async def relay_of(self, principal: Principal, robot: str, *, from_memory: bool) -> Any:
        """The other relay."""
        return self

    async def forward(self, *arguments: Any, **options: Any) -> None:
        """Fails."""
        raise Unavailable("the robot's relay can't be reached")


def test_only_a_stop_is_taken_for_a_robot_whose_relay_is_unreachable(site: Site) -> None:
    """It is stored. Control is not released here, as the other relay has it: the caller must know."""
    site.router._forwarding = cast(Any, UnreachableHome())
    released = site.ask("DELETE", f"{HERE}/control", **ANN)
    assert (released.status, released.json["detail"]) == (503, "the robot's relay can't be reached")
    assert site.console.asked == []
    site.console.done = False
    assert site.post("stop").status == 202
    assert site.post("services/relay/stop").status == 200
    assert [what for what, *_ in site.console.asked] == ["stop", "stop"]


def test_a_stop_reports_whether_it_is_done(site: Site) -> None:
    """The status is 202 for a robot that is offline and stops later."""
    answer = site.post("stop", {"why": "smoke"})
    assert (answer.status, answer.json) == (200, {"stopped": STOPPED})
    site.console.done = False
    answer = site.post("stop")
    assert (answer.status, answer.json["stopped"]["confirmed"]) == (202, False)
    assert site.post("resume", {"why": "clear"}).json == {"stopped": None}
    assert [asked[0] for asked in site.console.asked] == ["stop", "stop", "resume"]


@pytest.mark.parametrize(
    ("body", "passed"),
    [
        ({"why": "smoke", "stop_id": "press-1"}, ("smoke", "192.0.2.9", "press-1")),
        ({"why": "smoke", "stop_id": 7}, ("smoke", "192.0.2.9")),
        ({"stop_id": "x" * 65}, ("", "192.0.2.9")),
        (["stop"], ("", "192.0.2.9")),
    ],
)
def test_a_stop_passes_on_its_id_and_is_never_refused_for_it(
    site: Site, body: Any, passed: tuple[str, ...]
) -> None:
    assert site.post("stop", body).status == 200
    assert site.console.asked == [("stop", "rover", *passed)]


def test_resume_is_dated(site: Site) -> None:
    """It needs the freshness token of an answer about control. All of these answers have one, refusals
    included.
    """
    reported = [
        site.ask("GET", f"{HERE}/control", **ANN),
        site.post("stop"),
        site.ask("POST", f"{HERE}/resume", **ANN),
    ]
    assert [each.status for each in reported] == [200, 200, 428]
    assert reported[2].json["code"] == "freshness_required"
    site.now += 1
    for each in reported:
        moment = each.headers[HEADER]
        assert site.ask("POST", f"{HERE}/resume", **ANN, **{HEADER: moment}).status == 200
    site.console.fails = NotDone("no contactor")
    assert site.post("stop").headers[HEADER] == site.moments.now()
    site.console.fails = StoppedSince("rover was stopped after you sent this")
    refused = site.post("resume")
    assert (refused.status, refused.json["code"]) == (412, "stopped_since")
    assert [asked[-1] for asked in site.console.asked if asked[0] == "resume"] == [1000] * 3
    assert site.ask("POST", f"{HERE}/resume", **ANN, **{HEADER: "ff.0"}).status == 428


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (NotDone("the contactor does not answer"), 409),
        (Refused("only the holder of control and the robot's owners may resume it"), 403),
        (Unavailable("robot rover is offline"), 503),
        (NotFound("there is no such robot, or you have no right on it"), 404),
    ],
)
def test_errors_are_reported(site: Site, error: Exception, status: int) -> None:
    """They are problem details; those of a partial stop have ``stopped``."""
    site.console.fails = error
    for part in ("stop", "resume", "suppress", "inhibit", "hold", "control/release"):
        answer = site.post(part, {"resource": "/cmd_vel"})
        words = (
            StopResult(False, None, str(error)).sentence("rover")
            if (part, status) == ("stop", 409)
            else str(error)
        )
        assert (answer.status, answer.json["detail"]) == (status, words), part
        assert answer.headers["content-type"] == "application/problem+json"
    for method in ("PUT", "DELETE"):
        answer = site.ask(method, f"{HERE}/control", **ANN)
        assert (answer.status, answer.json["detail"]) == (status, str(error)), method
    if status == 409:
        assert site.post("stop").json["stopped"] == STOPPED


@pytest.mark.parametrize(
    ("content", "asked"),
    [
        (b'{"args": {"why": "smoke", "stop_id": "press-1"}}', ("smoke", "192.0.2.9", "press-1")),
        (b'{"args": ["smoke", "press-1"], "timeout": "soon"}', ("smoke", "192.0.2.9", "press-1")),
        (b'{"args": {"why": 7}}', ("", "192.0.2.9")),
        (b'{"args"', ("", "192.0.2.9")),
        (b"", ("", "192.0.2.9")),
    ],
)
def test_stop_by_its_service_has_the_rules_of_a_stop(
    site: Site, content: bytes, asked: tuple[str, ...]
) -> None:
    """Any body is accepted, and no database is needed."""
    site.service.up = False
    answer = site.ask("POST", f"{HERE}/services/relay/stop", raw=content, **ANN)
    assert (answer.status, answer.json["values"]["message"]) == (200, "robot rover is stopped")
    assert answer.json["values"]["stopped"] == STOPPED
    assert site.console.asked == [("stop", "rover", *asked)]
    site.console.fails = NotDone("no contactor")
    values = site.ask("POST", f"{HERE}/services/relay/stop", **ANN).json["values"]
    assert (values["success"], values["done"], values["stopped"]) == (False, False, STOPPED)


def test_known_user_stops_a_robot_although_the_database_is_gone(site: Site) -> None:
    """No other request of the user works."""
    site.service.up = False
    assert site.post("stop").status == 200
    assert site.post("resume").status == 503
    assert site.post("stop", Authorization="Bearer nobody").status == 401


def test_topics_are_suppressed_inhibited_and_held(site: Site) -> None:
    """Missing times have their defaults."""
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
    assert site.post("suppress", body).status == 400
    assert site.post("inhibit", body).status == 400
    assert site.post("hold", body).status == 400
    assert site.console.asked == []


def test_a_body_that_is_no_json_is_refused_but_for_none_at_all(site: Site) -> None:
    """This includes bodies with another content type; an empty body is accepted."""
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
    """Nor for an unusable form: invalid reasons are left out."""
    for kind in ("application/json", "application/x-www-form-urlencoded"):
        assert site.ask("POST", f"{HERE}/stop", raw=body, **ANN, Content_Type=kind).status == 200
    assert site.console.asked == [("stop", "rover", why, "192.0.2.9")] * 2


def test_a_cookie_counts_only_with_a_listed_origin(site: Site) -> None:
    """A page of another site can neither resume nor stop a robot."""
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
    """Other methods get 405 from users who know the robot, and 404 from others. No method is carried out."""
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
    """For every method."""
    for path in ("stop/now", "stop/release", "hold/grant", "control/now", "control/grant/now"):
        for method in ("GET", "POST"):
            answer = site.ask(method, f"{HERE}/{path}", **ANN)
            assert (answer.status, "allow" in answer.headers) == (404, False), (method, path)
    assert site.console.asked == []
