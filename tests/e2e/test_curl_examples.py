"""The curl examples in README.md, docs/ and the SPEC run literally against a relay and a robot."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.worlds.doc_examples import Came, Example, examples
from tests.worlds.doc_expectations import Expected, reported, said_on
from tests.worlds.doc_scene import DIRECTORY, DOCUMENTS, ROBOT, Scene, staged
from tests.worlds.http_guide_expectations import EXPECTED_OF_GUIDE
from tests.worlds.http_requests import ask
from tests.worlds.processes import BIN, Process, ros_environment, running
from tests.worlds.waiting import wait_for

SHOWN = [each for path in DOCUMENTS for each in examples(path)]
ASKING = [each for each in SHOWN if each.asks]
MCAP = b"\x89MCAP0\r\n"
JPEG = b"\xff\xd8"


def seen(scene: Scene) -> dict[str, str]:
    """Waits until the robot shows its camera, whose start may be slow on a busy machine."""
    port, picture = scene.relay.http_port, "/robots/robot-one/video/snapshot?topic=/camera/image_raw"
    wait_for("a picture", lambda: ask(port, "GET", picture, token=scene.token).status == 200)
    return {}


def recorded(scene: Scene) -> dict[str, str]:
    """A complete recording."""
    begun = scene.ask("POST", f"{ROBOT}/recordings", {"topics": ["/odom"], "seconds": 600, "megabytes": 1})
    place = f"{ROBOT}/recordings/{begun['id']}"
    wait_for("something is recorded", lambda: scene.ask("GET", place)["messages"])
    scene.ask("POST", f"{place}/stop")
    wait_for("the recording is complete", lambda: scene.ask("GET", place)["state"] == "complete")
    return {"<id>": begun["id"]}


def unrecorded(scene: Scene) -> None:
    """No recording runs or is stored."""
    for each in scene.ask("GET", f"{ROBOT}/recordings")["recordings"]:
        if each["state"] == "recording":
            scene.ask("POST", f"{ROBOT}/recordings/{each['id']}/stop")
        scene.ask("DELETE", f"{ROBOT}/recordings/{each['id']}")


def downloaded(scene: Scene, came: Came) -> bool:
    """The file has the name used in the document's next line, and is valid MCAP."""
    (file,) = scene.folder.glob("robot-one-*.mcap")
    return file.read_bytes().startswith(MCAP)


def resumed(scene: Scene) -> None:
    """The robot is not stopped."""
    scene.relay.run_cli("resume", "robot-one").check_returncode()


def taken(scene: Scene) -> dict[str, str]:
    """The driver has control."""
    assert scene.ask("PUT", f"{ROBOT}/control")["success"]
    return {}


def released(scene: Scene) -> None:
    """The robot has no controller."""
    scene.ask("DELETE", f"{ROBOT}/control")


def stopped_by_owner(scene: Scene) -> dict[str, str]:
    """The robot is stopped, and the driver owns it; the freshness token of the preceding line is inserted in
    this one.
    """
    scene.relay.cli("right", "grant", "driver", "robot-one", "owner")
    scene.relay.run_cli("stop", "robot-one").check_returncode()
    answer = ask(scene.relay.http_port, "GET", f"{ROBOT}/control", token=scene.token)
    return {"$FRESHNESS": f"switchboard-freshness: {answer.headers['switchboard-freshness']}"}


def operating(scene: Scene) -> None:
    """The robot is not stopped, and the driver is its operator again."""
    resumed(scene)
    scene.relay.cli("right", "grant", "driver", "robot-one", "operator")


def stopped(scene: Scene, came: Came) -> bool:
    """The robot is stopped, and the answer has the user."""
    (robot,) = (each for each in scene.ask("GET", "/api/v1/robots")["robots"] if each["name"] == "robot-one")
    return bool(robot["stopped"]) and "driver" in json.dumps(reported(came)["stopped"])


def fresh(scene: Scene) -> dict[str, str]:
    """The driver has control by the preceding line."""
    answer = ask(scene.relay.http_port, "PUT", f"{ROBOT}/control", token=scene.token)
    assert answer.status == 200, answer.body
    return {"$FRESHNESS": f"switchboard-freshness: {answer.headers['switchboard-freshness']}"}


def unpiped(scene: Scene) -> None:
    """There is no pipe."""
    for each in scene.ask("GET", "/api/v1/pipes")["pipes"]:
        scene.ask("DELETE", f"/api/v1/pipes/{each['name']}")


def registered(scene: Scene) -> dict[str, str]:
    """The map is in the service registry."""
    scene.ask("POST", DIRECTORY, {"kind": "application", "name": "map", "address": "http://10.0.0.7:8000/"})
    return {}


def unregistered(scene: Scene) -> None:
    """No application is in the service registry."""
    for each in scene.ask("GET", f"{DIRECTORY}?kind=application")["entries"]:
        scene.ask("DELETE", f"{DIRECTORY}/{each['id']}")


def administering(scene: Scene) -> dict[str, str]:
    """An administrator's token replaces the document's own."""
    if "root" not in [each["user"] for each in scene.relay.cli("user", "list")]:
        scene.relay.user("root", admin=True)
    return {"$ADMIN": scene.relay.token("root")}


def with_a_group(scene: Scene) -> dict[str, str]:
    """An administrator, and a group of robots."""
    scene.relay.cli("robot", "group", "add", "upstairs")
    return administering(scene)


def without_a_group(scene: Scene) -> None:
    scene.relay.cli("robot", "group", "remove", "upstairs", "--yes")


def in_two_realms(scene: Scene) -> dict[str, str]:
    """The driver has an account in another realm, and an OAuth client."""
    scene.relay.cli("realm", "add", "lab2")
    scene.relay.cli("user", "join", "driver", "lab2")
    oauth_client = scene.relay.cli("oauth-client", "add", "driver", "--label", "reader")
    return {"$KEY": oauth_client["key"], "$SECRET": oauth_client["secret"]}


def in_one_realm(scene: Scene) -> None:
    """The other account is removed."""
    scene.relay.cli("user", "remove", "driver@lab2", "--yes")
    scene.relay.cli("realm", "remove", "lab2", "--yes")


def film(scene: Scene, printed: str) -> bool:
    """Some frames are in the file."""
    file = scene.folder / "film.mjpeg"
    return file.exists() and file.read_bytes().count(b"Content-Type: image/jpeg") > 2


def orders(came: Came) -> list[Any]:
    """The lines of the answer to a fleet order."""
    return [json.loads(line) for line in came.output.splitlines()]


EXPECTED = {
    r"9090/api/v1/robots$": Expected(
        200, lambda _, came: "robot-one" in [each["name"] for each in reported(came)["robots"]]
    ),
    r"/topics/odom$": Expected(
        200, lambda _, came: "pose" in reported(came)["value"], before=said_on("odom")
    ),
    r"/services/reset$": Expected(200, lambda _, came: reported(came)["values"]["success"] is True),
    r'/topics/odom\?throttle_ms=500"$': Expected(
        200,
        lambda _, came: "event: message\ndata: {" in came.output,
        over=lambda _, printed: "data: {" in printed,
    ),
    r"/actions/fibonacci$": Expected(
        200, lambda _, came: reported(came)["result"] == {"sequence": [0, 1, 1, 2, 3]}
    ),
    r"/video/cameras$": Expected(
        200, lambda _, came: "/camera/image_raw" in [each["name"] for each in reported(came)["cameras"]]
    ),
    r"/video/snapshot\?.* -o now\.jpg$": Expected(
        200, lambda scene, _: (scene.folder / "now.jpg").read_bytes().startswith(JPEG), before=seen
    ),
    r"/video/stream\?.* -o film\.mjpeg$": Expected(
        200, lambda scene, _: film(scene, ""), before=seen, over=film
    ),
    r"^TICKET=": Expected(201, lambda _, came: re.fullmatch(r"swb_[\w-]+", came.output) is not None),
    r"--json .* \$REC$": Expected(
        201,
        lambda _, came: (
            (reported(came)["topics"], reported(came)["cameras"])
            == (["/odom", "/scan"], ["/camera/image_raw"])
        ),
        after=unrecorded,
    ),
    r'"\$AS" \$REC$': Expected(
        200,
        lambda _, came: [each["state"] for each in reported(came)["recordings"]] == ["complete"],
        before=recorded,
        after=unrecorded,
    ),
    r"-OJ \$REC/<id>/file$": Expected(200, downloaded, before=recorded, after=unrecorded),
    r"^FRESHNESS=.* -X PUT ": Expected(
        200,
        lambda _, came: re.fullmatch(r"(?i)switchboard-freshness: \S+", came.output) is not None,
        after=released,
    ),
    r"/actions/navigate_to_pose ": Expected(
        200, lambda _, came: reported(came)["result"]["error_code"] == 0, before=fresh, after=released
    ),
    r"/actions/follow_waypoints ": Expected(
        200, lambda _, came: reported(came)["result"]["missed_waypoints"] == [], before=fresh, after=released
    ),
    r"/api/v1/pipes --json": Expected(
        201, lambda _, came: reported(came)["source"]["topic"] == "/scan", after=unpiped
    ),
    r"^FRESHNESS=(?!.* -X PUT )": Expected(
        200, lambda _, came: re.fullmatch(r"(?i)switchboard-freshness: \S+", came.output) is not None
    ),
    r"/robot-one/resume$": Expected(
        200, lambda _, came: reported(came) == {"stopped": None}, before=stopped_by_owner, after=operating
    ),
    r"-X PUT .*/robot-one/control$": Expected(
        200, lambda _, came: reported(came)["control"]["holder"]["user"] == "driver", after=released
    ),
    r"-X DELETE .*/robot-one/control$": Expected(204, lambda _, came: came.output == "", before=taken),
    r"/robot-one/stop$": Expected(200, stopped, after=resumed),
    r"--json .* \$DIRECTORY$": Expected(
        201, lambda _, came: reported(came)["name"] == "map", after=unregistered
    ),
    r"\?kind=application\"$": Expected(
        200,
        lambda _, came: [each["name"] for each in reported(came)["entries"]] == ["map"],
        before=registered,
        after=unregistered,
    ),
    r"\?robot=robot-one&kind=topic\"$": Expected(
        200, lambda _, came: {"/odom", "/scan"} <= {each["name"] for each in reported(came)["entries"]}
    ),
    r"/api/v1/fleet$": Expected(
        200,
        lambda _, came: (
            (orders(came)[0]["robots"], orders(came)[-1]["done"], orders(came)[-1]["failed"])
            == (["cleaner-1"], True, 0)
        ),
    ),
    r"/topics/obstacles/places$": Expected(
        200, lambda _, came: isinstance(reported(came)["value"], dict), before=said_on("obstacles/places")
    ),
    r"/topics/say$": Expected(204, lambda _, came: came.output == ""),
    r"-d realm=lab2 ": Expected(
        200,
        lambda _, came: reported(came)["token_type"] == "Bearer",
        before=in_two_realms,
        after=in_one_realm,
    ),
    r"/realm/users$": Expected(
        201,
        lambda _, came: (reported(came)["user"], reported(came)["password"]) == ("luigi", True),
        administering,
    ),
    r"/realm/rights/robot-one/driver$": Expected(
        200,
        lambda _, came: (reported(came)["holder"], reported(came)["level"]) == ("driver", "operator"),
        administering,
    ),
    r"/realm/users/driver/oauth-clients$": Expected(
        201,
        lambda _, came: (reported(came)["scope"], bool(reported(came)["secret"])) == ("viewer", True),
        administering,
    ),
    r"/realm/robot-groups$": Expected(
        201,
        lambda _, came: reported(came) == {"group": "upstairs", "robots": []},
        administering,
        after=without_a_group,
    ),
    r"/realm/robot-groups/upstairs/members/robot-one$": Expected(
        204, lambda _, came: came.output == "", with_a_group, after=without_a_group
    ),
    r"/readyz$": Expected(200, lambda _, came: reported(came)["status"] == "ok"),
    r"/metrics$": Expected(200, lambda _, came: "\nswitchboard_robots{" in came.output, administering),
    r"/alerts/rules$": Expected(
        201, lambda _, came: (reported(came)["level"], bool(reported(came)["secret"])) == ("error", True)
    ),
    **EXPECTED_OF_GUIDE,
}
"""By what the command looks like: each of those the documents show is one of these, and each of these is shown."""


def expected(example: Example) -> list[str]:
    """The expectation for an example."""
    return [each for each in EXPECTED if re.search(each, example.command, re.DOTALL)]


def has_curl() -> bool:
    """Whether this curl supports the examples: ``--json`` came with 7.82."""
    if shutil.which("curl") is None:
        return False
    done = subprocess.run(["curl", "--help", "all"], capture_output=True, text=True, timeout=60, check=False)
    return "--json" in done.stdout


USED = {
    "topics": {"/odom", "/scan", "/obstacles/places", "/say"},
    "services": {"/reset"},
    "actions": {"/fibonacci", "/navigate_to_pose", "/follow_waypoints"},
    "cameras": {"/camera/image_raw"},
}
"""What the robot has that examples use."""


TARGETS = """
[[module]]
name = "targets"
python = "robot_client.devices.target_follower:TargetFollower"
settings = { waypoints = "follow_waypoints" }
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """A relay with the demo's robot and user, an action, three services of a robot, and an offline robot."""
    assert has_curl(), "there is no curl of 7.82 or newer; scripts/setup.sh says how to get one"
    folder = tmp_path_factory.mktemp("examples")
    with ExitStack() as stack:
        scene = stack.enter_context(staged(folder, camera=True, settings=TARGETS))
        scene.relay.cli("robot", "add", "cleaner-1")
        scene.relay.cli("right", "grant", "driver", "cleaner-1", "operator")
        environment = ros_environment(scene.robot.domain)
        for service in (["obstacles"], ["speech", "--out", str(folder / "said.wav")], ["navigator"]):
            command = [str(BIN / "switchboard-robot-service"), *service]
            stack.enter_context(running(Process(command, folder, service[0], environment)))
        scene.wait_until_known(USED)
        yield scene


def test_examples_have_expected_output() -> None:
    """Exactly one; each expectation has an example."""
    assert {each.place: len(expected(each)) for each in ASKING} == {each.place: 1 for each in ASKING}
    assert set(EXPECTED) == {name for each in ASKING for name in expected(each)}


@pytest.mark.parametrize("example", ASKING, ids=lambda each: each.place)
def test_an_example_gives_the_documented_result(scene: Scene, example: Example) -> None:
    """It exits with 0, or runs until it is ended; the HTTP status and the output are as expected."""
    (name,) = expected(example)
    wanted = EXPECTED[name]
    try:
        places = wanted.before(scene)
        over = wanted.over
        came = scene.shell.run(
            example, places, None if over is None else lambda printed: over(scene, printed)
        )
        ends = {0} if over is None else {130, -2}
        assert came.code in ends, came.words
        assert came.status == wanted.status, came
        assert wanted.check(scene, came), came
    finally:
        wanted.after(scene)


def test_lines_of_shell_are_found_as_they_stand(tmp_path: Path) -> None:
    """Complete, with their line numbers; comments are left out, and other blocks are ignored."""
    page = tmp_path / "page.md"
    page.write_text(
        "# T\n\n```sh\nA=1; B=2\ncurl -s \\\n    $A   # a remark\n```\n\n```python\ncurl = 1\n```\n"
    )
    found = list(examples(page))
    assert [(each.place, each.sets, each.asks) for each in found] == [
        ("page.md:4", True, False),
        ("page.md:5", False, True),
    ]
    assert found[1].command == "curl -s \\\n    $A"
