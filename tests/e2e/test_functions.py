"""Functions on a real relay, over HTTP: results, jobs that survive the relay, limits with reasons."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from jsonschema import Draft202012Validator
from openapi_spec_validator import OpenAPIV31SpecValidator
from playwright.sync_api import Browser, expect

from relay_protocol.functions import array_bytes, encode_value
from tests.worlds import offload_functions
from tests.worlds.accessibility import violations
from tests.worlds.browser import checked_pages, open_session
from tests.worlds.http_requests import Answer, ask
from tests.worlds.processes import running
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import wait_for

MSGPACK = "application/msgpack"


class OffloadingRelay:
    """A relay with the functions of the tests. ann operates rover, bob only views it."""

    def __init__(self, folder: Path) -> None:
        functions = folder / "functions"
        functions.mkdir()
        shutil.copy(offload_functions.__file__, functions)
        self.relay = Relay(folder, "--offload-folder", str(functions), "--offload-processes", "2")
        self.relay.cli("robot", "add", "rover")
        self.ann = self.relay.user("ann")
        self.bob = self.relay.user("bob")
        self.relay.cli("right", "grant", "ann", "rover", "operator")
        self.relay.cli("right", "grant", "bob", "rover", "viewer")

    def ask(self, method: str, path: str, body: Any = None, *, token: str = "", **headers: str) -> Answer:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        return ask(self.relay.http_port, method, path, body, headers=named, token=token or self.ann)

    def call(
        self, name: str, *, token: str = "", headers: dict[str, str] | None = None, **arguments: Any
    ) -> Answer:
        body = {"arguments": arguments}
        return self.ask("POST", f"/api/v1/functions/{name}", body, token=token, **(headers or {}))

    def job(self, id: str) -> dict[str, Any]:
        return dict(self.ask("GET", f"/api/v1/jobs/{id}").json)

    def stop(self) -> None:
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OffloadingRelay]:
    made = OffloadingRelay(tmp_path_factory.mktemp("functions"))
    with running(made):
        yield made


def test_a_call_is_answered_with_its_result(world: OffloadingRelay) -> None:
    answer = world.call("add", a=1, b=2)
    assert (answer.status, answer.json["result"]) == (200, {"sum": 3.0, "words": "1 + 2"})
    assert world.call("size_of", data=base64.b64encode(b"four").decode()).json["result"] == 4
    listed = {each["name"]: each for each in world.ask("GET", "/api/v1/functions").json["functions"]}
    assert listed["size_of"]["arguments"]["$defs"]["size_of"]["required"] == ["data"]
    assert listed["size_of"]["statistics"]["calls"] == 1


def test_functions_in_the_portal(world: OffloadingRelay, browser: Browser) -> None:
    with checked_pages(browser, f"http://127.0.0.1:{world.relay.http_port}", 60) as new_page:
        page = new_page(1280, 900)
        open_session(page, "ann", "correct horse")
        page.goto("/functions")
        size_of = page.locator('[data-testid="function"][data-name="size_of"]')
        size_of.get_by_test_id("function-open").click()
        size_of.get_by_test_id("function-run").click()
        expect(size_of.get_by_test_id("function-wrong")).to_have_text("data is missing.")
        chosen = {"name": "four", "mimeType": "application/octet-stream", "buffer": b"four"}
        size_of.get_by_test_id("argument-data").set_input_files([chosen])
        size_of.get_by_test_id("function-run").click()
        job = page.locator('[data-testid="job"][data-name="size_of"]').first
        expect(job.get_by_test_id("job-result")).to_have_text("4", timeout=60_000)
        sleep = page.locator('[data-testid="function"][data-name="sleep"]')
        sleep.get_by_test_id("function-open").click()
        sleep.get_by_test_id("argument-duration").fill("25")
        sleep.get_by_test_id("function-run").click()
        sleeping = page.locator('[data-testid="job"][data-name="sleep"]').first
        expect(sleeping.get_by_test_id("job-state")).to_have_text("running", timeout=60_000)
        for width in (1280, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert violations(page) == []
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        sleeping.get_by_test_id("job-remove").click()
        expect(sleeping.get_by_test_id("job-state")).to_have_text("cancelled", timeout=60_000)


def test_functions_have_an_openapi_document(world: OffloadingRelay) -> None:
    """A generic client calls a function by it alone; it has the functions of its caller."""
    found = world.ask("GET", "/api/v1/functions/openapi.json").json
    OpenAPIV31SpecValidator(found).validate()
    call = found["paths"]["/api/v1/functions/add"]["post"]
    body = call["requestBody"]["content"]["application/json"]["schema"]["properties"]["arguments"]
    arguments = found["components"]["schemas"][body["$ref"].rpartition("/")[2]]
    assert (arguments["required"], arguments["properties"]["b"]["default"]) == (["a"], 1.0)
    for values, valid in (({"a": 1, "b": 2}, True), ({"a": "one"}, False), ({"a": 1, "c": 2}, False)):
        schema = {"$ref": body["$ref"], "components": found["components"]}
        assert Draft202012Validator(schema).is_valid(values) is valid
    of_bob = world.ask("GET", "/api/v1/functions/openapi.json", token=world.bob).json
    assert of_bob["paths"].keys() <= {"/api/v1/functions/size_of"}


def test_a_function_is_an_action_for_rosbridge(world: OffloadingRelay, tmp_path: Path) -> None:
    """With feedback, a result, a reason, and cancelled; also for a robot that is away."""
    with world.relay.connect("rover", world.ann) as client:
        assert "/relay/run_function" in client.call("/rosapi/action_servers")["values"]["action_servers"]
        found = client.call("/rosapi/action_type", {"action": "/relay/run_function"})["values"]["type"]
        details = client.call("/rosapi/action_goal_details", {"type": found})["values"]["typedefs"]
        assert details[0]["fieldnames"] == ["function", "arguments", "version", "deadline"]

        def send(id: str, function: str, **arguments: Any) -> None:
            args = {"function": function, "arguments": json.dumps(arguments)}
            client.send(
                op="send_action_goal", id=id, action="/relay/run_function", action_type=found, args=args,
                feedback=True,
            )  # fmt: skip

        def ended(id: str) -> tuple[int, bool, Any]:
            answer = client.until(op="action_result", id=id)
            return answer["status"], answer["result"], answer["values"]

        send("one", "report", steps=2, go_on=str(tmp_path / "go on"))
        feedback = client.until(op="action_feedback", id="one")["values"]
        assert feedback == {"progress": 0.5, "text": "half", "state": "running"}
        (tmp_path / "go on").touch()
        status, has_result, values = ended("one")
        assert (status, has_result, values["state"], values["result"]) == (4, True, "done", "2")
        send("two", "fail", words="no light")
        status, has_result, words = ended("two")
        assert (status, has_result) == (6, False)
        assert words.startswith("error: ")
        assert "no light" in words
        send("three", "report", steps=2, go_on=str(tmp_path / "never"))
        client.until(op="action_feedback", id="three")
        client.send(op="cancel_action_goal", id="three", action="/relay/run_function")
        assert ended("three")[:2] == (5, False)
        for arguments in (
            {"function": "nothing"},
            {"function": "add", "arguments": "{"},
            {"function": 5},
            [1],
        ):
            client.send(op="send_action_goal", id="bad", action="/relay/run_function", args=arguments)
            assert ended("bad")[:2] == (0, False)
        send("four", "report", steps=2, go_on=str(tmp_path / "never"))
        client.until(op="action_feedback", id="four")
    wait_for("the end of the connection cancels it", lambda: not running_jobs(world))
    with world.relay.connect("rover", world.bob) as client:
        client.send(op="send_action_goal", id="no", action="/relay/run_function", args={"function": "add"})
        answer = client.until(op="action_result", id="no")
        assert (answer["status"], "run" in answer["values"]) == (0, True)


def running_jobs(world: OffloadingRelay) -> list[Any]:
    jobs = world.ask("GET", "/api/v1/jobs").json["jobs"]
    return [each for each in jobs if each["state"] in ("queued", "running")]


def test_large_values_go_as_binary(world: OffloadingRelay) -> None:
    import numpy as np

    cloud = np.arange(300_000, dtype=np.float32)
    answer = binary(world, "double", cloud=cloud)
    assert answer.status == 200
    body = msgspec.msgpack.decode(answer.body, ext_hook=lambda code, data: bytes(data))
    assert body["result"] == array_bytes(cloud * 2)
    assert binary(world, "size_of", data=bytes(10_000_000)).status == 200


def test_100_mb_are_refused_unread(world: OffloadingRelay) -> None:
    answer = world.ask("POST", "/api/v1/functions/size_of", Content_Type=MSGPACK, Content_Length="100000000")
    assert (answer.status, "at most" in answer.json["detail"]) == (413, True)
    answer = binary(world, "size_of", data=bytes(17 * 1024 * 1024))
    assert (answer.status, answer.json["code"]) == (413, "too_large")


def test_a_user_without_the_right_run_is_refused(world: OffloadingRelay) -> None:
    answer = world.call("add", token=world.bob, a=1)
    assert (answer.status, "run" in answer.json["detail"]) == (403, True)
    world.relay.cli("right", "grant", "bob", "rover", "viewer", "--allow", "run:/size_*")
    wait_for("the right", lambda: world.call("size_of", token=world.bob, data="").status == 200)
    assert world.call("add", token=world.bob, a=1).status == 403
    names = {
        each["name"] for each in world.ask("GET", "/api/v1/functions", token=world.bob).json["functions"]
    }
    assert names == {"size_of"}


def binary(world: OffloadingRelay, name: str, **arguments: Any) -> Answer:
    """Calls a function in MessagePack."""
    import http.client

    connection = http.client.HTTPConnection("127.0.0.1", world.relay.http_port, timeout=60)
    head = {"Content-Type": MSGPACK, "Accept": MSGPACK, "Authorization": f"Bearer {world.ann}"}
    connection.request("POST", f"/api/v1/functions/{name}", encode_value({"arguments": arguments}), head)
    answer = Answer(connection.getresponse())
    connection.close()
    return answer


@pytest.mark.parametrize(
    ("name", "arguments", "code", "words"),
    [
        ("loop_for_ever", {}, "timeout", "ran longer than 1 s"),
        ("eat_memory", {}, "memory", "more than 64 MiB"),
        ("crash", {}, "crashed", "ended its process"),
        ("unsendable", {}, "invalid_result", "can't be sent"),
        ("fail", {"words": "no light"}, "error", "no light"),
    ],
)
def test_a_failed_function_is_an_error_with_a_reason(
    world: OffloadingRelay, name: str, arguments: dict[str, Any], code: str, words: str
) -> None:
    answer = world.call(name, **arguments)
    assert (answer.status, answer.json["code"]) == (422, code)
    assert words in answer.json["detail"]
    assert world.call("add", a=1).status == 200


def test_a_job_reports_progress_and_keeps_its_result(world: OffloadingRelay, tmp_path: Path) -> None:
    go_on = tmp_path / "go on"
    begun = world.call("report", headers={"Prefer": "respond-async"}, steps=3, go_on=str(go_on))
    assert begun.status == 202
    job = begun.json["id"]
    assert begun.headers["Location"] == f"/api/v1/jobs/{job}"
    wait_for("half", lambda: world.job(job)["text"] == "half")
    assert (world.job(job)["state"], world.job(job)["progress"]) == ("running", 0.5)
    assert world.ask("GET", f"/api/v1/jobs/{job}/result").status == 202
    assert world.ask("GET", f"/api/v1/jobs/{job}", token=world.bob).status == 404
    go_on.touch()
    assert world.ask("GET", f"/api/v1/jobs/{job}/result", Prefer="wait=30").json["result"] == 3
    wait_for("the list", lambda: world.job(job)["state"] == "done")
    assert job in {each["id"] for each in world.ask("GET", "/api/v1/jobs").json["jobs"]}
    world.ask("DELETE", f"/api/v1/jobs/{job}")
    wait_for("removed", lambda: world.ask("GET", f"/api/v1/jobs/{job}").status == 404)


def test_a_key_is_carried_out_once(world: OffloadingRelay, tmp_path: Path) -> None:
    began = tmp_path / "began"
    arguments = {"duration": 0.0, "began": str(began)}
    first = world.call("sleep", headers={"Idempotency-Key": "k1"}, **arguments)
    again = world.call("sleep", headers={"Idempotency-Key": "k1"}, **arguments)
    assert (first.status, first.json["job"]) == (200, again.json["job"])
    assert began.read_bytes() == b"x"
    other = world.call("sleep", headers={"Idempotency-Key": "k1"}, duration=0.1)
    assert (other.status, other.json["code"]) == (422, "key_reused")


def test_a_running_job_is_cancelled_and_its_process_ends(world: OffloadingRelay, tmp_path: Path) -> None:
    begun = world.call("sleep", headers={"Prefer": "wait=0"}, duration=25.0, began=str(tmp_path / "began"))
    wait_for("it runs", (tmp_path / "began").exists)
    assert world.ask("DELETE", f"/api/v1/jobs/{begun.json['id']}").status == 204
    assert world.job(begun.json["id"])["state"] == "cancelled"
    assert world.call("add", a=1).status == 200


def test_jobs_outlast_a_relay_that_is_killed(world: OffloadingRelay, tmp_path: Path) -> None:
    later = {"Prefer": "respond-async"}
    done = world.call("add", headers=later, a=1, b=1)
    wait_for("stored", lambda: world.job(done.json["id"])["state"] == "done")
    cut = world.call("sleep", headers=later, duration=20.0, began=str(tmp_path / "cut"))
    repeated = world.call("crash_once", headers=later, began=str(tmp_path / "repeated"))
    wait_for("it runs", (tmp_path / "cut").exists)
    wait_for("repeated", lambda: world.job(repeated.json["id"])["state"] == "done")
    # A job begins when its row is written, which follows earlier pending writes.
    world.call("add", headers=later, a=2, b=2)
    world.relay.kill()
    world.relay.start()
    assert world.ask("GET", f"/api/v1/jobs/{done.json['id']}/result").status == 200
    wait_for("lost", lambda: world.job(cut.json["id"])["code"] == "lost")
    assert "must not be repeated" in world.job(cut.json["id"])["error"]
    assert (tmp_path / "cut").read_bytes() == b"x"
    assert (tmp_path / "repeated").read_bytes() == b"xx"
