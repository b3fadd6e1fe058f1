"""The Python examples in README.md, docs/ and the SPEC run literally as programs, against a relay and a
robot.
"""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import httpx
import pytest

from tests.worlds.doc_examples import Example, programs
from tests.worlds.doc_scene import DIRECTORY, DOCUMENTS, ROBOT, ROOT, Scene, staged
from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.waiting import PATIENCE, wait_for

ELSEWHERE = ("devices.md", "remote_goals.md", "offload.md", "tls.md")
"""Their programs run in tests/robot_client/devices, in tests/robot_client/functions, and in test_tls.py."""
PAGES = [path for path in DOCUMENTS if path.name not in ELSEWHERE]
SHOWN = [each for path in PAGES for each in programs(path)]
CONNECTED, ENDS = "ros.run()\n", "ros.terminate()\n"
RULES = "/api/v1/alerts/rules"
CONFORMANCE = ROOT / "tests" / "conformance"
RECEIVER = """
import json, sys
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

class Receiver(BaseHTTPRequestHandler):
    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        headers, secret = dict(self.headers), Path(sys.argv[1]).read_text()
        told = {
            "as it came": genuine(secret, headers, body),
            "by somebody else's secret": genuine("x" * 32, headers, body),
            "with another body": genuine(secret, headers, body + b" "),
        }
        now = time.time
        time.time = lambda: now() + 301
        told["five minutes later"] = genuine(secret, headers, body)
        self.send_response(204)
        self.end_headers()
        print("TOLD", json.dumps(told), flush=True)

server = HTTPServer(("127.0.0.1", 0), Receiver)
print("PORT", server.server_port, flush=True)
server.serve_forever()
"""
"""Of messages, by what docs/guides/alerts.md shows; its argument is the file that has the secret."""


def output_of(scene: Scene, program: str) -> list[str]:
    """Lines of output of a program that ends by itself without errors."""
    came = scene.shell.run_program(program, scene.token)
    assert (came.code, came.words) == (0, ""), came
    return came.output.splitlines()


def around() -> tuple[str, str]:
    """The connecting part of README.md's first roslibpy program, on which others build, with other content."""
    (first,) = (each.text for each in SHOWN if CONNECTED in each.text)
    begin, _, rest = first.partition(CONNECTED)
    assert rest.endswith(ENDS)
    return begin + CONNECTED, rest


def drives(scene: Scene, program: str) -> list[str]:
    """A program moves the robot, which stands afterwards; returns its output without the lengths of scans."""
    since = time.monotonic_ns()
    printed = output_of(scene, program)
    assert scene.robot.events("moving", since)
    wait_for("the robot stands", lambda: not scene.robot.moving())
    others = [each for each in printed if each != "360"]
    assert len(others) < len(printed)
    return others


def scans_and_wheels(scene: Scene, example: Example) -> None:
    """It prints the number of rays of each scan, and nothing else; the robot moves.

    It does so a second time at once: its zero has released the controls, as roslibpy sends no close frame at its end.
    """
    for _ in range(2):
        assert drives(scene, example.text) == []


def teleoperates(scene: Scene, example: Example) -> None:
    """The robot moves, and stands afterwards; nothing is printed."""
    since = time.monotonic_ns()
    begin, _ = around()
    assert output_of(scene, begin + example.text + ENDS) == []
    assert scene.robot.events("moving", since)
    wait_for("the robot stands", lambda: not scene.robot.moving())


def services_and_actions(scene: Scene, example: Example) -> None:
    """The robot is reset, and its answer is printed; so are feedback and result of the goal."""
    since = time.monotonic_ns()
    begin, _ = around()
    answer, *feedback, result = output_of(scene, begin + example.text + ENDS)
    assert ast.literal_eval(answer)["success"] is True
    assert scene.robot.events("reset", since)
    assert [ast.literal_eval(each)["sequence"][2:] for each in feedback] == [[1], [1, 2], [1, 2, 3]]
    assert "SUCCEEDED" in result
    assert "'values': {'sequence': [0, 1, 1, 2, 3]}" in result


def control(scene: Scene, example: Example) -> None:
    """It prints at once that control is free, then that the program's user has it and moves the robot."""
    wait_for("nobody has control", lambda: scene.ask("GET", f"{ROBOT}/control")["state"] == "free")
    begin, rest = around()
    printed = drives(scene, begin + example.text + rest)
    assert printed[0] == "free None None"
    assert re.fullmatch(r"held \{.*'user': 'driver'.*\} None", printed[-1])


def directory(scene: Scene, example: Example) -> None:
    """The entry is registered, renewed, found by its name with its address, and removed."""
    headers = {"Authorization": f"Bearer {scene.token}", "Accept": "text/event-stream"}
    address = f"http://127.0.0.1:{scene.relay.http_port}{DIRECTORY}"
    with httpx.stream("GET", address, headers=headers, timeout=PATIENCE) as answer:
        lines = answer.iter_lines()
        next(lines)  # from now on it prints changes
        (printed,) = output_of(scene, example.text)
        reported = (json.loads(each.removeprefix("data: ")) for each in lines if each.startswith("data: "))
        registered, removed = islice(reported, 2)
    assert ast.literal_eval(printed) == {"robot-one": "/api/v1/robots/robot-one/services/obstacles"}
    assert (registered["name"], registered["ttl"]) == ("obstacles", 30)
    assert removed["id"] == registered["id"]
    assert removed["expires"] > registered["expires"]
    assert scene.ask("GET", f"{DIRECTORY}?kind=service&name=obstacles")["entries"] == []


def goal(scene: Scene, example: Example) -> None:
    """It is started, followed to its end, and its result is read."""
    begun, *events, result = output_of(scene, example.text)
    assert begun.startswith("202 ")
    assert "event: ended" in events
    assert ast.literal_eval(result) == {"sequence": [0, 1, 1, 2, 3]}


def greeting(scene: Scene, example: Example) -> None:
    """The user is greeted once, despite a restart."""
    assert output_of(scene, example.text) == ["Hello, bob."]
    assert output_of(scene, example.text) == []


def webhook(scene: Scene, example: Example) -> None:
    """A message of the relay is genuine; with another secret or body, or five minutes later, it is not."""
    program, secret = scene.folder / "receiver.py", scene.folder / "secret"
    program.write_text(example.text + RECEIVER)
    receiver = Process([sys.executable, str(program), str(secret)], scene.folder, "receiver")
    with running(receiver):
        url = f"http://127.0.0.1:{receiver.wait_to_say('PORT').split()[1]}/"
        rule = scene.ask("POST", RULES, {"channel": "webhook", "url": url, "kinds": ["stop"]})
        secret.write_text(rule["secret"])
        sent = scene.ask("POST", f"{RULES}/{rule['id']}/test")
        scene.ask("DELETE", f"{RULES}/{rule['id']}")
        assert sent["ok"], sent
        assert json.loads(receiver.wait_to_say("TOLD").removeprefix("TOLD")) == {
            "as it came": True,
            "by somebody else's secret": False,
            "with another body": False,
            "five minutes later": False,
        }


def conformance(scene: Scene, example: Example) -> None:
    """As a file of the suite the case passes, and is in the table with its docstring's first line."""
    clients = scene.folder / "clients"
    clients.mkdir()
    shutil.copy(CONFORMANCE / "conftest.py", clients)
    imports, _, _ = (CONFORMANCE / "clients" / "test_topics_out.py").read_text().partition("\n\n\n")
    case = clients / "test_new_case.py"
    case.write_text(f"{imports}\n\n\n{example.text}")
    environment = ros_environment(scene.robot.domain)
    node = Process([sys.executable, str(CONFORMANCE / "fixture_node.py")], scene.folder, "node", environment)
    with running(node):
        node.wait_to_say("READY")
        scene.wait_until_known({"topics": {"/conformance/about", "/conformance/counter"}})
        options = ["-q", "-p", "no:cacheprovider", "--table", "--url", scene.relay.url("robot-one")]
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *options, "-c", str(ROOT / "setup.cfg"), str(case)],
            env={**os.environ, "CONFORMANCE_TOKEN": scene.token},
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
    assert done.returncode == 0, done.stdout + done.stderr
    (title,) = re.findall('"""(.*)"""', example.text)
    (row,) = (each for each in done.stdout.splitlines() if title in each)
    assert "passed" in row


RUN: dict[str, Callable[[Scene, Example], None]] = {
    r"wheels\.publish\(": scans_and_wheels,
    r"command\.publish\(": teleoperates,
    r"ActionClient\(": services_and_actions,
    r'"/relay/control"': control,
    r"/api/v1/directory": directory,
    r"/actions/fibonacci": goal,
    r'"kind": "greeted"': greeting,
    r"Switchboard-Signature": webhook,
    r"^@case\(": conformance,
}
"""By what is in its text: each program that the documents show is one of these, and each of these is shown."""


def runs(example: Example) -> list[str]:
    """The check of a program."""
    return [each for each in RUN if re.search(each, example.text)]


USED = {"topics": {"/scan", "/cmd_vel"}, "services": {"/reset"}, "actions": {"/fibonacci"}}
"""What the robot has that programs use."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """A relay with the demo's robot and user, which may send messages to this machine."""
    folder = tmp_path_factory.mktemp("examples")
    with staged(folder, "--webhook-networks", "127.0.0.0/8") as scene:
        scene.wait_until_known(USED)
        yield scene


def test_programs_are_run() -> None:
    """By exactly one check; each check has a program."""
    fences = [each for path in PAGES for each in re.findall("(?i)(?:```|~~~) *py", path.read_text())]
    assert len(fences) == len(SHOWN), "a block of Python stands where it is not found"
    assert {each.place: len(runs(each)) for each in SHOWN} == {each.place: 1 for each in SHOWN}
    assert set(RUN) == {name for each in SHOWN for name in runs(each)}


@pytest.mark.parametrize("example", SHOWN, ids=lambda each: each.place)
def test_a_program_does_what_is_documented(scene: Scene, example: Example) -> None:
    """As documented, by itself or within another program, it does its task and exits with 0."""
    (name,) = runs(example)
    RUN[name](scene, example)


def test_programs_are_found_as_they_stand(tmp_path: Path) -> None:
    """Complete, with their line numbers, for any indentation and any name of Python; other blocks are
    ignored.
    """
    page = tmp_path / "page.md"
    page.write_text(
        "# T\n\n1. One\n\n   ```py\n   x = 1\n   ```\n\n```sh\nls\n```\n\n```python title\nif x:\n    y()\n```\n"
    )
    assert [(each.place, each.text) for each in programs(page)] == [
        ("page.md:6", "x = 1\n"),
        ("page.md:14", "if x:\n    y()\n"),
    ]
