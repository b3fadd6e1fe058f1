"""Settings of the MQTT gateway: the table ``[mqtt]`` of the settings file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from relay_protocol.errors import Invalid

PASSWORD_VARIABLE = "SWITCHBOARD_MQTT_PASSWORD"  # noqa: S105  (the name of a variable)
"""Variable with the password, where no file is named."""

MAX_PASSWORD = 4096

_ADDRESS = re.compile(r"(\[[0-9A-Fa-f:.%]+\]|[A-Za-z0-9._-]+)(?::([0-9]{1,5}))?\Z")
_PREFIX = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*\Z")


class MqttSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The broker, and what is looked for on it.

    :param broker: ``host`` or ``host:port``; the port is 1883, with TLS 8883
    :param tls: whether to use TLS
    :param ca: PEM file of the authorities to trust, instead of the system's
    :param certificate: PEM file of a certificate of this client, with its key or beside ``key``
    :param key: PEM file of the certificate's key
    :param user: name at the broker; empty for none
    :param password_file: file with the password; empty for the variable ``SWITCHBOARD_MQTT_PASSWORD``
    :param client_id: at the broker; empty for one that the broker chooses
    :param protocol: MQTT 5, by which the broker keeps large messages away, or 3.1.1
    :param qos: quality of service of subscriptions
    :param discovery_prefix: of Home Assistant's discovery; empty for none
    :param birth: whether ``online`` is published on ``<discovery_prefix>/status`` after connecting, so that devices
        announce themselves
    :param homie: first level of Homie's topics; empty for none
    :param devices: names of the devices that take part, with ``*`` and ``?``
    """

    broker: str = "127.0.0.1"
    tls: bool = False
    ca: str = ""
    certificate: str = ""
    key: str = ""
    user: str = ""
    password_file: str = ""
    client_id: str = ""
    protocol: Literal["5", "3.1.1"] = "5"
    qos: Annotated[int, msgspec.Meta(ge=0, le=2)] = 1
    discovery_prefix: str = "homeassistant"
    birth: bool = True
    homie: str = "homie"
    devices: list[str] = msgspec.field(default_factory=lambda: ["*"])

    def __post_init__(self) -> None:
        match = _ADDRESS.match(self.broker)
        if match is None or not 0 < int(match[2] or 1883) < 65536:
            raise ValueError(f"mqtt.broker: '{self.broker[:80]}' is not host or host:port")
        if not self.tls and (self.ca or self.certificate or self.key):
            raise ValueError("mqtt: ca, certificate and key need tls = true")
        for name in ("discovery_prefix", "homie"):
            prefix = getattr(self, name)
            if prefix and not _PREFIX.match(prefix):
                raise ValueError(
                    f"mqtt.{name}: '{prefix[:80]}' can't begin topics; write letters, digits, - and _"
                )
        if "/" in self.homie:
            raise ValueError(f"mqtt.homie: '{self.homie[:80]}' must be a single level")

    @property
    def host(self) -> str:
        """The broker's host."""
        match = _ADDRESS.match(self.broker)
        assert match is not None
        return match[1].strip("[]")

    @property
    def port(self) -> int:
        """The broker's port."""
        match = _ADDRESS.match(self.broker)
        assert match is not None
        return int(match[2] or (8883 if self.tls else 1883))


def read_password(settings: MqttSettings, environment: Mapping[str, str]) -> str | None:
    """The password, from its file or the environment; ``None``: there is none.

    :raises Invalid: the file can't be read, or others may read it
    """
    if not settings.password_file:
        return environment.get(PASSWORD_VARIABLE) or None
    path = Path(settings.password_file)
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(MAX_PASSWORD + 1)
        mode = path.stat().st_mode
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise Invalid(f"the password file {path} can't be read: {reason}") from None
    if mode & 0o077:
        raise Invalid(f"others may read the password file {path}; run: chmod 600 {path}")
    if len(text) > MAX_PASSWORD or not text.strip():
        raise Invalid(f"the password file {path} must have one line of at most {MAX_PASSWORD} characters")
    return text.strip("\r\n")
