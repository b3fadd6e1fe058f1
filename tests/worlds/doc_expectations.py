"""Expected results of the curl lines in the documents."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tests.worlds.doc_examples import Came
from tests.worlds.doc_scene import ROBOT, Scene
from tests.worlds.http_requests import ask
from tests.worlds.waiting import wait_for


def nothing(scene: Scene) -> dict[str, str]:
    """Has no effect, before or after an example."""
    return {}


@dataclass(frozen=True)
class Expected:
    """The expected result of an example.

    :param status: of HTTP
    :param check: checks the result
    :param before: prepares the example; returns replacements in its text
    :param over: decides when to end an endless one
    :param after: undoes its effects
    """

    status: int
    check: Callable[[Scene, Came], bool]
    before: Callable[[Scene], dict[str, str]] = nothing
    over: Callable[[Scene, str], bool] | None = None
    after: Callable[[Scene], object] = nothing


def reported(came: Came) -> Any:
    """The printed JSON."""
    return json.loads(came.output)


def said_on(topic: str) -> Callable[[Scene], dict[str, str]]:
    """Waits until a topic has a message, which is kept for requests that follow soon."""

    def before(scene: Scene) -> dict[str, str]:
        scene.ask("GET", f"{ROBOT}/topics/{topic}?wait=60")
        return {}

    return before


def tagged(file: str, path: str) -> Callable[[Scene], dict[str, str]]:
    """Waits until a resource of the robot can be read, and saves its entity tag as ``curl --etag-save`` does."""

    def before(scene: Scene) -> dict[str, str]:
        def found() -> str:
            answer = ask(scene.relay.http_port, "GET", f"{ROBOT}/{path}", token=scene.token)
            return str(answer.headers["etag"]) if answer.status == 200 else ""

        tag = wait_for(f"{path} can be read", found)
        (scene.folder / file).write_text(f"{tag}\n")
        return {}

    return before
