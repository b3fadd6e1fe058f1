"""Control over HTTP only, with a real relay and a real ROS 2 robot: taken, used, requested, released and
lost.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from relay_server.common.freshness_tokens import HEADER
from relay_server.in_process_sessions.pool import LINGER_SECONDS
from tests.worlds.driving import LET_GO_SECONDS
from tests.worlds.http_requests import ask
from tests.worlds.waiting import wait_for

ROBOT = "/api/v1/robots/rover"
STAND: Any = {"value": {}}
GO = {"value": {"linear": {"x": 0.2}, "angular": {"z": 0.3}}}


def client_of(world: Any, token: str) -> httpx.Client:
    """Requests to the relay with a token."""
    headers, base = {"Authorization": f"Bearer {token}"}, f"http://127.0.0.1:{world.relay.http_port}{ROBOT}"
    return httpx.Client(base_url=base, headers=headers, timeout=90)


class HttpOperator:
    """A user who moves the robot by requests only, with the freshness token of the latest answer.

    :param token: the user's
    """

    def __init__(self, world: Any, token: str) -> None:
        self._world = world
        self._moment = ""
        self.client = client_of(world, token)

    def take(self, why: str = "", **headers: str) -> httpx.Response:
        """Takes or requests control."""
        return self._dated(self.client.put("control", json={"why": why}, headers=headers))

    def drive(self, command: Any = GO) -> httpx.Response:
        """Sends one command."""
        return self._dated(self.client.post("topics/cmd_vel", json=command, headers={HEADER: self._moment}))

    def moves(self) -> None:
        """Drives until the robot moves, by its own log."""

        def moving() -> bool:
            answer = self.drive()
            # On a slow machine the latest token may be too old, or the robot not ready in time.
            assert answer.status_code in (204, 409, 412), answer.text
            return bool(self._world.robot.moving())

        wait_for("the robot moves", moving)

    def stands(self) -> None:
        """Waits until it stands."""
        wait_for("the robot stands", lambda: not self._world.robot.moving())

    def control(self) -> dict[str, Any]:
        """The robot's control. Reading it does not keep a connection open."""
        return dict(self.client.get("control").json())

    def holder(self) -> str | None:
        """The controller's name."""
        found = self.control()["holder"]
        return None if found is None else str(found["user"])

    def _dated(self, answer: httpx.Response) -> httpx.Response:
        self._moment = answer.headers[HEADER]
        return answer


@pytest.fixture
def tokens(world: Any) -> Iterator[dict[str, str]]:
    """Tokens of two operators; the robot has no controller before and after."""
    found = {}
    for name in ("hal", "ida"):
        known = name in [each["user"] for each in world.relay.cli("user", "list")]
        found[name] = world.relay.token(name) if known else world.relay.user(name)
        world.relay.cli("right", "grant", name, "rover", "operator")
    world.left_alone()
    yield found
    for token in found.values():
        with client_of(world, token) as client:
            assert client.post("control/release").status_code in (200, 403)
    world.left_alone()


@pytest.fixture
def hal(world: Any, tokens: dict[str, str]) -> Iterator[HttpOperator]:
    """A user who moves the robot by HTTP, after a pause."""
    operator_ = HttpOperator(world, tokens["hal"])
    time.sleep(LET_GO_SECONDS)  # a pause this long counts as a release
    yield operator_
    operator_.client.close()


def test_taking_control_allows_driving(hal: HttpOperator) -> None:
    """By messages to a topic with the same token; releasing stops the robot."""
    taken = hal.take("delivery")
    assert (taken.status_code, taken.json()["success"], taken.json()["kept"]) == (200, True, LINGER_SECONDS)
    holder = taken.json()["control"]["holder"]
    assert (holder["user"], holder["you"], holder["implicit"]) == ("hal", True, False)
    hal.moves()
    assert hal.holder() == "hal"
    assert hal.take().status_code == 200
    assert hal.client.delete("control").status_code == 204
    assert hal.holder() is None
    hal.stands()
    assert hal.client.delete("control").status_code == 204


def test_another_asks_and_is_granted(world: Any, tokens: dict[str, str], hal: HttpOperator) -> None:
    """The controller sees the request in the answer to a repeated take; after granting it their commands have
    no effect.
    """
    with world.relay.connect("rover", tokens["ida"]) as ida:

        def asks() -> str | None:
            """The error that the requester gets, or None if the controller lost control because the machine
            was slow.
            """
            assert hal.take().status_code == 200
            hal.moves()
            reported = ida.call("/relay/take_control", {"why": "my turn"})["values"]
            if reported["success"]:
                ida.call("/relay/release_control")
            return None if reported["success"] else str(reported["message"])

        assert "hal has control" in wait_for("ida asks", asks)
        request = hal.take().json()["control"]["request"]
        assert (request["user"], request["why"]) == ("ida", "my turn")
        assert hal.client.post("control/grant", json={"client": request["client"]}).json()["success"]
        wait_for("ida has control", lambda: hal.holder() == "ida")
        hal.stands()
        assert hal.take("again").status_code == 202
        refused = hal.drive()
        assert refused.status_code in (403, 412), refused.text
        # On a slow machine the error about lateness comes first.
        assert refused.status_code == 412 or "controlled by ida" in refused.json()["detail"]
        assert not world.robot.moving()
        assert ida.call("/relay/release_control")["values"]["success"]


def test_request_waits_for_the_answer(world: Any, tokens: dict[str, str], hal: HttpOperator) -> None:
    """For the preferred time: it is granted, or refused with a reason; an unanswered one stays."""
    with world.relay.connect("rover", tokens["ida"]) as ida, ThreadPoolExecutor(1) as pool:
        assert ida.call("/relay/take_control")["values"]["success"]
        pending = hal.take("delivery", Prefer="wait=0.2")
        assert (pending.status_code, pending.headers["preference-applied"]) == (202, "wait=0.2")
        assert pending.json()["control"]["request"]["you"]
        waiting = pool.submit(hal.take, "delivery", Prefer="wait=60")
        assert ida.call("/relay/grant_control")["values"]["success"]
        assert waiting.result(60).status_code == 200
        hal.moves()
        hal.client.delete("control")
        hal.stands()
        assert ida.call("/relay/take_control")["values"]["success"]
        waiting = pool.submit(hal.take, "delivery", Prefer="wait=60")
        wait_for("he asks", lambda: hal.control()["request"])
        assert ida.call("/relay/refuse_control")["values"]["success"]
        refused = waiting.result(60)
        assert (refused.status_code, refused.json()["code"]) == (409, "not_done")
        assert "your request for control has ended" in refused.json()["detail"]


def test_silent_controller_loses_control(hal: HttpOperator, world: Any, tokens: dict[str, str]) -> None:
    """The watchdog stops the robot; later the loss is reported, and any client may take control."""
    assert hal.take().status_code == 200
    hal.moves()
    hal.stands()
    # Reading the controller does not extend control.
    wait_for("nobody has control", lambda: hal.holder() is None)

    def reasons() -> list[str]:
        entries = world.relay.cli("audit", "list")
        return [each["data"]["why"] for each in entries if each["action"] == "control.lost"]

    wait_for("the loss is in the audit log", lambda: "the connection has ended" in reasons())
    assert not world.robot.moving()

    def reported() -> list[str]:
        """Alerts about control lost without a release."""
        found = ask(world.relay.http_port, "GET", "/api/v1/alerts?robot=rover&open=true", token=tokens["hal"])
        return [each["text"] for each in found.json["alerts"] if each["kind"] == "control"]

    (text,) = wait_for("it is told", reported)
    assert text.startswith("hal lost control while")
    assert hal.take().status_code == 200
    wait_for("somebody has control again", lambda: not reported())


def test_zero_velocity_raises_no_alert(hal: HttpOperator, world: Any, tokens: dict[str, str]) -> None:
    """Zero counts as a release, so the end of control by silence is normal."""
    assert hal.take().status_code == 200
    hal.moves()
    wait_for("zero is said", lambda: hal.drive(STAND).status_code == 204)
    wait_for("nobody has control", lambda: hal.holder() is None)
    found = ask(world.relay.http_port, "GET", "/api/v1/alerts?robot=rover&open=true", token=tokens["hal"])
    assert [each for each in found.json["alerts"] if each["kind"] == "control"] == []


def test_a_revoked_token_loses_it(world: Any, tokens: dict[str, str], hal: HttpOperator) -> None:
    """The robot stops during the drive, has no controller, and the token is invalid."""
    before = {each["id"] for each in world.relay.cli("token", "list")}
    revoked = HttpOperator(world, world.relay.token("hal"))
    (number,) = {each["id"] for each in world.relay.cli("token", "list")} - before
    assert revoked.take().status_code == 200
    revoked.moves()
    world.relay.cli("token", "revoke", str(number))
    wait_for("he is nobody", lambda: revoked.take().status_code == 401)
    wait_for("nobody has control", lambda: hal.holder() is None)
    hal.stands()
    revoked.client.close()


def test_taking_control_needs_the_right(world: Any, tokens: dict[str, str], hal: HttpOperator) -> None:
    """A viewer gets a reason, a user without rights gets 404, and an unauthenticated client 401."""
    for token, status in ((world.viewer, 403), (world.stranger, 404), ("nobody", 401)):
        operator_ = HttpOperator(world, token)
        for method, expected in (("PUT", status), ("DELETE", 204 if status == 403 else status)):
            answer = operator_.client.request(method, "control")
            assert answer.status_code == expected, answer.text
        operator_.client.close()
    assert hal.holder() is None
