"""The simulated home of the demo: a Mosquitto broker, devices on it, and the gateway."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from relay_protocol.errors import Unavailable

HOME = "home"
"""Name of the gateway at the relay."""

_USER = "demo"
_PASSWORD = "SWITCHBOARD_MQTT_PASSWORD"  # noqa: S105  (the name of a variable)
_HASH_SECONDS = 10.0

StartProcess = Callable[[list[str], str, dict[str, str]], object]
"""Starts a command; takes it, the name of its log, and its environment."""


def check_home() -> None:
    """Check that there is a broker.

    :raises Unavailable: Mosquitto is not installed
    """
    _program("mosquitto")
    _program("mosquitto_passwd")


def start_home(folder: Path, gateway: list[str], start: StartProcess) -> None:
    """Start broker, devices and gateway. Only programs of this demo know the broker's password.

    :param folder: for their settings
    :param gateway: the command ``switchboard-mqtt``, without the option for its settings
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    environment = {**os.environ, _PASSWORD: secrets.token_urlsafe(16)}
    start(
        [_program("mosquitto"), "-c", str(_broker_settings(folder, address, environment[_PASSWORD]))],
        "broker",
        {},
    )
    devices = [sys.executable, "-m", "robot_client.sim.home", "--broker", address, "--user", _USER]
    start(devices, "home-devices", environment)
    settings = folder / "home.toml"
    settings.write_text(f"[mqtt]\nbroker = {json.dumps(address)}\nuser = {json.dumps(_USER)}\n")
    start([*gateway, "--config", str(settings)], "home-gateway", environment)


def _broker_settings(folder: Path, address: str, password: str) -> Path:
    host, _, port = address.partition(":")
    passwords = folder / "broker-passwords"
    passwords.touch(mode=0o600)
    passwords.write_text(f"{_USER}:{password}\n")
    # It replaces the password by its hash; as an argument it would be in the process list.
    subprocess.run(
        [_program("mosquitto_passwd"), "-U", str(passwords)],
        check=True,
        capture_output=True,
        timeout=_HASH_SECONDS,
    )
    settings = folder / "broker.conf"
    lines = [f"listener {port} {host}", "allow_anonymous false", f"password_file {passwords}"]
    if os.getuid() == 0:
        # Else it would become another user, who can't read the passwords.
        lines.append("user root")
    settings.write_text("\n".join(lines) + "\n")
    return settings


def _program(name: str) -> str:
    found = shutil.which(name, path=os.environ.get("PATH", "") + os.pathsep + "/usr/sbin")
    if found is None:
        raise Unavailable(
            f"{name} is not installed, which --home needs; Debian, Ubuntu: apt install mosquitto"
        )
    return found
