"""What has to come of the lines of curl that the documents show."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from switchboard_examples import Came
from switchboard_http import ask
from switchboard_scene import ROBOT, Scene
from switchboard_waiting import wait_for


def nothing(scene: Scene) -> dict[str, str]:
    """Nothing has to be done before, or after."""
    return {}


@dataclass(frozen=True)
class Expected:
    """What has to come of an example.

    :param status: of HTTP
    :param check: looks at what came
    :param before: makes what the example needs; what stands for what in its text
    :param over: says of one that goes on until it is ended that enough has come
    :param after: takes back what it did
    """

    status: int
    check: Callable[[Scene, Came], bool]
    before: Callable[[Scene], dict[str, str]] = nothing
    over: Callable[[Scene, str], bool] | None = None
    after: Callable[[Scene], object] = nothing


def told(came: Came) -> Any:
    """The JSON that was printed."""
    return json.loads(came.output)


def said_on(topic: str) -> Callable[[Scene], dict[str, str]]:
    """Wait until something has been said on a topic, which is kept for who asks soon."""

    def before(scene: Scene) -> dict[str, str]:
        scene.ask("GET", f"{ROBOT}/topics/{topic}?wait=60")
        return {}

    return before


def tagged(file: str, path: str) -> Callable[[Scene], dict[str, str]]:
    """Wait until a resource of the robot can be read, and save its entity tag as ``curl --etag-save`` does."""

    def before(scene: Scene) -> dict[str, str]:
        def found() -> str:
            answer = ask(scene.relay.http_port, "GET", f"{ROBOT}/{path}", token=scene.token)
            return str(answer.headers["etag"]) if answer.status == 200 else ""

        tag = wait_for(f"{path} can be read", found)
        (scene.folder / file).write_text(f"{tag}\n")
        return {}

    return before
