"""The process of ``switchboard-mqtt --announce``: paho's client and the loop that asks the relay."""

from __future__ import annotations

import random
import ssl
import threading
import urllib.parse
from contextlib import suppress
from typing import Any

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion
from twisted.logger import Logger

from relay_protocol.errors import Invalid
from robot_client.apps.announce import POLL_SECONDS, STATUS, Announcer, RelayApi, RelayError, Workers
from robot_client.link.tls import is_loopback
from robot_client.platforms.mqtt.settings import MqttSettings

MAX_RETRY = 60.0
"""Longest pause after the relay could not be asked, seconds."""


def check_url(url: str) -> None:
    """Check the relay's address; the token goes over plain HTTP only on this machine.

    :raises Invalid: it is no address, or not encrypted
    """
    parts = urllib.parse.urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise Invalid(f"'{url[:80]}' is not the address of a relay; write https://relay.example.org")
    if parts.scheme == "http" and not is_loopback(parts.hostname):
        raise Invalid("the access token must not go over a network without TLS; write https://")


def run_announcer(
    url: str, token: str, settings: MqttSettings, password: str | None, ended: threading.Event
) -> None:
    """Announce until ``ended`` is set."""
    client = paho.Client(CallbackAPIVersion.VERSION2)
    announcer = Announcer(
        RelayApi(url, token), client, settings.discovery_prefix, settings.homie, Workers().run
    )
    _prepare(client, settings, password, announcer)
    client.connect_async(settings.host, settings.port)
    client.loop_start()
    log, pause = Logger("announce"), POLL_SECONDS
    while not ended.wait(pause):
        if not client.is_connected():
            continue
        try:
            announcer.poll()
            pause = POLL_SECONDS
        except RelayError as error:
            log.warn("{error}", error=str(error))
            pause = max(POLL_SECONDS, min(MAX_RETRY, pause * 2) * random.uniform(0.5, 1.0))  # noqa: S311
    if client.is_connected():
        with suppress(RuntimeError, ValueError):
            client.publish(STATUS, "offline", 1, True).wait_for_publish(2)
    client.disconnect()
    client.loop_stop()


def _prepare(
    client: paho.Client,
    settings: MqttSettings,
    password: str | None,
    announcer: Announcer,
) -> None:
    if settings.user:
        client.username_pw_set(settings.user, password)
    if settings.tls:
        context = ssl.create_default_context(cafile=settings.ca or None)
        if settings.certificate:
            context.load_cert_chain(settings.certificate, settings.key or None)
        client.tls_set_context(context)
    log = Logger("announce")
    client.will_set(STATUS, "offline", 1, True)

    def on_connect(_client: Any, _data: Any, _flags: Any, code: Any, _properties: Any) -> None:
        if code.is_failure:
            log.error("the MQTT broker refuses the connection: {code}", code=str(code))
        else:
            log.info("connected to the MQTT broker at {broker}", broker=settings.broker)
            client.subscribe([(topic, 1) for topic in announcer.command_topics])
            announcer.connected()

    def on_connect_fail(_client: Any, _data: Any) -> None:
        log.error("the MQTT broker at {broker} can't be reached", broker=settings.broker, limited="broker")

    def on_disconnect(_client: Any, _data: Any, _flags: Any, code: Any, _properties: Any) -> None:
        if code.is_failure:
            log.warn("the connection to the MQTT broker was lost: {code}", code=str(code), limited="lost")

    def on_message(_client: Any, _data: Any, message: Any) -> None:
        announcer.received(message.topic, message.payload[:64].decode("utf-8", "replace"), message.retain)

    client.on_connect = on_connect
    client.on_connect_fail = on_connect_fail
    client.on_disconnect = on_disconnect
    client.on_message = on_message
