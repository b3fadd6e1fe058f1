"""``/api/openapi.json`` and ``/api/docs``: the HTTP API described, for programs and for people (SPEC section 1.13).

What they say is no secret, so nobody needs to log in to read it.
"""

from __future__ import annotations

import base64
import hashlib
from typing import Any

from klein import Klein
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException, MethodNotAllowed

from relay_protocol import jsontext
from relay_server.edges.alerts import AlertPages
from relay_server.edges.api import Api
from relay_server.edges.cameras import RobotCameras
from relay_server.edges.control import RobotControl
from relay_server.edges.directory import DirectoryPages
from relay_server.edges.events import EventPages
from relay_server.edges.fleet import FleetApi
from relay_server.edges.goals import RobotGoals
from relay_server.edges.limiting import RequestLimits, TooManyRequests
from relay_server.edges.modules import RobotModules
from relay_server.edges.oauth import OAuth
from relay_server.edges.presence import RobotPeople
from relay_server.edges.problems import problem, problem_of
from relay_server.edges.realm import RealmPages
from relay_server.edges.recordings import RobotRecordings
from relay_server.edges.resources import RobotResources
from relay_server.edges.site import POLICY, SECURITY_HEADERS, Robots
from relay_server.edges.static_files import StaticFile
from relay_server.edges.video.resource import Video
from relay_server.edges.vocabulary import VocabularyPages
from relay_server.openapi import Answer, Credential, Operation, described, document, operations_in, page
from relay_server.openapi.style import STYLE

SERVED = (
    Api,
    AlertPages,
    DirectoryPages,
    EventPages,
    FleetApi,
    OAuth,
    RealmPages,
    RobotCameras,
    RobotControl,
    RobotGoals,
    RobotModules,
    RobotPeople,
    RobotRecordings,
    RobotResources,
    Robots,
    Video,
    VocabularyPages,
)
"""Whose operations are described."""

STYLE_SOURCE = b"'sha256-%b'" % base64.b64encode(hashlib.sha256(STYLE.encode()).digest())

_CACHED = {"ETag": "names this document in this encoding", "Vary": "`Accept-Encoding`: it may be compressed"}


class Documents:
    """The two addresses as a klein application.

    :param version: the relay's
    :param cookie: name of its session cookie
    """

    app = Klein()

    def __init__(self, limits: RequestLimits, version: str, cookie: str) -> None:
        self._limits = limits
        made = document(operations(), version, cookie)
        self._json = StaticFile(jsontext.encode(made), "application/json")
        # Its only style is in the page itself, named by its hash (CSP level 3, section 2.3.1).
        policy = SECURITY_HEADERS[POLICY].replace(b"style-src 'self'", b"style-src " + STYLE_SOURCE)
        self._page = StaticFile(page(made).encode(), "text/html", headers={POLICY: policy})

    @app.route("/api/openapi.json", methods=["GET"])
    @described(
        Operation(
            method="GET",
            path="/api/openapi.json",
            tag="relay",
            summary="This document",
            answers={
                200: Answer("OpenAPI 3.1", dict[str, Any], headers=_CACHED),
                304: Answer("it is as it is known", headers=_CACHED),
            },
            credential=Credential.NONE,
        )
    )
    def openapi(self, request: Request) -> bytes:
        return self._send(request, self._json)

    @app.route("/api/docs", methods=["GET"])
    @described(
        Operation(
            method="GET",
            path="/api/docs",
            tag="relay",
            summary="This document as a page",
            answers={
                200: Answer("the page", media=("text/html",), headers=_CACHED),
                304: Answer("it is as it is known", headers=_CACHED),
            },
            credential=Credential.NONE,
        )
    )
    def docs(self, request: Request) -> bytes:
        return self._send(request, self._page)

    def _send(self, request: Request, file: StaticFile) -> bytes:
        try:
            self._limits.of_network(request)
        except TooManyRequests as error:
            return problem_of(request, error)
        # It changes with the relay: a client that has it asks whether it still is the same.
        return file.answer(request)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        """Not by this method."""
        if not isinstance(failure.value, MethodNotAllowed):
            return problem(request, 404, "There is nothing at this address.")
        request.setHeader("allow", "GET, HEAD")
        return problem(request, 405, "This address does not take that method.")


def operations() -> list[Operation]:
    """All there are on the relay's port for people and programs."""
    return operations_in([each for kind in (*SERVED, Documents) for each in vars(kind).values()])
