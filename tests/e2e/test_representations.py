"""A robot's resources in RDF formats, with a real relay, a real ROS 2 robot and httpx."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from rdflib import RDF, RDFS, SOSA, XSD, Graph, Literal, URIRef

from relay_server.common.freshness_tokens import HEADER
from relay_server.http.media_types import FORMS
from relay_server.http.rdf.decode import message_in
from tests.worlds.waiting import wait_for

ROBOT = "/api/v1/robots/rover"
RDF_MEDIA = [each.media for each in FORMS if each.mark]
TWIST = """<?xml version="1.0"?>
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" xmlns:sosa="http://www.w3.org/ns/sosa/"
  xmlns:twist="{base}/api/v1/vocabulary/geometry_msgs/Twist#"
  xmlns:vector="{base}/api/v1/vocabulary/geometry_msgs/Vector3#">
  <rdf:Description rdf:about="">
    <sosa:hasResult>
      <rdf:Description>
        <rdf:type rdf:resource="{base}/api/v1/vocabulary/geometry_msgs/Twist"/>
        <twist:linear rdf:parseType="Resource">
          <vector:x rdf:datatype="http://www.w3.org/2001/XMLSchema#double">{speed}</vector:x>
        </twist:linear>
      </rdf:Description>
    </sosa:hasResult>
  </rdf:Description>
</rdf:RDF>"""
PREFIXES = """@prefix own: <{base}/api/v1/vocabulary/switchboard#> .
@prefix text: <{base}/api/v1/vocabulary/std_msgs/String#> .
@prefix sosa: <http://www.w3.org/ns/sosa/> .
"""


@pytest.fixture
def client(world: Any) -> Iterator[httpx.Client]:
    """Requests of an operator."""
    with world.over_http() as client:
        yield client


def base_of(client: httpx.Client) -> str:
    """The relay's scheme, host and port."""
    return f"http://127.0.0.1:{client.base_url.port}"


def get(client: httpx.Client, address: str, media: str, **more: Any) -> httpx.Response:
    """An answer in a format."""
    return client.get(address, headers={"Accept": media, **more})


def graph_of(answer: httpx.Response) -> Graph:
    """The graph in an answer."""
    assert answer.status_code == 200, answer.text
    media = answer.headers["content-type"].partition(";")[0]
    return Graph().parse(data=answer.content, format=media, publicID=str(answer.url))


def test_a_state_is_the_same_in_all_forms(world: Any, client: httpx.Client) -> None:
    """Read by rdflib only; each format has its own entity tag."""
    topic = {"topic": "/forms/measured", "type": "nav_msgs/msg/Odometry"}
    address = f"topics{topic['topic']}"
    with world.relay.connect("rover", world.operator) as other:
        odometry = client.get("topics/odom", params={"wait": 60}).json()["value"]
        other.send(op="advertise", **topic)

        def received() -> bool:
            other.send(op="publish", topic=topic["topic"], msg=odometry)
            return client.get(address, params={"wait": 1}).status_code == 200

        wait_for("it is heard", received)
        plain = client.get(address)
        tags = {plain.headers["etag"]}
        for media in RDF_MEDIA:
            answer = get(client, address, media)
            assert answer.headers["content-type"] == f"{media}; charset=utf-8"
            assert answer.headers["vary"] == "Accept"
            said = message_in(graph_of(answer), f"{ROBOT}/{address}")
            assert said == (topic["type"], plain.json()["value"])
            tag = answer.headers["etag"]
            assert tag not in tags
            tags.add(tag)
            known = client.get(address, headers={"Accept": media, "If-None-Match": tag}, params={"wait": 0})
            assert known.status_code == 304 and known.headers["vary"] == "Accept"
            assert known.headers["etag"] == tag
            other_form = client.get(address, headers={"If-None-Match": tag}, params={"wait": 0})
            assert other_form.status_code == 200


@pytest.mark.parametrize("media", RDF_MEDIA)
def test_odometry_is_an_observation(client: httpx.Client, media: str) -> None:
    """With its sensor, its time, and numbers with their ROS types."""
    graph = graph_of(get(client, "topics/odom?wait=60", media))
    topic, words = URIRef(f"{base_of(client)}{ROBOT}/topics/odom"), f"{base_of(client)}/api/v1/vocabulary/"
    assert (topic, RDF.type, SOSA.Observation) in graph
    assert graph.value(graph.value(topic, SOSA.madeBySensor), RDF.type) == SOSA.Sensor
    when = graph.value(topic, SOSA.resultTime)
    assert isinstance(when, Literal) and when.datatype == XSD.dateTime
    x = next(graph.objects(None, URIRef(f"{words}geometry_msgs/Point#x")))
    assert isinstance(x, Literal) and x.datatype == XSD.double


def test_a_twist_in_xml_moves_the_robot(world: Any, client: httpx.Client) -> None:
    """Under the same rules as JSON: it needs a freshness token."""

    def put(speed: float, **headers: str) -> httpx.Response:
        body = TWIST.format(base=base_of(client), speed=speed)
        return client.put(
            "topics/cmd_vel", content=body, headers={"Content-Type": "application/rdf+xml", **headers}
        )

    world.left_alone()
    needed = put(0.2)
    assert (needed.status_code, needed.json()["code"]) == (428, "freshness_required")
    moment = needed.headers[HEADER]

    def drives() -> bool:
        nonlocal moment
        answer = put(0.2, **{HEADER: moment})
        moment = answer.headers[HEADER]
        assert answer.status_code in (204, 412), answer.text
        return bool(world.robot.moving())

    wait_for("it moves", drives)
    client.post("control/release")
    wait_for("it stands", lambda: not world.robot.moving())


def test_a_message_in_turtle_reaches_subscribers(world: Any, client: httpx.Client) -> None:
    """Its type follows from its terms, and its content is checked."""
    topic = {"topic": "/forms/said", "type": "std_msgs/msg/String"}
    headers = {"Content-Type": "text/turtle"}
    prefixes = PREFIXES.format(base=base_of(client))
    with world.relay.connect("rover", world.operator) as other:
        other.send(op="subscribe", **topic)
        body = f'{prefixes}<> sosa:hasResult [ text:data "by hand" ] .'
        assert client.post("topics/forms/said", content=body, headers=headers).status_code == 204
        assert other.until(op="publish", topic=topic["topic"])["msg"] == {"data": "by hand"}
        for wrong in ("text:data 5", "text:what 5"):
            answer = client.post(
                "topics/forms/said", content=f"{prefixes}<> sosa:hasResult [ {wrong} ] .", headers=headers
            )
            assert answer.status_code == 400 and wrong[5:9] in answer.json()["detail"]


def test_a_parameter_is_set_in_turtle(client: httpx.Client) -> None:
    """As it was read, in any format."""

    def found() -> str:
        """A node without a timely answer is left out."""
        listed = client.get("params", params={"limit": 1000}).json()["params"]
        return next((each["name"] for each in listed if each["name"].endswith(":use_sim_time")), "")

    address = f"params/{wait_for('a node tells its parameters', found).lstrip('/')}"
    body = f"{PREFIXES.format(base=base_of(client))}<> own:value %s ."
    headers = {"Content-Type": "text/turtle"}
    for media in RDF_MEDIA:
        read = get(client, address, media)
        (said,) = graph_of(read).objects(
            None, URIRef(f"{base_of(client)}/api/v1/vocabulary/switchboard#value")
        )
        assert said == Literal("false", datatype=XSD.boolean)
        known = get(client, address, media, **{"If-None-Match": read.headers["etag"]})
        assert known.status_code == 304 and known.headers["etag"] == read.headers["etag"]
        tag = {"If-Match": read.headers["etag"]}
        assert client.put(address, content=body % "false", headers={**headers, **tag}).status_code == 204
        stale = client.put(address, content=body % "false", headers={**headers, "If-Match": '"other-ttl"'})
        assert stale.status_code == 412
    wrong = client.put(address, content=body % '"word"', headers=headers)
    assert wrong.status_code == 409, wrong.text


def test_a_page_lists_addresses(client: httpx.Client) -> None:
    """Each of them can be read."""
    answer = get(client, "topics?name=/odom", "text/turtle")
    (odom,) = graph_of(answer).objects(None, RDFS.member)
    assert graph_of(get(client, f"{odom}?wait=60", "text/turtle"))
    # Reading a topic adds a subscriber, so that page may differ by now.
    services = get(client, "services", "text/turtle")
    known = {"If-None-Match": services.headers["etag"]}
    assert get(client, "services", "text/turtle", **known).status_code == 304
    assert len(graph_of(get(client, "services", "application/ld+json"))) > 10
    (stop,) = graph_of(get(client, "services?name=/relay/stop", "text/turtle")).objects(None, RDFS.member)
    for media in RDF_MEDIA:
        reported = graph_of(get(client, str(stop), media))
        assert set(reported.subjects()) == {stop} and len(reported) > 3


def test_a_robot_is_a_platform_with_its_collections(world: Any, client: httpx.Client) -> None:
    """It is the one in the graphs of its topics; each collection has the address of its list."""
    robot, here = URIRef(f"{base_of(client)}{ROBOT}"), f"{base_of(client)}/api/v1/vocabulary/switchboard#"
    world.robot.wait_online()
    topic = graph_of(get(client, "topics/odom?wait=60", "text/turtle"))
    assert (robot, RDF.type, SOSA.Platform) in topic
    tags = {client.get(str(robot)).headers["etag"]}
    for media in RDF_MEDIA:
        answer = get(client, str(robot), media)
        assert answer.headers["content-type"] == f"{media}; charset=utf-8"
        assert answer.headers["vary"] == "Accept"
        tags.add(answer.headers["etag"])
        graph = graph_of(answer)
        assert (robot, RDF.type, SOSA.Platform) in graph and (
            robot,
            RDF.type,
            URIRef(f"{here}Robot"),
        ) in graph
        assert graph.value(robot, URIRef(f"{here}name")) == Literal("rover", datatype=XSD.string)
        assert graph.value(robot, URIRef(f"{here}platform")) == Literal("ros2", datatype=XSD.string)
        collections = {str(each) for each in graph.objects(robot, URIRef(f"{here}collections"))}
        parts = ("topics", "services", "actions", "params", "cameras", "nodes")
        assert collections == {f"{robot}/{each}" for each in parts}
    assert len(tags) == 1 + len(RDF_MEDIA)
    for each in sorted(collections - {f"{robot}/params"}):
        assert graph_of(get(client, each, "text/turtle"))
    assert get(client, str(robot), "text/html").status_code == 406
    hidden = {"Authorization": f"Bearer {world.stranger}"}
    assert get(client, str(robot), "text/turtle", **hidden).status_code == 404


def test_missing_name_is_reported_with_existing_ones(client: httpx.Client) -> None:
    """Unsupported formats of answers and of bodies, and invalid bodies."""
    unknown = get(client, "topics/odom", "text/html")
    assert unknown.status_code == 406 and unknown.headers["vary"] == "Accept"
    assert unknown.headers["content-type"] == "application/problem+json"
    assert set(RDF_MEDIA) < set(unknown.json()["available"])
    for address in ("topics/cmd_vel", "params/x:y"):
        strange = client.put(address, content=b"x", headers={"Content-Type": "text/csv"})
        assert strange.status_code == 415 and set(RDF_MEDIA) < set(strange.json()["available"])
    for media in RDF_MEDIA:
        broken = client.put("topics/cmd_vel", content=b"<", headers={"Content-Type": media})
        assert broken.status_code == 400 and broken.json()["detail"]
    remote = b'{"@context": "http://127.0.0.1:9/", "@id": ""}'
    fetched = client.put("topics/cmd_vel", content=remote, headers={"Content-Type": "application/ld+json"})
    assert fetched.status_code == 400 and "contexts are not fetched" in fetched.json()["detail"]


def test_every_word_has_a_meaning_at_its_address(client: httpx.Client) -> None:
    """The relay's own terms, types and their fields can all be looked up."""
    read = (f"{base_of(client)}{ROBOT}", "topics/odom?wait=60", "topics", "cameras")
    graphs = [graph_of(get(client, each, "text/turtle")) for each in read]
    here = f"{base_of(client)}/api/v1/vocabulary/"
    words = {
        str(each) for graph in graphs for triple in graph for each in triple if str(each).startswith(here)
    }
    assert {
        f"{here}switchboard#moves",
        f"{here}nav_msgs/Odometry#pose",
        f"{here}geometry_msgs/Point",
    } <= words
    for document in {each.partition("#")[0] for each in words}:
        for media in (*RDF_MEDIA, "text/html"):
            assert get(client, document, media).status_code == 200, document
        reported = graph_of(get(client, document, "text/turtle"))
        # Field names without a type are defined together.
        for each in set() if document.endswith("/fields") else words:
            if each.partition("#")[0] == document:
                assert reported.value(URIRef(each), RDFS.comment) is not None, each


def test_cameras_are_resources(world: Any, client: httpx.Client) -> None:
    """Visible ones, with the addresses of their pictures."""
    name = "/camera/image_raw"

    def page() -> Any:
        return client.get("cameras", params={"name": name}).json()

    wait_for("the robot has told its cameras", lambda: page()["cameras"])
    assert [each["name"] for each in page()["cameras"]] == [name] and page()["next"] == ""
    reported = client.get(f"cameras{name}").json()
    assert reported["type"] == "sensor_msgs/msg/Image"
    snapshot = f"{base_of(client)}{reported['addresses']['snapshot']}"
    # On a busy machine the camera's publisher starts slowly.
    wait_for("a picture", lambda: client.get(snapshot).status_code == 200)
    assert client.get(snapshot).headers["content-type"] == "image/jpeg"
    width = client.get(f"cameras{name}").json()["width"]
    assert width > 0
    for media in RDF_MEDIA:
        graph = graph_of(get(client, f"cameras{name}", media))
        camera = URIRef(f"{base_of(client)}{ROBOT}/cameras{name}")
        assert graph.value(camera, SOSA.isHostedBy) == URIRef(f"{base_of(client)}{ROBOT}")
        assert (camera, RDF.type, SOSA.Sensor) in graph
    blind = world.relay.user("blind")
    world.relay.cli("right", "grant", "blind", "rover", "viewer", "--deny", "view:/camera/*")
    for token, page_status in ((blind, 200), (world.stranger, 404)):
        headers = {"Authorization": f"Bearer {token}"}
        answer = client.get("cameras", headers=headers)
        assert answer.status_code == page_status
        assert name not in answer.text
        assert client.get(f"cameras{name}", headers=headers).status_code == 404
