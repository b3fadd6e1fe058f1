"""Control over HTTP alone, with a real relay and a real ROS 2 robot: taken, used, asked for, given back and lost."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest
from switchboard_drive import LET_GO_SECONDS
from switchboard_http import ask
from switchboard_waiting import wait_for

from relay_server.common.freshness_tokens import HEADER
from relay_server.http_sessions.pool import LINGER_SECONDS

ROBOT = "/api/v1/robots/rover"
STAND: Any = {"value": {}}
GO = {"value": {"linear": {"x": 0.2}, "angular": {"z": 0.3}}}


def client_of(world: Any, token: str) -> httpx.Client:
    """Requests to the relay with a token."""
    headers, base = {"Authorization": f"Bearer {token}"}, f"http://127.0.0.1:{world.relay.http_port}{ROBOT}"
    return httpx.Client(base_url=base, headers=headers, timeout=90)


class Hand:
    """Somebody who moves the robot by requests alone, and gives back the moment of the latest answer.

    :param token: his
    """

    def __init__(self, world: Any, token: str) -> None:
        self._world = world
        self._moment = ""
        self.client = client_of(world, token)

    def take(self, why: str = "", **headers: str) -> httpx.Response:
        """Take control, or ask for it."""
        return self._dated(self.client.put("control", json={"why": why}, headers=headers))

    def drive(self, command: Any = GO) -> httpx.Response:
        """One command."""
        return self._dated(self.client.post("topics/cmd_vel", json=command, headers={HEADER: self._moment}))

    def moves(self) -> None:
        """Drive until the robot moves, by its own record."""

        def moving() -> bool:
            answer = self.drive()
            # On a slow machine the moment of the latest answer is too old at times, or the robot is not ready in time.
            assert answer.status_code in (204, 409, 412), answer.text
            return bool(self._world.robot.moving())

        wait_for("the robot moves", moving)

    def stands(self) -> None:
        """Wait until it stands."""
        wait_for("the robot stands", lambda: not self._world.robot.moving())

    def control(self) -> dict[str, Any]:
        """Who moves it. By asking for that no connection is kept."""
        return dict(self.client.get("control").json())

    def holder(self) -> str | None:
        """The user who has control."""
        found = self.control()["holder"]
        return None if found is None else str(found["user"])

    def _dated(self, answer: httpx.Response) -> httpx.Response:
        self._moment = answer.headers[HEADER]
        return answer


@pytest.fixture
def tokens(world: Any) -> Iterator[dict[str, str]]:
    """Of two who may drive; the robot is free before and after."""
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
def hal(world: Any, tokens: dict[str, str]) -> Iterator[Hand]:
    """Who moves the robot by HTTP, and has let go."""
    hand = Hand(world, tokens["hal"])
    time.sleep(LET_GO_SECONDS)  # so long he must have said nothing
    yield hand
    hand.client.close()


def test_who_takes_control_drives(hal: Hand) -> None:
    """By commands to a topic with the same token; what he gives back stops the robot."""
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


def test_another_asks_and_is_granted(world: Any, tokens: dict[str, str], hal: Hand) -> None:
    """He sees who asks by taking control again; what he sends after he has granted it moves nothing."""
    with world.relay.connect("rover", tokens["ida"]) as ida:

        def asks() -> str | None:
            """What she is told, unless the machine stood still for so long that he has lost control."""
            assert hal.take().status_code == 200
            hal.moves()
            told = ida.call("/relay/take_control", {"why": "my turn"})["values"]
            if told["success"]:
                ida.call("/relay/release_control")
            return None if told["success"] else str(told["message"])

        assert "hal has control" in wait_for("ida asks", asks)
        request = hal.take().json()["control"]["request"]
        assert (request["user"], request["why"]) == ("ida", "my turn")
        assert hal.client.post("control/grant", json={"client": request["client"]}).json()["success"]
        wait_for("ida has control", lambda: hal.holder() == "ida")
        hal.stands()
        assert hal.take("again").status_code == 202
        refused = hal.drive()
        assert refused.status_code in (403, 412), refused.text
        # Where the machine was so slow that it came too late, that is told first.
        assert refused.status_code == 412 or "controlled by ida" in refused.json()["detail"]
        assert not world.robot.moving()
        assert ida.call("/relay/release_control")["values"]["success"]


def test_who_asks_waits_for_the_answer(world: Any, tokens: dict[str, str], hal: Hand) -> None:
    """As long as he prefers: it is granted, or refused in words; what is not answered stays a request."""
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
        assert "your request for control is over" in refused.json()["detail"]


def test_who_falls_silent_loses_it(hal: Hand, world: Any, tokens: dict[str, str]) -> None:
    """The robot stands by its own watch; later nobody has control, which is told, and whoever comes has it."""
    assert hal.take().status_code == 200
    hal.moves()
    hal.stands()
    # Asking who has it does not keep it.
    wait_for("nobody has control", lambda: hal.holder() is None)
    lost = [each for each in world.relay.cli("audit", "list") if each["action"] == "control.lost"]
    assert any(each["data"]["why"] == "the connection has ended" for each in lost)
    assert not world.robot.moving()

    def told() -> list[str]:
        """Alerts of control that was lost by somebody who had not let go."""
        found = ask(world.relay.http_port, "GET", "/api/v1/alerts?robot=rover&open=true", token=tokens["hal"])
        return [each["text"] for each in found.json["alerts"] if each["kind"] == "control"]

    (text,) = wait_for("it is told", told)
    assert text.startswith("hal lost control while")
    assert hal.take().status_code == 200
    wait_for("somebody has control again", lambda: not told())


def test_who_has_said_zero_is_no_matter_of_an_alert(hal: Hand, world: Any, tokens: dict[str, str]) -> None:
    """He has let go; that his control ends with his silence is as it should be."""
    assert hal.take().status_code == 200
    hal.moves()
    wait_for("zero is said", lambda: hal.drive(STAND).status_code == 204)
    wait_for("nobody has control", lambda: hal.holder() is None)
    found = ask(world.relay.http_port, "GET", "/api/v1/alerts?robot=rover&open=true", token=tokens["hal"])
    assert [each for each in found.json["alerts"] if each["kind"] == "control"] == []


def test_a_revoked_token_loses_it(world: Any, tokens: dict[str, str], hal: Hand) -> None:
    """While he drives: the robot stands, nobody has control, and he is nobody."""
    before = {each["id"] for each in world.relay.cli("token", "list")}
    revoked = Hand(world, world.relay.token("hal"))
    (number,) = {each["id"] for each in world.relay.cli("token", "list")} - before
    assert revoked.take().status_code == 200
    revoked.moves()
    world.relay.cli("token", "revoke", str(number))
    wait_for("he is nobody", lambda: revoked.take().status_code == 401)
    wait_for("nobody has control", lambda: hal.holder() is None)
    hal.stands()
    revoked.client.close()


def test_only_who_may_control_takes_it(world: Any, tokens: dict[str, str], hal: Hand) -> None:
    """A viewer is refused in words, a stranger is told of no robot, and who proves nobody of nothing."""
    for token, status in ((world.viewer, 403), (world.stranger, 404), ("nobody", 401)):
        hand = Hand(world, token)
        for method, expected in (("PUT", status), ("DELETE", 204 if status == 403 else status)):
            answer = hand.client.request(method, "control")
            assert answer.status_code == expected, answer.text
        hand.client.close()
    assert hal.holder() is None
