"""Sends messages by e-mail and many other services through Apprise, in threads, because Apprise blocks.

The administrator allows schemes of Apprise's URLs; :data:`PARAMETERS` are the parameters that URLs of a scheme may
have. If the URL names a server, its addresses are judged as for a webhook. Apprise then resolves the name again, so
these schemes should be allowed only if users are trusted with the relay's network.
"""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Collection, Mapping
from contextlib import asynccontextmanager
from importlib.util import find_spec
from typing import Any

from twisted.internet.defer import Deferred, DeferredSemaphore
from twisted.internet.defer import TimeoutError as DeferTimeout

from relay_db.queries import AlertRuleRecord
from relay_protocol.errors import Invalid, Unavailable
from relay_server.alerts import types as kinds
from relay_server.alerts.egress import NOT_PERMITTED, EgressPolicy, unreachable
from relay_server.alerts.schemas import NotificationMessage, Undelivered
from relay_server.alerts.webhook import Resolve, parse
from relay_server.common.database import BoundedThreadPool

_ALL = "format overflow pass password user verify"
"""Parameters of every service. Those for timeouts, retries and redirects are missing: the relay decides these."""

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
"""The parameters that a URL may have, by its scheme."""

SERVERS = frozenset(scheme for scheme, names in PARAMETERS.items() if "port" in names)
"""Schemes whose URLs name a server; the others use the servers of one company."""

CLOUDS: Mapping[str, str] = {"ntfy": "cloud", "ntfys": "cloud"}
"""The Apprise mode in which a scheme of :data:`SERVERS` uses the company's server nevertheless.

The host of such a URL is something else, as the topic in ``ntfy://topic``.
"""

_SIGNS = ("+", "-", ":")
"""Prefixes of parameters that become headers, or parts of a query or a message."""


def check_schemes(schemes: Collection[str]) -> None:
    """Check the schemes that an administrator allows.

    :raises Invalid: one is not in :data:`PARAMETERS`, or Apprise is not installed
    """
    for each in schemes:
        if each not in PARAMETERS:
            raise Invalid(
                f"the Apprise scheme '{each[:32]}' cannot be allowed: it is not known what its URLs make Apprise read "
                f"or fetch; allow some of {', '.join(sorted(PARAMETERS))}"
            )
    if schemes and not available():
        raise Invalid("Apprise is not installed: install the extra 'alerts', or allow no schemes")


def check_parameters(scheme: str, parsed: Mapping[str, Any]) -> None:
    """Check that a URL has only parameters of :data:`PARAMETERS`.

    :param parsed: the URL as Apprise parsed it, and will use it
    :raises Invalid: it has another one
    """
    allowed = PARAMETERS[scheme]
    # Apprise parses parameters twice; only the parser of signed ones keeps a blank before a name.
    signed = (f"{sign}{name}" for sign in _SIGNS for name in parsed.get(f"qsd{sign}", ()))
    named = (name for name in parsed.get("qsd", ()) if name and name not in allowed)
    for name in (*signed, *named):
        raise Invalid(
            f"a URL of '{scheme}' must not have the parameter '{name[:32]}' on this relay; it may have "
            f"{', '.join(sorted(allowed))}"
        )


def server_of(scheme: str, service: Any) -> tuple[str, int] | None:
    """Host and port of the server that a user chose; ``None`` if the service uses the company's server.

    :param service: Apprise's object
    """
    if scheme not in SERVERS:
        return None
    # Apprise itself decides by the mode when it sends, whatever the URL looks like.
    if scheme in CLOUDS and getattr(service, "mode", None) == CLOUDS[scheme]:
        return None
    host = getattr(service, "smtp_host", None) or getattr(service, "host", None) or ""
    return str(host), getattr(service, "port", None) or 0


THREADS = 4
FAILING_THREADS = 2
"""Threads for rules whose last message did not arrive; so others do not wait for them."""

MAX_WAITING = 64
SEND_SECONDS = 60.0
SOCKET_SECONDS = 5.0
"""How long Apprise waits for a server to accept a connection, and to answer, whatever the URL says."""


def available() -> bool:
    """Whether Apprise is installed."""
    return find_spec("apprise") is not None


class AppriseTransport:
    """Sends messages through Apprise.

    :param reactor: calls results back
    :param schemes: schemes of Apprise's URLs that the administrator allows
    :param policy: decides which addresses may be reached
    :raises Invalid: see :func:`check_schemes`
    """

    def __init__(
        self, reactor: Any, resolve: Resolve, schemes: Collection[str], policy: EgressPolicy
    ) -> None:
        check_schemes(schemes)
        self._reactor = reactor
        self._resolve = resolve
        self.schemes = sorted(schemes)
        self._policy = policy
        self._threads = BoundedThreadPool(
            reactor, "alert-apprise", THREADS, MAX_WAITING, "too many messages wait"
        )
        self._slots = DeferredSemaphore(THREADS)
        self._failing_slots = DeferredSemaphore(FAILING_THREADS)

    def start(self) -> None:
        """Start the first thread."""
        self._threads.start()

    def stop(self) -> None:
        """Finish running sends; blocks until they have ended."""
        self._threads.stop()

    async def check(self, url: str) -> None:
        """Check an Apprise URL.

        :raises Invalid: its scheme is not allowed, or Apprise does not accept it
        """
        scheme = _scheme(url)
        if scheme not in self.schemes:
            raise Invalid(
                f"this relay does not send to '{scheme[:32]}' URLs; it sends to {', '.join(self.schemes)}"
            )
        if await self._threads.run(_open, url) is None:
            raise Invalid(
                f"Apprise does not accept this URL of '{scheme}'; see the documentation of that service"
            )

    @asynccontextmanager
    async def slot(self, failing: bool) -> AsyncIterator[None]:
        """Wait for a free thread, and reserve it while the context is open.

        :param failing: the rule's last message did not arrive
        """
        if failing:
            async with self._failing_slots, self._slots:
                yield
        else:
            async with self._slots:
                yield

    async def send(self, rule: AlertRuleRecord, message: NotificationMessage) -> None:
        """Deliver one message, within :meth:`slot`.

        :raises Undelivered: it was not accepted
        """
        if _scheme(rule.url) not in self.schemes:
            raise Undelivered("the relay's administrator no longer allows this service", again=False)
        try:
            service = await self._threads.run(_open, rule.url)
            if service is None:
                raise Undelivered("Apprise no longer accepts the URL", again=False)
            if place := server_of(_scheme(rule.url), service):
                await self._check_server(place, rule.user_id)
            sending = Deferred.fromCoroutine(
                self._threads.run(_notify, service, message.title, message.text, _worst(message))
            )
            arrived = await sending.addTimeout(SEND_SECONDS, self._reactor)
        except Invalid as error:
            raise Undelivered(str(error), again=False) from None
        except (Unavailable, DeferTimeout) as error:
            words = str(error) or f"the service did not answer within {SEND_SECONDS:g} s"
            raise Undelivered(words, again=True) from None
        if not arrived:
            raise Undelivered("the service did not accept the message", again=True)

    async def _check_server(self, place: tuple[str, int], user: int) -> None:
        """:raises Undelivered: one of the server's addresses is not permitted"""
        host = _plain(place[0])
        if host is None:
            raise Undelivered("the host in the URL is not a plain name or address", again=False)
        found = await self._resolve(host, place[1], user)
        if len(self._policy.permitted(found)) < len(found):
            raise unreachable(host, NOT_PERMITTED)


def _worst(message: NotificationMessage) -> str:
    return max((each.alert.level for each in message.notices), key=kinds.severity, default="info")


def _scheme(url: str) -> str:
    return url.partition("://")[0].lower()


def _plain(host: str) -> str | None:
    """The host, without brackets; ``None`` if two parsers might read it differently."""
    shown = f"[{host}]" if ":" in host and not host.startswith("[") else host
    try:
        place = parse(f"http://{shown}/")
    except Invalid:
        return None
    return place.host if (place.port, place.target) == (80, "/") else None


def _open(url: str) -> Any:
    """Apprise's object for a URL, or ``None`` if Apprise does not accept it. Runs in a thread.

    :raises Invalid: the URL has a parameter that is not permitted
    """
    import apprise
    from apprise import plugins

    read: Any = plugins.url_to_dict
    quiet = logging.getLogger("apprise")
    # Its log lines may contain URLs with passwords.
    quiet.propagate = False
    quiet.disabled = True
    try:
        parsed = read(url)
    except Exception:  # some services raise errors of their own at an invalid URL
        return None
    if not parsed or parsed.get("schema") != _scheme(url):
        return None
    check_parameters(_scheme(url), parsed)
    # The checked dict is what Apprise uses, and it follows no redirects.
    parsed["redirect"] = False
    asset = apprise.AppriseAsset(app_id="Switchboard", async_mode=False, plugin_paths=[])
    service: Any = apprise.Apprise.instantiate(parsed, asset=asset, suppress_exceptions=True)
    if service is not None:
        for name in ("socket_connect_timeout", "socket_read_timeout"):
            setattr(service, name, SOCKET_SECONDS)
    return service


def _notify(service: Any, title: str, body: str, level: str) -> bool:
    """Send a message; false if the service did not accept it. Runs in a thread."""
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
