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
from relay_server.alerts.http import AlertResource
from relay_server.control.http import ControlResource
from relay_server.events.http import EventResource
from relay_server.fleet.http import FleetResource
from relay_server.http.api import Api
from relay_server.http.openapi.docs_ui import STYLE, page
from relay_server.http.openapi.document import document
from relay_server.http.openapi.operation import ApiOperation, Credential, Response, described, operations_in
from relay_server.http.problems import problem, problem_of
from relay_server.http.rate_limits import RequestLimits, TooManyRequests
from relay_server.http.rdf.http import VocabularyResource
from relay_server.http.site import POLICY, SECURITY_HEADERS, RobotAddress
from relay_server.http.static_files import StaticFile
from relay_server.oauth.http import OAuthResource
from relay_server.realms.http import RealmResource
from relay_server.recordings.http import RecordingResource
from relay_server.registry.http import RegistryResource
from relay_server.resources.cameras_http import CameraResource
from relay_server.resources.goals_http import GoalResource
from relay_server.resources.http import TopicResource
from relay_server.resources.nodes_http import NodeResource
from relay_server.resources.people_http import RobotUsersResource
from relay_server.video.http import VideoResource

SERVED = (
    Api,
    AlertResource,
    RegistryResource,
    EventResource,
    FleetResource,
    OAuthResource,
    RealmResource,
    CameraResource,
    ControlResource,
    GoalResource,
    NodeResource,
    RobotUsersResource,
    RecordingResource,
    TopicResource,
    RobotAddress,
    VideoResource,
    VocabularyResource,
)
"""Whose operations are described."""

STYLE_SOURCE = b"'sha256-%b'" % base64.b64encode(hashlib.sha256(STYLE.encode()).digest())

_CACHED = {"ETag": "names this document in this encoding", "Vary": "`Accept-Encoding`: it may be compressed"}


class ApiDocuments:
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
        ApiOperation(
            method="GET",
            path="/api/openapi.json",
            tag="relay",
            summary="This document",
            answers={
                200: Response("OpenAPI 3.1", dict[str, Any], headers=_CACHED),
                304: Response("it is as it is known", headers=_CACHED),
            },
            credential=Credential.NONE,
        )
    )
    def openapi(self, request: Request) -> bytes:
        return self._send(request, self._json)

    @app.route("/api/docs", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path="/api/docs",
            tag="relay",
            summary="This document as a page",
            answers={
                200: Response("the page", media=("text/html",), headers=_CACHED),
                304: Response("it is as it is known", headers=_CACHED),
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


def operations() -> list[ApiOperation]:
    """All there are on the relay's port for people and programs."""
    return operations_in([each for kind in (*SERVED, ApiDocuments) for each in vars(kind).values()])
