"""A robot's resources over HTTP, with a real relay, a real ROS 2 robot and httpx."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from relay_server.common.freshness_tokens import HEADER
from tests.robot_client.ros import Peer
from tests.worlds.driving import LET_GO_SECONDS
from tests.worlds.processes import ros_environment
from tests.worlds.waiting import wait_for

ROBOT = "/api/v1/robots/rover"
GO = {"value": {"linear": {"x": 0.2}, "angular": {"z": 0.3}}}
STILL: dict[str, Any] = {"value": {"linear": {"x": 0.0}}}


def client_of(world: Any, token: str) -> httpx.Client:
    """Requests to the relay with a token."""
    headers = {"Authorization": f"Bearer {token}"}
    return httpx.Client(
        base_url=f"http://127.0.0.1:{world.relay.http_port}{ROBOT}", headers=headers, timeout=90
    )


@pytest.fixture
def operator(world: Any) -> Iterator[httpx.Client]:
    """Requests of an operator."""
    with client_of(world, world.operator) as client:
        yield client


@pytest.fixture
def viewer(world: Any) -> Iterator[httpx.Client]:
    """Requests of a viewer."""
    with client_of(world, world.viewer) as client:
        yield client


def test_collections_are_paged(viewer: httpx.Client) -> None:
    """By names and types; motion topics are marked."""
    first = viewer.get("topics", params={"limit": 2}).json()
    assert len(first["topics"]) == 2 and first["next"] == first["topics"][-1]["name"] and first["online"]
    second = viewer.get("topics", params={"limit": 1000, "after": first["next"]}).json()
    names = [each["name"] for each in first["topics"] + second["topics"]]
    assert names == sorted(names) and "/odom" in names and second["next"] == ""
    (odom,) = viewer.get("topics", params={"type": "nav_msgs/msg/Odometry"}).json()["topics"]
    assert (odom["name"], odom["moves"]) == ("/odom", False)
    (wheels,) = viewer.get("topics", params={"name": "/cmd_*l"}).json()["topics"]
    assert wheels["moves"]
    assert "/relay/stop" in [
        each["name"] for each in viewer.get("services", params={"limit": 1000}).json()["services"]
    ]


def test_a_topic_is_read_again_only_when_it_has_changed(viewer: httpx.Client) -> None:
    """Its newest message, with an entity tag; a request with the tag waits for the next."""
    answer = viewer.get("topics/odom", params={"wait": 60})
    state = answer.json()
    assert (state["topic"], state["type"]) == ("/odom", "nav_msgs/msg/Odometry")
    assert "pose" in state["value"] and answer.headers[HEADER]
    tag = answer.headers["etag"]
    known = {"If-None-Match": tag}
    following = viewer.get("topics/odom", headers=known, params={"wait": 60})
    assert following.status_code == 200 and following.headers["etag"] != tag
    # The time of the same message may have another form.
    assert tag.startswith('W/"')


def test_a_topic_is_streamed(viewer: httpx.Client) -> None:
    """As server-sent events, at most at the requested rate."""
    received: list[Any] = []
    headers = {"Accept": "text/event-stream"}
    with viewer.stream("GET", "topics/odom", headers=headers, params={"throttle_ms": 200}) as answer:
        assert answer.headers["content-type"] == "text/event-stream"
        for line in answer.iter_lines():
            # On a busy machine there may be statuses between the messages.
            if line.startswith('data: {"header"'):
                received.append(json.loads(line.removeprefix("data: ")))
            if len(received) >= 8:
                break
    stamps = [each["header"]["stamp"]["sec"] + each["header"]["stamp"]["nanosec"] / 1e9 for each in received]
    assert stamps == sorted(stamps) and stamps[-1] - stamps[0] > 0.7, "half of what they are apart at least"


def stands_by_order(client: httpx.Client) -> None:
    """Sends zero until it arrives in time."""

    def said() -> bool:
        moment = client.get("topics").headers[HEADER]
        answer = client.put("topics/cmd_vel", json=STILL, headers={HEADER: moment})
        assert answer.status_code in (204, 412), answer.text
        return answer.status_code == 204

    wait_for("a zero comes in time", said)


def test_request_with_a_freshness_token_drives(world: Any, operator: httpx.Client) -> None:
    """Without one, or with an old one, nothing moves; the first command takes control, which ends by itself."""
    world.left_alone()
    needed = operator.put("topics/cmd_vel", json=GO)
    assert (needed.status_code, needed.json()["code"]) == (428, "freshness_required")
    moment = needed.headers[HEADER]

    def drives() -> bool:
        nonlocal moment
        answer = operator.put("topics/cmd_vel", json=GO, headers={HEADER: moment})
        moment = answer.headers[HEADER]
        assert answer.status_code in (204, 412), answer.text
        return bool(world.robot.moving())

    wait_for("it moves", drives)
    assert operator.get("control").json()["holder"]["user"] == "operator"
    stands_by_order(operator)
    wait_for("it stands", lambda: not world.robot.moving())
    time.sleep(0.6)  # so the first token is older than any command may be
    late = operator.put("topics/cmd_vel", json=GO, headers={HEADER: needed.headers[HEADER]})
    assert (late.status_code, late.json()["code"]) == (412, "too_old")
    operator.post("control/release")
    made_up = operator.put("topics/cmd_vel", json=GO, headers={HEADER: "ffff.0000"})
    assert made_up.status_code == 428
    assert not world.robot.moving()


def test_another_type_does_not_make_a_command_young(world: Any, operator: httpx.Client) -> None:
    """Motion is recognised by the topic, for any named type."""
    world.left_alone()
    stands_by_order(operator)
    for kind in ("std_msgs/msg/String", "geometry_msgs/Twist", ""):
        answer = operator.put("topics/cmd_vel", json={**GO, "type": kind})
        assert answer.status_code in (400, 428), answer.text
    assert not world.robot.moving()
    operator.post("control/release")


def test_refused_commands_require_a_release(world: Any, operator: httpx.Client) -> None:
    """As by rosbridge: a client that takes control while it commands moves nothing."""
    token = world.relay.user("driver")
    world.relay.cli("right", "grant", "driver", "rover", "operator")
    moment = operator.get("topics").headers[HEADER]

    def commands() -> httpx.Response:
        nonlocal moment
        answer = operator.put("topics/cmd_vel", json=GO, headers={HEADER: moment})
        moment = answer.headers[HEADER]
        return answer

    with world.relay.connect("rover", token) as other:

        def insists() -> httpx.Response | None:
            """The client's error, or None if the machine was so slow that it counts as a release."""
            nonlocal moment
            assert other.call("/relay/take_control")["values"]["success"]
            moment = operator.get("topics").headers[HEADER]
            begun = time.monotonic()
            vain = commands()
            assert other.call("/relay/release_control")["values"]["success"]
            taken = operator.post("services/relay/take_control", json={})
            assert taken.json()["values"]["success"], taken.text
            answer = commands()
            if vain.status_code == 403 and time.monotonic() - begun < LET_GO_SECONDS / 2:
                return answer
            assert operator.post("control/release").status_code == 200
            return None

        refused = wait_for("he went on without a pause", insists)
    assert refused.status_code == 403 and "release the controls" in refused.json()["detail"]
    time.sleep(LET_GO_SECONDS)  # a pause this long counts as a release
    moment = operator.get("topics").headers[HEADER]
    wait_for("it moves", lambda: commands().status_code == 204 and world.robot.moving())
    operator.post("control/release")
    wait_for("it stands", lambda: not world.robot.moving())


def test_topics_of_the_relay_are_there_at_once(viewer: httpx.Client) -> None:
    """This includes topics that are published only on changes; they can be read and streamed."""
    state = viewer.get("topics/relay/control", params={"wait": 0.5})
    assert state.status_code == 200 and state.json()["value"]["robot"] == "rover"
    with viewer.stream("GET", "topics/relay/control", headers={"Accept": "text/event-stream"}) as answer:
        data = next(each for each in answer.iter_lines() if each.startswith("data: "))
    assert json.loads(data.removeprefix("data: "))["robot"] == "rover"


def test_a_right_that_is_withdrawn_ends_what_is_read(world: Any) -> None:
    """Earlier messages are not shown either; a stream ends with the reason; a new right restores all."""
    token = world.relay.user("reader")
    world.relay.cli("right", "grant", "reader", "rover", "operator")
    with client_of(world, token) as reader:
        assert reader.get("topics/odom", params={"wait": 60}).status_code == 200
        headers = {"Accept": "text/event-stream"}
        with reader.stream("GET", "topics/odom", headers=headers, params={"throttle_ms": 200}) as answer:
            lines = answer.iter_lines()
            next(each for each in lines if each.startswith("data: "))
            world.relay.cli("right", "grant", "reader", "rover", "operator", "--deny", "subscribe:/odom")
            assert any(each == "event: ended" for each in lines)
        refused = reader.get("topics/odom")
        assert refused.status_code == 403, refused.text
        world.relay.cli("right", "grant", "reader", "rover", "operator")
        wait_for("it may again", lambda: reader.get("topics/odom").status_code == 200)

        def stamp() -> Any:
            return reader.get("topics/odom", params={"wait": 60}).json()["value"]["header"]["stamp"]

        first = stamp()
        wait_for("it is new", lambda: stamp() != first)


def test_viewer_cannot_change_anything(world: Any, viewer: httpx.Client) -> None:
    """The answers equal those of rosbridge."""
    world.left_alone()
    moment = viewer.get("topics").headers[HEADER]
    for way in (
        viewer.put("topics/cmd_vel", json=GO, headers={HEADER: moment}),
        viewer.put("topics/chatter", json={"value": {"data": "x"}, "type": "std_msgs/msg/String"}),
        viewer.post("services/reset"),
    ):
        assert way.status_code in (400, 403, 404), way.text
    assert not world.robot.moving()


def test_a_message_reaches_subscribers(world: Any, operator: httpx.Client) -> None:
    """It is checked against its type first."""
    topic = {"topic": "/resources/said", "type": "std_msgs/msg/String"}
    with world.relay.connect("rover", world.operator) as client:
        client.send(op="advertise", **topic)
        client.send(op="subscribe", **topic)
        said = {"value": {"data": "by hand"}, "type": topic["type"]}
        assert operator.post("topics/resources/said", json=said).status_code == 204
        assert client.until(op="publish", topic=topic["topic"])["msg"] == {"data": "by hand"}
        wrong = operator.post("topics/resources/said", json={"value": {"data": 5}, "type": topic["type"]})
        assert wrong.status_code == 400 and "data" in wrong.json()["detail"]


def test_a_service_is_called(operator: httpx.Client) -> None:
    """Its answer, or the reason of a failure."""
    answer = operator.post("services/reset", json={})
    assert answer.status_code == 200 and answer.json()["values"]["success"] is True
    missing = operator.post("services/nowhere", json={"timeout": 1})
    assert missing.status_code == 404 and "/nowhere" in missing.json()["detail"]


def test_service_is_described_as_listed(world: Any, viewer: httpx.Client) -> None:
    """With an entity tag, for users with the right; for others it is not found."""
    (listed,) = viewer.get("services", params={"name": "/relay/stop"}).json()["services"]
    answer = viewer.get("services/relay/stop")
    assert (answer.status_code, answer.json()) == (200, listed)
    known = viewer.get("services/relay/stop", headers={"If-None-Match": answer.headers["etag"]})
    assert (known.status_code, known.content) == (304, b"")
    with client_of(world, world.operator) as operator:
        assert operator.get("services/reset").json()["types"] == ["std_srvs/srv/Trigger"]
    hidden, missing = viewer.get("services/reset"), viewer.get("services/nowhere")
    assert (hidden.status_code, missing.status_code) == (404, 404)
    assert hidden.json()["detail"].replace("/reset", "/nowhere") == missing.json()["detail"]


def test_names_of_a_node_are_links(viewer: httpx.Client) -> None:
    """Each service of the relay's own node."""
    services = viewer.get("nodes/relay").json()["services"]
    assert "/relay/stop" in services
    for name in services:
        assert viewer.get(f"services{name}").json()["name"] == name


def test_a_method_that_an_address_does_not_take(world: Any, viewer: httpx.Client) -> None:
    """The answer lists the allowed ones, for users who may know the resource."""
    for method, address, takes in (
        ("PUT", "services/relay/stop", "GET, HEAD, POST"),
        ("DELETE", "topics/odom", "GET, HEAD, POST, PUT"),
        ("POST", "params", "GET, HEAD"),
        ("GET", "stop", "POST"),
        ("DELETE", "hold", "POST"),
    ):
        answer = viewer.request(method, address)
        assert (answer.status_code, answer.headers["allow"]) == (405, takes), answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        with client_of(world, world.stranger) as stranger:
            assert stranger.request(method, address).status_code == 404
    assert viewer.put("services/reset").status_code == viewer.delete("topics/nowhere").status_code == 404


def test_message_text_is_not_compared(operator: httpx.Client) -> None:
    """A published message replaces no other."""
    said = {"value": {"data": "x"}, "type": "std_msgs/msg/String"}
    for method in ("PUT", "POST"):
        answer = operator.request(method, "topics/resources/said", json=said, headers={"If-Match": "*"})
        assert answer.status_code == 400 and "does not apply" in answer.json()["detail"]


def test_a_message_may_be_too_old(operator: httpx.Client, viewer: httpx.Client) -> None:
    """On a silent topic, a request for a newer message gets none."""
    address, now = "topics/resources/quiet", {"wait": 0}
    said = {"value": {"data": "once"}, "type": "std_msgs/msg/String"}
    assert operator.post(address, json=said).status_code == 204

    def received() -> bool:
        assert operator.post(address, json=said).status_code == 204
        return viewer.get(address, params={"wait": 1, "max_age": 60}).status_code == 200

    def grown_old() -> httpx.Response | None:
        """The message that was too old; None if the machine was so slow that the reader was dropped."""
        wait_for("it is heard", received)
        young = {**now, "max_age": 0.2}
        wait_for("it is too old", lambda: viewer.get(address, params=young).status_code == 504)
        return _found(viewer.get(address, params=now))

    kept = wait_for("it is kept", grown_old)
    assert kept.json()["value"] == {"data": "once"}


def _found(answer: httpx.Response) -> httpx.Response | None:
    return answer if answer.status_code == 200 else None


@pytest.fixture(scope="module")
def peer(world: Any) -> Iterator[Peer]:
    """A node of the robot with a parameter that may be deleted."""
    peer = Peer(ros_environment(world.robot.domain))
    peer.do("declare", "loose", "here")
    yield peer
    peer.close()


def test_of_two_changes_to_the_same_state_one_succeeds(operator: httpx.Client, peer: Peer) -> None:
    """For any timing: the other one gets a conflict."""
    address = "params/robot/peer:loose"
    read = wait_for("the node tells it", lambda: _found(operator.get(address)))
    for number in range(10):
        tag = {"If-Match": read.headers["etag"]}

        def put(value: str, tag: dict[str, str] = tag) -> int:
            return operator.put(address, json={"value": value}, headers=tag).status_code

        with ThreadPoolExecutor(2) as pool:
            answers = list(pool.map(put, (f"one {number}", f"other {number}")))
        assert sorted(answers) == [204, 412]
        read = operator.get(address)
        assert read.json()["value"] == f"{('one', 'other')[answers.index(204)]} {number}"
    tag = {"If-Match": read.headers["etag"]}
    assert operator.put(address, json={"value": "here"}, headers=tag).status_code == 204
    assert operator.get(address).json()["value"] == "here"
    missing = operator.put("params/robot/peer:nothing", json={"value": 1}, headers={"If-Match": "*"})
    assert (missing.status_code, missing.json()["code"]) == (412, "not_as_before")


def test_a_parameter_is_deleted(operator: httpx.Client, peer: Peer) -> None:
    """With its entity tag or not at all; other parameters of the node stay."""
    address = "params/robot/peer:loose"
    read = wait_for("the node tells it", lambda: _found(operator.get(address)))
    assert read.json()["value"] == "here"
    assert operator.delete(address, headers={"If-Match": '"other"'}).status_code == 412
    assert operator.get(address).json() == read.json()
    deleted = operator.delete(address, headers={"If-Match": read.headers["etag"]})
    assert (deleted.status_code, deleted.content) == (204, b""), deleted.text
    assert operator.get(address).status_code == 404
    kept = "params/robot/peer:use_sim_time"
    refused = operator.delete(kept)
    assert refused.status_code == 409 and refused.json()["detail"]
    assert operator.get(kept).json()["value"] is False


def test_a_parameter_is_read_and_written_as_it_was_read(operator: httpx.Client) -> None:
    """A request with the tag of another value changes nothing."""

    def found() -> str:
        """A node without a timely answer is left out."""
        listed = operator.get("params", params={"limit": 1000}).json()["params"]
        return next((each["name"] for each in listed if each["name"].endswith(":use_sim_time")), "")

    name = wait_for("a node tells its parameters", found)
    address = f"params/{name.lstrip('/')}"
    read = operator.get(address)
    assert read.json() == {"name": name.lstrip("/"), "value": False}
    stale = operator.put(address, json={"value": True}, headers={"If-Match": '"other"'})
    assert stale.status_code == 412
    tag = {"If-Match": read.headers["etag"]}
    assert operator.put(address, json={"value": False}, headers=tag).status_code == 204
    assert operator.get("params/nowhere:x").status_code == 404


@pytest.mark.parametrize(
    ("address", "status"),
    [
        ("topics?limit=0", 400),
        ("topics?sort=name", 400),
        ("topics/nothing/there", 404),
        ("topics/odom?wait=1e9", 400),
        ("topics/odom?wait=nan", 400),
        ("topics/odom?wait=1&wait=2", 400),
        ("topics/no name", 400),
        ("services/nowhere", 404),
        ("actions/nowhere", 404),
        ("services/no name", 400),
    ],
)
def test_invalid_value_is_refused_with_a_reason(viewer: httpx.Client, address: str, status: int) -> None:
    """As problem details."""
    answer = viewer.get(address)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json" and answer.json()["detail"]


def test_the_relay_has_logged_no_failure_of_its_own(world: Any, viewer: httpx.Client) -> None:
    """Neither ended streams nor readers that left caused one."""
    assert viewer.get("topics").status_code == 200
    assert "Traceback" not in world.relay.log
