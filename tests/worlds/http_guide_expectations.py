"""Expected results of the curl lines in docs/guides/http.md and tokens.md, by their form."""

from __future__ import annotations

import csv
import json
import re

from rdflib import SOSA, Graph

from robot_client.sim.robot import FIRST_MAX_SPEED
from tests.worlds.doc_examples import Came, examples
from tests.worlds.doc_expectations import Expected, reported, said_on, tagged
from tests.worlds.doc_scene import GUIDES, ROBOT, Scene
from tests.worlds.http_requests import ask

EVENTS = "/api/v1/events"
SPEED = "params/switchboard_sim:max_speed"
READER = "reader"
"""The file that keeps a token which an example ends."""


def rdf(scene: Scene, came: Came) -> bool:
    """The state of a sensor, in the requested format."""
    (asked,) = re.findall(r"(?i)> accept: (\S+)", came.words)
    (media,) = re.findall(r"(?i)< content-type: ([^\s;]+)", came.words)
    return bool(
        media == asked and (None, SOSA.hasResult, None) in Graph().parse(data=came.output, format=media)
    )


def at_most(speed: float) -> Expected:
    """The robot's speed limit is set, and restored afterwards."""
    return Expected(
        204,
        lambda scene, _: bool(scene.ask("GET", f"{ROBOT}/{SPEED}")["value"] == speed),
        before=tagged("speed.tag", SPEED),
        after=lambda scene: scene.ask("PUT", f"{ROBOT}/{SPEED}", {"value": FIRST_MAX_SPEED}),
    )


def with_an_oauth_client(scene: Scene) -> dict[str, str]:
    """An OAuth client, added as in the document."""
    (adding,) = (each for path in GUIDES for each in examples(path) if " oauth-client add " in each.text)
    oauth_client = json.loads(scene.shell.run(adding, {}).output)
    return {"$KEY": oauth_client["key"], "$SECRET": oauth_client["secret"]}


def with_a_reader(scene: Scene) -> dict[str, str]:
    """A token beside the example's own."""
    token = scene.relay.token("driver")
    (scene.folder / READER).write_text(token)
    return {"$READER": token}


def ended(scene: Scene, came: Came) -> bool:
    """That token is revoked."""
    token = (scene.folder / READER).read_text()
    return ask(scene.relay.http_port, "GET", ROBOT, token=token).status == 401


def greeted(scene: Scene) -> dict[str, str]:
    """A person was greeted just before."""
    scene.ask("POST", EVENTS, {"kind": "greeted", "robot": "robot-one", "data": {"person": "ann"}})
    return {}


def tabled(scene: Scene, came: Came) -> bool:
    """The table has its events."""
    with (scene.folder / "events.csv").open(newline="") as file:
        return ("robot-one", "greeted") in [(each["robot"], each["kind"]) for each in csv.DictReader(file)]


def received(scene: Scene, printed: str) -> bool:
    """An event after the stream has opened is received."""
    if printed and not scene.ask("GET", f"{EVENTS}?kind=looked&count=true")["count"]:
        scene.ask("POST", EVENTS, {"kind": "looked", "robot": "robot-one"})
    return '"kind":"looked"' in printed


EXPECTED_OF_GUIDE = {
    r"\$API/robots$": Expected(
        200, lambda _, came: "robot-one" in [each["name"] for each in reported(came)["robots"]]
    ),
    r"--etag-compare odom\.tag": Expected(
        200,
        lambda _, came: "pose" in reported(came)["value"],
        before=tagged("odom.tag", "topics/odom?wait=60"),
    ),
    r"--etag-save speed\.tag": Expected(
        200,
        lambda scene, came: (
            reported(came)["value"] == FIRST_MAX_SPEED
            and (scene.folder / "speed.tag").read_text().startswith('"')
        ),
        before=tagged("speed.tag", SPEED),
    ),
    r"If-Match: \$\(cat speed\.tag\)": at_most(0.4),
    r"/nodes$": Expected(
        200, lambda _, came: "/switchboard_sim" in [each["name"] for each in reported(came)["nodes"]]
    ),
    r"Accept: .*/topics/battery_state$": Expected(200, rdf, before=said_on("battery_state")),
    r"Content-Type: text/turtle": at_most(0.5),
    r"grant_type=password": Expected(
        200,
        lambda _, came: {"access_token", "refresh_token"} <= reported(came).keys(),
        before=lambda _: {"$PASSWORD": "correct horse"},
    ),
    r"^READER=": Expected(
        200, lambda _, came: re.fullmatch(r"swb_[\w-]+", came.output) is not None, before=with_an_oauth_client
    ),
    r"/oauth/introspect$": Expected(
        200,
        lambda _, came: (reported(came)["active"], reported(came)["username"]) == (True, "driver"),
        with_a_reader,
    ),
    r"/oauth/revoke$": Expected(200, ended, with_a_reader),
    r"\$API/events$": Expected(201, lambda _, came: reported(came)["data"] == {"person": "ann"}),
    r"&count=true\"$": Expected(200, lambda _, came: reported(came)["count"] > 0, greeted),
    r"-o events\.csv$": Expected(200, tabled, greeted),
    r"/events\?robot=robot-one\"$": Expected(
        200, lambda _, came: "event: event\ndata: {" in came.output, over=received
    ),
}
"""Each is shown there, and what else is there other pages show too."""
