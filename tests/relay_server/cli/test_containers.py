"""The files of ``deploy/containers``, and the units for systemd."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from relay_server.cli.serve import serve
from relay_server.run import STOP_SECONDS
from tests.worlds.processes import BIN

DEPLOY = Path(__file__).parents[3] / "deploy"
FOLDER = DEPLOY / "containers"


def services(folder: str) -> dict[str, Any]:
    """The services of a compose file."""
    found: dict[str, Any] = yaml.safe_load((DEPLOY / folder / "compose.yaml").read_text())["services"]
    return found


def instructions(name: str) -> dict[str, list[str]]:
    """The instructions of a build file."""
    text = re.sub(r"^#.*\n", "", (FOLDER / f"{name}.Containerfile").read_text(), flags=re.MULTILINE)
    found: dict[str, list[str]] = {}
    for line in text.replace("\\\n", " ").splitlines():
        kind, _, words = line.partition(" ")
        found.setdefault(kind, []).append(words)
    return found


@pytest.mark.parametrize("folder", ["containers", "cluster"])
def test_compose_files_build_the_relay_from_the_folder_of_the_wheel(folder: str) -> None:
    builds = [each["build"] for each in services(folder).values() if "build" in each]
    assert builds
    for build in builds:
        context = (DEPLOY / folder / build["context"]).resolve()
        assert context == DEPLOY.parent / "dist"
        assert (context.parent / "dist" / build["dockerfile"]).resolve() == FOLDER / "relay.Containerfile"


def test_relay_behind_the_proxy_has_valid_options_and_time_to_stop() -> None:
    relay = services("containers")["relay"]
    context = serve.make_context("serve", relay["command"][1:])
    assert relay["command"][0] == "serve"
    assert (context.params["connections_per_network"], context.params["requests_per_second"]) == (0, 0)
    assert context.params["origins"] == ("https://${SWITCHBOARD_HOST:?the name in the certificate}",)
    assert int(relay["stop_grace_period"].removesuffix("s")) > STOP_SECONDS
    assert relay["volumes"] == ["data:/data"]


def test_proxy_passes_both_ports_on() -> None:
    proxy = services("containers")["proxy"]
    text = (FOLDER / "haproxy.cfg").read_text()
    assert re.findall(r"^    server relay (\S+)", text, re.MULTILINE) == ["relay:9090", "relay:9091"]
    assert {f":{each.split(':')[1]}" for each in proxy["ports"]} == set(re.findall(r"bind (\S+)", text))
    assert set(re.findall(r"crt (/tls/\S+)", text)) == {"/tls/relay.pem"}


@pytest.mark.parametrize(("name", "program"), [("relay", "switchboard"), ("robot", "switchboard-robot")])
def test_images_run_our_programs_without_root(name: str, program: str) -> None:
    found = instructions(name)
    assert found["USER"] == ["switchboard"]
    assert found["COPY"] == ["robot_switchboard-*.whl /wheels/"]
    (folder,) = found["VOLUME"]
    assert any(f"-o switchboard -m 700 {folder}" in each for each in found["RUN"])
    started = " ".join([*found.get("ENTRYPOINT", []), *found["CMD"]])
    assert started.startswith(f'["{program}"')
    assert shutil.which(program, path=BIN)


@pytest.mark.parametrize("unit", ["switchboard", "switchboard-robot"])
def test_units_are_valid_and_expose_little(tmp_path: Path, unit: str) -> None:
    """By systemd-analyze, which needs no running systemd; scripts/setup.sh installs it."""
    text = (DEPLOY / f"{unit}.service").read_text()
    assert f"/opt/switchboard/bin/{unit} " in text
    copied = tmp_path / f"{unit}.service"
    copied.write_text(text.replace("/opt/switchboard/bin", str(BIN)))
    for command in (["verify"], ["security", "--offline=true", "--threshold=25"]):
        done = subprocess.run(
            ["systemd-analyze", *command, copied], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        if command == ["verify"]:
            assert not [each for each in done.stderr.splitlines() if unit in each]
