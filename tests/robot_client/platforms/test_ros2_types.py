"""Types of ROS 2 by name."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import pytest

from relay_protocol.errors import Invalid, NotFound
from robot_client.platforms.ros2_types import Types

KINDS = {
    "message": "std_msgs/msg/String",
    "service": "std_srvs/srv/Trigger",
    "action": "example_interfaces/action/Fibonacci",
}


@pytest.mark.parametrize(("kind", "other"), itertools.permutations(KINDS, 2))
def test_a_type_known_as_one_kind_is_no_other(kind: str, other: str) -> None:
    """Its library would end the process where another kind is wanted."""
    types = Types()
    getattr(types, kind)(KINDS[kind])
    with pytest.raises(Invalid, match=f"{KINDS[kind]} is no type of "):
        getattr(types, other)(KINDS[kind])


@pytest.mark.parametrize("kind", ["msg", "srv", "action"])
def test_naming_a_type_runs_no_code_that_is_no_ros_interface(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Clients choose the names, and Python runs a package to look into it: one that may even end the process."""
    (tmp_path / "switchboard_scripts").mkdir()
    (tmp_path / "switchboard_scripts" / "__init__.py").write_text("raise SystemExit('was run')")
    (tmp_path / "switchboard_script.py").write_text("raise SystemExit('was run')")
    monkeypatch.syspath_prepend(tmp_path)
    types = Types()
    for package in ("switchboard_scripts", "switchboard_script", "antigravity", "sys", "no_such_package"):
        with pytest.raises(NotFound, match="is not installed on this robot"):
            types.definition(f"{package}/{kind}/Type")
        find = {"msg": types.message, "srv": types.service, "action": types.action}[kind]
        with pytest.raises(NotFound, match="is not installed on this robot"):
            find(f"{package}/{kind}/Type")
    assert "antigravity" not in sys.modules


@pytest.mark.parametrize("name", ["std_srvs/srv/Trigger_Request", "std_srvs/srv/Trigger_Event"])
def test_a_part_of_a_service_has_no_definition_of_its_own(name: str) -> None:
    """Newer releases of ROS have classes of these names beside the service."""
    with pytest.raises(NotFound, match="is not installed on this robot"):
        Types().definition(name)
