"""Messages by e-mail and many other services, through apprise, in threads: it waits where it speaks to anybody.

Which of its services may be used the administrator says; what their URLs may have :mod:`~relay_server.alerts.email`
says. Where one is a server of the user's choice, that is judged like a webhook's; but apprise connects by itself, so
nobody should be let choose it who is not trusted with the network.
"""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Collection, Iterable, Mapping
from contextlib import asynccontextmanager
from importlib.util import find_spec
from typing import Any

from twisted.internet.defer import Deferred, DeferredSemaphore
from twisted.internet.defer import TimeoutError as DeferTimeout

from relay_db.queries import AlertRuleRecord
from relay_protocol.errors import Invalid, Unavailable
from relay_server.alerts import types as kinds
from relay_server.alerts.egress import SPECIAL_NAMES, EgressPolicy, unreachable
from relay_server.alerts.message import NotificationMessage, Undelivered
from relay_server.alerts.webhook import Resolve, parse
from relay_server.common.database import BoundedThreadPool

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


THREADS = 4
DOUBTFUL = 2
"""Threads for those whose last message did not arrive: the others shall not wait for them."""

WAITING = 64
SECONDS = 60.0
SOCKET_SECONDS = 5.0
"""How long apprise waits for a server to connect, and to answer; a URL that says more is not heard."""

NEVER = frozenset({"file", "http", "https", "syslog", "dbus", "gnome", "macosx", "windows", "smpp"})
"""What works on the relay's own machine, or reads further addresses from one."""


def available() -> bool:
    """Whether apprise is installed."""
    return find_spec("apprise") is not None


class Mailing:
    """Sends messages by apprise.

    :param reactor: calls results back
    :param schemes: beginnings of apprise's URLs that the administrator allows
    :param fence: says which addresses may be reached
    :raises Invalid: one of the schemes can't be allowed
    """

    def __init__(self, reactor: Any, resolve: Resolve, schemes: Collection[str], fence: EgressPolicy) -> None:
        check(schemes)
        self._reactor = reactor
        self._resolve = resolve
        self.schemes = sorted(schemes)
        self._fence = fence
        self._threads = BoundedThreadPool(reactor, "alert-mail", THREADS, WAITING, "too many messages wait")
        self._places = DeferredSemaphore(THREADS)
        self._doubtful = DeferredSemaphore(DOUBTFUL)

    def start(self) -> None:
        """Start the first thread."""
        self._threads.start()

    def stop(self) -> None:
        """Finish what is under way; blocks for as long as that takes."""
        self._threads.stop()

    async def check(self, url: str) -> None:
        """Whether apprise can send by this URL.

        :raises Invalid: it can't, or may not
        """
        scheme = _scheme(url)
        if scheme not in self.schemes:
            raise Invalid(
                f"this relay does not send by '{scheme[:32]}'; it does by {', '.join(self.schemes)}"
            )
        if await self._threads.run(_open, url) is None:
            raise Invalid(f"this is no URL of '{scheme}' that apprise understands")

    @asynccontextmanager
    async def room(self, doubtful: bool) -> AsyncIterator[None]:
        """Wait until a thread is free for a message, and keep it meanwhile.

        :param doubtful: the message before did not arrive
        """
        if doubtful:
            async with self._doubtful, self._places:
                yield
        else:
            async with self._places:
                yield

    async def send(self, rule: AlertRuleRecord, message: NotificationMessage) -> None:
        """Deliver one message, within :meth:`room`.

        :raises Undelivered: it was not taken
        """
        if _scheme(rule.url) not in self.schemes:
            raise Undelivered("the relay's administrator does not allow this service any more", again=False)
        try:
            service = await self._threads.run(_open, rule.url)
            if service is None:
                raise Undelivered("apprise does not understand the URL any more", again=False)
            if place := server(_scheme(rule.url), service):
                await self._judge(*place, rule.user_id)
            working = Deferred.fromCoroutine(
                self._threads.run(_notify, service, message.title, message.text, _worst(message))
            )
            arrived = await working.addTimeout(SECONDS, self._reactor)
        except Invalid as error:
            raise Undelivered(str(error), again=False) from None
        except (Unavailable, DeferTimeout) as error:
            words = str(error) or f"the service did not answer within {SECONDS:g} s"
            raise Undelivered(words, again=True) from None
        if not arrived:
            raise Undelivered("the service did not take the message", again=True)

    async def _judge(self, host: str, port: int, user: int) -> None:
        plain = _plain(host)
        if plain is None:
            raise Undelivered("the URL names no server by a plain name or address", again=False)
        found = await self._resolve(plain, port, user)
        if len(self._fence.passed(found)) < len(found):
            raise unreachable(plain, SPECIAL_NAMES)


def _worst(message: NotificationMessage) -> str:
    return max((each.alert.level for each in message.notices), key=kinds.severity, default="info")


def _scheme(url: str) -> str:
    return url.partition("://")[0].lower()


def _plain(host: str) -> str | None:
    """The host, if nobody can read it in two ways; without the brackets of an IPv6 address."""
    shown = f"[{host}]" if ":" in host and not host.startswith("[") else host
    try:
        place = parse(f"http://{shown}/")
    except Invalid:
        return None
    return place.host if (place.port, place.target) == (80, "/") else None


def _open(url: str) -> Any:
    """What apprise makes of a URL, or ``None``. In a thread.

    :raises Invalid: the URL has a parameter that may do harm
    """
    import apprise
    from apprise import plugins

    read: Any = plugins.url_to_dict
    quiet = logging.getLogger("apprise")
    # What it logs may hold addresses with passwords.
    quiet.propagate = False
    quiet.disabled = True
    try:
        parsed = read(url)
    except Exception:  # some of its services fail in ways of their own at what is none of their URLs
        return None
    if not parsed or parsed.get("schema") != _scheme(url):
        return None
    judge(_scheme(url), parsed)
    # What was judged is what is used; and no answer leads anywhere else.
    parsed["redirect"] = False
    asset = apprise.AppriseAsset(app_id="Switchboard", async_mode=False, plugin_paths=[])
    service: Any = apprise.Apprise.instantiate(parsed, asset=asset, suppress_exceptions=True)
    if service is not None:
        for name in ("socket_connect_timeout", "socket_read_timeout"):
            setattr(service, name, SOCKET_SECONDS)
    return service


def _notify(service: Any, title: str, body: str, level: str) -> bool:
    """Send, and wait. In a thread."""
    import apprise

    kind = {"info": apprise.NotifyType.INFO, "warning": apprise.NotifyType.WARNING}
    sender = apprise.Apprise()
    sender.add(service)
    return bool(
        sender.notify(
            body=body,
            title=title,
            notify_type=kind.get(level, apprise.NotifyType.FAILURE),
            body_format=apprise.NotifyFormat.TEXT,
        )
    )
