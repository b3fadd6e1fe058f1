"""The gateway of an MQTT broker, as a robot of a relay."""

from __future__ import annotations

from pathlib import Path

from tests.worlds.forked_programs import run_command
from tests.worlds.mosquitto import PASSWORD, USER, Mosquitto
from tests.worlds.processes import BIN, Process
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import wait_for


def gateway(relay: Relay, broker: Mosquitto, folder: Path, name: str) -> Process:
    """Enrols and starts a gateway, and waits until it is online."""
    state = folder / "gateway"
    code = relay.cli("robot", "add", name)["enrolment_code"]
    enroll = ["switchboard-robot", "enroll", "--relay", f"127.0.0.1:{relay.robots_port}"]
    enroll += ["--robot", name, "--code", "-", "--state", str(state)]
    run_command(enroll, stdin=code).check_returncode()
    config, password = folder / f"{name}.toml", folder / "password"
    password.write_text(PASSWORD + "\n")
    password.chmod(0o600)
    config.write_text(f'[mqtt]\nbroker = "{broker.address}"\nuser = "{USER}"\npassword_file = "{password}"\n')
    command = [str(BIN / "switchboard-mqtt"), "--state", str(state), "--config", str(config)]
    process = Process(command, folder, "gateway")
    wait_for("the gateway is online", lambda: relay.state_of(name) != "offline")
    return process
