"""The services of apprise that users may be let use, and the parameters that a URL of each may have.

By a parameter a user can make apprise read a file of the relay's machine, or fetch an address from within its networks
(``template``, ``keyfile``, ``pgppub``, …); each version knows more of them. So what is not named here is refused. The
lists were made from the sources of apprise 2.2: nothing in them names a file, or an address that apprise itself asks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from relay_protocol.errors import Invalid

_ALL = "format overflow pass password user verify"
"""How a message looks, and who sends it. How long is waited, how often tried, where else gone the relay decides."""

_MAIL = "bcc cc from mode name port reply smtp to"
_MATTERMOST = "botname channel channels mode port team to"
_NTFY = "auth delay email port priority tags to token xtags"
_WORKFLOWS = "api-version id pa port powerautomate route routeid sig ver wrap"

_PARAMETERS = {
    "discord": "avatar botname fields flags footer ping thread tts",
    "gchat": "key thread threadkey token workspace",
    "gotify": "port priority",
    "gotifys": "port priority",
    "json": "port",
    "jsons": "port",
    "mailto": _MAIL,
    "mailtos": _MAIL,
    "mmost": _MATTERMOST,
    "mmosts": _MATTERMOST,
    "ntfy": _NTFY,
    "ntfys": _NTFY,
    "opsgenie": "alias apikey entity priority region tags to",
    "pagerduty": "apikey class component group integrationkey region severity source",
    "pover": "expire interval priority sound to",
    "slack": "blocks footer mode timestamp to token",
    "tgram": "mdv preview silent thread to topic",
    "twilio": "apikey from method sid source to token",
    "workflow": _WORKFLOWS,
    "workflows": _WORKFLOWS,
    "wxteams": "mode to token",
}
PARAMETERS: Mapping[str, frozenset[str]] = {
    scheme: frozenset(f"{_ALL} {own}".split()) for scheme, own in _PARAMETERS.items()
}
"""What a URL may have, by its scheme."""

SERVERS = frozenset(scheme for scheme, names in PARAMETERS.items() if "port" in names)
"""Those that speak to a server of the user's choice; the others have servers of their own."""

CLOUDS: Mapping[str, str] = {"ntfy": "cloud", "ntfys": "cloud"}
"""The mode, by apprise's name, in which one of these speaks to the service's own server all the same.

What stands in the place of the host is something else then, as a topic in ``ntfy://topic``.
"""

_SIGNS = ("+", "-", ":")
"""Begin parameters that become headers, parts of a query or of a message."""


def check(schemes: Iterable[str]) -> None:
    """Whether an administrator can allow these.

    :raises Invalid: one is not among the services that were looked at
    """
    for each in schemes:
        if each not in PARAMETERS:
            raise Invalid(
                f"'{each[:32]}' is no service that a relay can allow: what its URLs make apprise read or fetch is not "
                f"known here; allow some of {', '.join(sorted(PARAMETERS))}"
            )


def judge(scheme: str, parsed: Mapping[str, Any]) -> None:
    """Whether a URL has only parameters that do no harm.

    :param parsed: what apprise has read from it, and will use
    :raises Invalid: there is another one, in words
    """
    allowed = PARAMETERS[scheme]
    # Of a blank before a name only one of apprise's two ways to read it knows: the one with signs.
    signed = (f"{sign}{name}" for sign in _SIGNS for name in parsed.get(f"qsd{sign}", ()))
    named = (name for name in parsed.get("qsd", ()) if name and name not in allowed)
    for name in (*signed, *named):
        raise Invalid(
            f"a URL of '{scheme}' may not have the parameter '{name[:32]}' here; it may have "
            f"{', '.join(sorted(allowed))}"
        )


def server(scheme: str, service: Any) -> tuple[str, int] | None:
    """Host and port that a service speaks to, where they are of the user's choice.

    :param service: apprise's
    """
    if scheme not in SERVERS:
        return None
    # What apprise itself goes by when it sends, not how the URL looks.
    if scheme in CLOUDS and getattr(service, "mode", None) == CLOUDS[scheme]:
        return None
    host = getattr(service, "smtp_host", None) or getattr(service, "host", None) or ""
    return str(host), getattr(service, "port", None) or 0
