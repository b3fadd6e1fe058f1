"""The command ``switchboard-mqtt``: the devices of an MQTT broker as one robot.

It is the daemon of a robot with another platform. Without ROS there is no guard; cameras and modules belong to
``switchboard-robot``. Covers are what moves: they need control, and a stop stops them.
"""

from __future__ import annotations

import os
import secrets
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from msgspec.structs import replace

from relay_protocol.command_output import OutputCommand
from relay_protocol.errors import Invalid, Unavailable
from robot_client import config, logs
from robot_client.apps.connection import access_token
from robot_client.cli import report_errors, warn_if_plain
from robot_client.command_line import examples
from robot_client.config import GOAL_TOPICS, RobotSettings
from robot_client.link.enrolment import StateFolder
from robot_client.link.tls import split_address
from robot_client.motion.stop_store import DiskStopStore
from robot_client.platforms.base import Platform
from robot_client.platforms.mqtt.settings import read_password
from robot_client.run import DaemonProcess
from robot_client.twisted_types import monotonic_reactor

MOTION_SERVICES = ["*/open_cover", "*/close_cover"]
MOTION_TOPICS = ["*/position/set", "*/tilt/set"]
"""Commands of covers. One message moves them, so they are goal topics."""

STOP_SERVICE = "/stop_devices"
NAMES = "devices.json"
"""File in the state folder with the names of devices."""

_RUN = (
    "switchboard-robot enroll --relay relay.example.org:9091 --tls --robot home --code - --state ./home",
    "switchboard-mqtt --state ./home --config home.toml",
    "SWITCHBOARD_TOKEN=… switchboard-mqtt --announce https://relay.example.org --config home.toml",
)


def gateway_settings(settings: RobotSettings) -> RobotSettings:
    """The settings with what devices need.

    :raises Invalid: they name what only robots with ROS have
    """
    if settings.cameras or settings.module:
        raise Invalid("switchboard-mqtt has no cameras and no modules; give them to switchboard-robot")
    safety = settings.safety
    goal_topics = [] if safety.goal_topics == GOAL_TOPICS else safety.goal_topics
    safety = replace(
        safety,
        guard=False,
        motion_services=[*safety.motion_services, *MOTION_SERVICES],
        goal_topics=[*goal_topics, *MOTION_TOPICS],
        stop_service=STOP_SERVICE,
    )
    return replace(settings, safety=safety)


def build_platform(
    reactor: Any, settings: RobotSettings, state: Path, environment: Mapping[str, str]
) -> Platform:
    """The MQTT platform.

    :param state: folder for the names of devices
    :raises Unavailable: the extra ``mqtt`` is not installed
    :raises Invalid: the password or the names can't be read
    """
    try:
        from robot_client.platforms.mqtt.broker import PahoBroker
        from robot_client.platforms.mqtt.devices import DeviceNames
        from robot_client.platforms.mqtt.platform import MqttPlatform, is_config_topic
    except ImportError as error:
        raise Unavailable(f"{error.name} is missing: pip install 'robot-switchboard[robot,mqtt]'") from None
    mqtt = settings.mqtt
    broker = PahoBroker(
        mqtt,
        read_password(mqtt, environment),
        is_config_topic(mqtt),
        reactor,
        secrets.SystemRandom().random,
    )
    return MqttPlatform(mqtt, broker, DeviceNames(state / NAMES), reactor)


@click.command(
    cls=OutputCommand, context_settings={"help_option_names": ["-h", "--help"]}, epilog=examples(*_RUN)
)
@click.version_option(package_name="robot-switchboard", message="%(version)s")
@click.option(
    "--state",
    envvar="SWITCHBOARD_ROBOT_STATE",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder with the gateway's key and enrolment.",
)
@click.option(
    "--announce",
    metavar="URL",
    help="Instead, announce the robots of the relay at this address on the broker, for Home Assistant and openHAB.",
)
@click.option(
    "--config",
    "config_path",
    envvar="SWITCHBOARD_ROBOT_CONFIG",
    type=click.Path(dir_okay=False, path_type=Path),
    help="TOML file with settings; the broker is in its table [mqtt].",
)
@click.option(
    "--log-json", is_flag=True, envvar="SWITCHBOARD_ROBOT_LOG_JSON", help="Log one JSON object per line."
)
@report_errors
def main(state: Path | None, announce: str | None, config_path: Path | None, log_json: bool) -> None:
    """Connect the devices of an MQTT broker to a Switchboard relay, or the other way round.

    The folder must be enrolled first, by 'switchboard-robot enroll'. To announce robots takes no folder, but an
    access token in the variable SWITCHBOARD_TOKEN.
    """
    os.umask(0o077)
    settings = gateway_settings(config.load(config_path, os.environ))
    if (state is None) == (announce is None):
        raise click.UsageError("give either --state or --announce")
    if announce is not None:
        announce_robots(announce, settings, log_json)
    elif state is not None:
        run_gateway(state, settings, log_json)


def announce_robots(url: str, settings: RobotSettings, log_json: bool) -> None:
    """Announce the relay's robots on the broker, until a signal ends it.

    :param url: of the relay
    :raises Invalid: the address or the password is not valid
    """
    from robot_client.apps.announce_process import check_url, run_announcer

    check_url(url)
    token = access_token()
    password = read_password(settings.mqtt, os.environ)
    logs.begin(log_json)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    run_announcer(url, token, settings.mqtt, password, ended)


def run_gateway(state: Path, settings: RobotSettings, log_json: bool) -> None:
    """Run the gateway until a signal ends it.

    :param state: folder with the enrolment
    """
    folder = StateFolder(state)
    enrolment, identity = folder.load()
    folder.lock()
    warn_if_plain(split_address(enrolment.address)[0], enrolment.tls)
    logs.begin(log_json, logs.later)
    reactor = monotonic_reactor()
    platform = build_platform(reactor, settings, state, os.environ)
    process = DaemonProcess(
        reactor, settings, enrolment, identity, DiskStopStore(state), state / "modules", platform
    )
    process.start()
    reactor.addSystemEventTrigger("before", "shutdown", process.stop)
    reactor.run()


if __name__ == "__main__":
    sys.exit(main())
