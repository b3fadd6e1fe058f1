"""The apps' own client class and parsers (``@foxglove/ws-protocol``, ``@foxglove/rosmsg``), in a process of Node."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
CLIENT = ROOT / "tests/e2e/clients/with_foxglove.mjs"


def visit(url: str, token: str, *protocols: str) -> dict[str, Any]:
    """All operations of the client in one connection; returns its results."""
    command = [str(ROOT / "scripts" / "with-node.sh"), "node", str(CLIENT)]
    done = subprocess.run(
        [*command, url, token, *protocols], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def saw_the_robot(seen: dict[str, Any]) -> None:
    """Fields that every client must have."""
    assert seen["first"]
    assert seen["info"]["metadata"]["ROS_DISTRO"]
    # The app's parser has no wstring. Another test of the same robot publishes some, and may just have ended.
    for kind in ("unparsable", "undecodable"):
        others = {topic: error for topic, error in seen[kind].items() if "wstring" not in error}
        assert not others, others
    assert {"/scan", "/odom", "/tf", "/tf_static", "/relay/control"} <= seen["decoded"].keys()
    cdr = {each["topic"] for each in seen["channels"] if each["encoding"] == "cdr"}
    assert cdr <= {*seen["decoded"], *seen["silent"], *seen["unparsable"], *seen["undecodable"]}
    assert seen["rays"] == 360
    assert all(each["schemaEncoding"] == "ros2msg" for each in seen["channels"] if each["encoding"] == "cdr")
    assert {each["encoding"] for each in seen["channels"]} == {"cdr", "json"}
    assert seen["timestamp"] > 1.6e12
    assert "/odom" in {each["name"] for each in seen["graph"]["publishedTopics"]}
    assert seen["asset"]["status"] == 1
    assert seen["asset"]["requestId"] == 7
    assert "no service" in seen["missing"]["failure"]


def is_installed(schema: str, type_name: str, share: Path) -> bool:
    """Whether a definition, with all nested types, has the texts of the installed packages.

    :param share: the folder with the packages' folders
    """
    first, *others = schema.split(f"\n{'=' * 80}\nMSG: ")
    sections = {type_name.replace("/msg/", "/"): first}
    for each in others:
        name, _, text = each.partition("\n")
        sections[name] = text
    for name, text in sections.items():
        package, _, message = name.partition("/")
        if text.strip() != (share / package / "msg" / f"{message}.msg").read_text().strip():
            return False
    return True
