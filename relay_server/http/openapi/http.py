"""The OpenAPI document over HTTP, and the page that shows it."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Mapping
from functools import cache
from html import escape
from typing import Any

from relay_protocol import jsontext
from relay_server.alerts.http import AlertEndpoints
from relay_server.cluster.http import ClusterEndpoints
from relay_server.control.http import ControlEndpoints
from relay_server.events.http import EventEndpoints
from relay_server.files.http import FileEndpoints
from relay_server.fleet.http import FleetEndpoints
from relay_server.foxglove_urls.http import FoxgloveUrlEndpoints
from relay_server.http.endpoint import ApiRequest, endpoint, endpoints_of
from relay_server.http.logins import LoginEndpoints
from relay_server.http.media_types import JSON, MediaType
from relay_server.http.openapi.document import document
from relay_server.http.openapi.endpoints import operation_of
from relay_server.http.openapi.operation import ApiOperation, Credential, operations_in
from relay_server.http.rdf.vocabulary import VocabularyEndpoints
from relay_server.http.relay_status import StatusEndpoints
from relay_server.http.site import POLICY, SECURITY_HEADERS, RobotAddress
from relay_server.http.static_files import StaticFile
from relay_server.icpi.http import ProgramEndpoints
from relay_server.modules.http import ModuleEndpoints
from relay_server.oauth.http import OAuthEndpoints
from relay_server.offload.http import FunctionEndpoints
from relay_server.pipes.http import PipeEndpoints
from relay_server.realms.http import RealmEndpoints
from relay_server.recordings.http import RecordingEndpoints
from relay_server.resources.device_http import DeviceEndpoints
from relay_server.resources.goals_http import GoalEndpoints
from relay_server.resources.robots_http import CameraEndpoints, NodeEndpoints, RobotEndpoints
from relay_server.resources.services_http import ActionEndpoints, ParameterEndpoints, ServiceEndpoints
from relay_server.resources.topics_http import TopicEndpoints
from relay_server.roles.elements_http import RoleElementEndpoints
from relay_server.roles.http import RoleEndpoints
from relay_server.roles.runs_http import RoleRunEndpoints
from relay_server.service_registry.http import ServiceRegistryEndpoints
from relay_server.video.http import VideoResource
from relay_server.wot.http import ThingEndpoints

STYLE = """
:root { color-scheme: dark; --bg: #0e1318; --bar: #121920; --card: #161e26; --raised: #1d2731; --line: #27323d;
  --text: #e3e9ee; --quiet: #93a1ae; --accent: #58c4d6; --good: #55c08a; --warn: #e3b052; --bad: #f0766f; }
* { box-sizing: border-box; }
html { scroll-padding-top: 4.5rem; }
body { margin: 0; background: var(--bg); color: var(--text);
  font: 0.9375rem/1.5 system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', sans-serif; }
a { color: var(--accent); text-decoration: none; }
a:hover { text-decoration: underline; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; border-radius: 4px; }
code { font-family: ui-monospace, 'Cascadia Mono', 'DejaVu Sans Mono', Menlo, monospace; font-size: 0.8125rem;
  color: #b8dfe6; overflow-wrap: anywhere; }
header { position: sticky; top: 0; z-index: 2; display: flex; align-items: center; gap: 0.6rem; min-height: 3.5rem;
  padding: 0.4rem 1.25rem; background: var(--bar); border-bottom: 1px solid var(--line); }
header h1 { margin: 0; font-size: 1rem; font-weight: 600; }
.brand { display: inline-flex; align-items: center; gap: 0.6rem; font-weight: 650; color: var(--text); }
.slash { color: #3a4855; }
.end { margin-left: auto; }
.plain { padding: 0.35rem 0.75rem; border: 1px solid var(--line); border-radius: 8px; background: var(--raised);
  color: var(--text); font-size: 0.875rem; }
.page { display: grid; grid-template-columns: 11rem minmax(0, 1fr); gap: 2rem; max-width: 1360px; margin: 0 auto;
  padding: 1.25rem; }
nav { position: sticky; top: 4.75rem; align-self: start; display: flex; flex-direction: column; gap: 0.1rem; }
nav a { padding: 0.3rem 0.7rem; border-radius: 8px; color: var(--quiet); white-space: nowrap; }
nav a:hover { background: var(--raised); color: var(--text); text-decoration: none; }
section { margin-bottom: 2.25rem; }
h2 { margin: 0 0 0.2rem; font-size: 1.25rem; font-weight: 650; }
h4 { margin: 1rem 0 0.3rem; font-size: 0.8125rem; font-weight: 600; color: var(--quiet); }
p { margin: 0 0 0.75rem; max-width: 70rem; }
small, .quiet { color: var(--quiet); }
.box { margin-bottom: 0.5rem; background: var(--card); border: 1px solid var(--line); border-radius: 12px; }
.box > table { margin: 0.3rem 0.9rem; width: calc(100% - 1.8rem); }
summary { display: flex; flex-wrap: wrap; align-items: baseline; gap: 0.3rem 0.8rem; padding: 0.55rem 0.9rem;
  cursor: pointer; list-style: none; border-radius: 12px; }
summary::-webkit-details-marker { display: none; }
summary:hover { background: var(--raised); }
.method { flex: none; width: 3.8rem; font: 650 0.75rem ui-monospace, 'DejaVu Sans Mono', monospace;
  color: var(--accent); }
.method.post { color: var(--good); }
.method.put { color: var(--warn); }
.method.delete { color: var(--bad); }
.path { color: var(--text); overflow-wrap: normal; }
.says { margin-left: auto; color: var(--quiet); text-align: right; }
.inside { padding: 0.6rem 0.9rem 0.4rem; border-top: 1px solid var(--line); }
table { width: 100%; border-collapse: collapse; }
td { padding: 0.35rem 0.8rem 0.35rem 0; border-top: 1px solid var(--line); vertical-align: top; }
tr:first-child td { border-top: 0; }
td:first-child { width: 13rem; }
td:last-child { padding-right: 0; }
b.good { color: var(--good); }
b.bad { color: var(--bad); }
@media (max-width: 760px) {
  header { padding-inline: 0.75rem; }
  .brand span, .slash { display: none; }
  .page { grid-template-columns: minmax(0, 1fr); gap: 1rem; padding: 0.75rem; }
  nav { position: static; flex-flow: row wrap; }
  nav a { padding: 0.2rem 0.6rem; background: var(--raised); font-size: 0.8125rem; }
  .says { margin-left: 0; width: 100%; text-align: left; }
  td { display: block; padding: 0.1rem 0; border-top: 0; }
  td:first-child { width: auto; padding-top: 0.5rem; }
  tr + tr td:first-child { border-top: 1px solid var(--line); }
}
"""

_CODE = re.compile(r"`([^`]+)`")
_REF = "#/components/schemas/"

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Switchboard: HTTP API</title>
<link rel="icon" href="/favicon.svg">
<style>{style}</style>
</head>
<body>
<header>
<a class="brand" href="/fleet" aria-label="Switchboard, all robots">
<img src="/favicon.svg" alt="" width="28" height="28"><span>Switchboard</span></a>
<span class="slash" aria-hidden="true">/</span>
<h1>HTTP API</h1>
<a class="plain end" href="/api/openapi.json">openapi.json</a>
</header>
<div class="page">
<nav aria-label="Parts">{parts}</nav>
<main>
<section class="about">{about}<p class="quiet">Version {version} · OpenAPI {openapi}</p></section>
{sections}
<section id="credentials"><h2>Credentials</h2><div class="box"><table>{credentials}</table></div></section>
<section id="types"><h2>Types</h2>{types}</section>
</main>
</div>
</body>
</html>
"""


def page(document: Mapping[str, Any]) -> str:
    """The page, HTML."""
    tags = document["tags"]
    parts = [(each["name"], _title(each["name"])) for each in tags]
    parts += [("credentials", "Credentials"), ("types", "Types")]
    components = document["components"]
    return _PAGE.format(
        style=STYLE,
        parts="".join(f'<a href="#{name}">{escape(words)}</a>' for name, words in parts),
        about="".join(f"<p>{_words(each)}</p>" for each in document["info"]["description"].split("\n\n")),
        version=escape(document["info"]["version"]),
        openapi=escape(document["openapi"]),
        sections="\n".join(_section(tag, document) for tag in tags),
        credentials="".join(_credential(*each) for each in components["securitySchemes"].items()),
        types="\n".join(_type(name, schema) for name, schema in components["schemas"].items()),
    )


def _section(tag: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    operations = [
        _operation(path, method, each, document["components"]["responses"])
        for path, methods in document["paths"].items()
        for method, each in methods.items()
        if tag["name"] in each["tags"]
    ]
    head = f'<h2>{escape(_title(tag["name"]))}</h2><p class="quiet">{_words(tag["description"])}</p>'
    return f'<section id="{tag["name"]}">{head}{"".join(operations)}</section>'


def _title(name: str) -> str:
    return {"oauth": "OAuth"}.get(name, name.capitalize())


def _operation(path: str, method: str, each: Mapping[str, Any], shared: Mapping[str, Any]) -> str:
    inside = [f"<p>{_words(each['description'])}</p>"] if "description" in each else []
    if each.get("parameters"):
        rows = (_parameter(one) for one in each["parameters"])
        inside.append(f"<h4>Parameters</h4><table>{''.join(rows)}</table>")
    if "requestBody" in each:
        needed = "" if each["requestBody"]["required"] else " (optional)"
        inside.append(f"<h4>Body{needed}</h4><table>{_content(each['requestBody']['content'])}</table>")
    answers = "".join(
        _answer(status, shared[one["$ref"].rpartition("/")[2]] if "$ref" in one else one)
        for status, one in each["responses"].items()
    )
    inside.append(f"<h4>Answers</h4><table>{answers}</table>")
    inside.append(f'<p class="quiet">{_needs(each["security"])}</p>')
    shown = escape(path).replace("/", "/<wbr>")
    return (
        f'<details class="box" id="{escape(each["operationId"])}"><summary><span class="method {method}">'
        f'{method.upper()}</span><code class="path">{shown}</code><span class="says">{_words(each["summary"])}'
        f'</span></summary><div class="inside">{"".join(inside)}</div></details>'
    )


def _needs(security: Iterable[Mapping[str, Any]]) -> str:
    names = [name for each in security for name in each]
    if not names:
        return "Needs no credentials."
    links = (f'<a href="#credentials">{escape(name)}</a>' for name in names)
    return "Credentials: " + ", ".join(links) + (", or none" if {} in security else "")


def _parameter(one: Mapping[str, Any]) -> str:
    place = one["in"] + (", required" if one.get("required") else "")
    name = f"<code>{escape(one['name'])}</code><br><small>{place}</small>"
    return _row(name, _short(one["schema"]), _words(one["description"]))


def _content(content: Mapping[str, Any]) -> str:
    return "".join(
        _row(f"<code>{escape(media)}</code>", _short(of.get("schema", {}))) for media, of in content.items()
    )


def _answer(status: str, one: Mapping[str, Any]) -> str:
    content = one.get("content", {})
    media = "<br>".join(f"<code>{escape(each)}</code>" for each in content)
    kinds = [_short(each["schema"]) for each in content.values() if each.get("schema")]
    kind = "good" if status < "400" else "bad"
    words = _words(one["description"])
    return _row(f'<b class="{kind}">{status}</b>', words, f"{media} {' '.join(dict.fromkeys(kinds))}")


def _credential(name: str, scheme: Mapping[str, Any]) -> str:
    kind = scheme.get("scheme") or f"{scheme['in']} <code>{escape(scheme['name'])}</code>"
    return _row(f"<code>{escape(name)}</code>", kind, _words(scheme.get("description", "")))


def _type(name: str, schema: Mapping[str, Any]) -> str:
    needed = schema.get("required", ())
    rows = "".join(
        _row(
            f"<code>{escape(field)}</code>" + ("" if field in needed else "<br><small>optional</small>"),
            _short(value) + _default(value),
            _words(value.get("description", "")),
        )
        for field, value in schema.get("properties", {}).items()
    )
    words = f"<p>{_words(schema['description'])}</p>" if "description" in schema else ""
    table = f"<table>{rows}</table>" if rows else f"<p>{_short(schema)}</p>"
    # The id is inside of <details>, so that browsers open it when they jump to it.
    return (
        f'<details class="box"><summary><code class="path">{escape(name)}</code></summary>'
        f'<div class="inside" id="type-{escape(name)}">{words}{table}</div></details>'
    )


def _default(schema: Mapping[str, Any]) -> str:
    return f", else <code>{escape(repr(schema['default']))}</code>" if "default" in schema else ""


def _row(*cells: str) -> str:
    return "<tr>" + "".join(f"<td>{each}</td>" for each in cells) + "</tr>"


def _short(schema: Mapping[str, Any]) -> str:
    """A schema in a few words."""
    if "$ref" in schema:
        name = schema["$ref"].removeprefix(_REF)
        return f'<a href="#type-{escape(name)}">{escape(name)}</a>'
    if "anyOf" in schema:
        return " or ".join(_short(each) for each in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(f"<code>{escape(str(each) or '“”')}</code>" for each in schema["enum"])
    if "const" in schema:
        return f"<code>{escape(str(schema['const']))}</code>"
    kind = schema.get("type", "any JSON")
    if kind == "array":
        return f"list of {_short(schema['items'])}" if schema.get("items") else "list"
    if kind == "object" and isinstance(schema.get("additionalProperties"), dict):
        return f"object of {_short(schema['additionalProperties'])}"
    return escape(kind) + _bounds(schema)


def _bounds(schema: Mapping[str, Any]) -> str:
    if "minimum" in schema and "maximum" in schema:
        return f", {schema['minimum']:g} to {schema['maximum']:g}"
    if "exclusiveMinimum" in schema:
        return f", more than {schema['exclusiveMinimum']:g}"
    if "maxLength" in schema:
        return f", at most {schema['maxLength']} characters"
    return ""


def _words(text: str) -> str:
    return _CODE.sub(r"<code>\1</code>", escape(text, quote=False))


SERVED = (RobotAddress, VideoResource)
"""Resources whose operations are described by :func:`described`."""

PAGE = MediaType("text/html")
STYLE_SOURCE = b"'sha256-%b'" % base64.b64encode(hashlib.sha256(STYLE.encode()).digest())


_COOKIE = "name-of-the-cookie"
"""Stands for the name of the session cookie, which differs from relay to relay."""


@cache
def _texts(version: str) -> tuple[bytes, bytes]:
    """The description and its page, with :data:`_COOKIE`. All relays of a process have the same."""
    made = document(operations(), version, _COOKIE)
    return jsontext.encode(made), page(made).encode()


class DocumentEndpoints:
    """The description of the API, as OpenAPI and as a page; both are made once.

    :param version: version of the relay
    :param cookie: name of its session cookie
    """

    def __init__(self, version: str, cookie: str) -> None:
        made, shown = (text.replace(_COOKIE.encode(), cookie.encode()) for text in _texts(version))
        self._json = StaticFile(made, JSON.media)
        # The page contains its style, which the policy allows by its hash (CSP level 3, section 2.3.1).
        policy = SECURITY_HEADERS[POLICY].replace(b"style-src 'self'", b"style-src " + STYLE_SOURCE)
        self._page = StaticFile(shown, PAGE.media, headers={POLICY: policy})

    @endpoint(
        "GET",
        "/api/openapi.json",
        tag="relay",
        summary="This document",
        returns="OpenAPI 3.1",
        credential=Credential.NONE,
    )
    async def openapi(self, request: ApiRequest) -> StaticFile:
        return self._json

    @endpoint(
        "GET",
        "/api/docs",
        tag="relay",
        summary="This document as a page",
        returns="the page",
        forms=(PAGE,),
        credential=Credential.NONE,
    )
    async def docs(self, request: ApiRequest) -> StaticFile:
        return self._page


ENDPOINTS = (
    ActionEndpoints,
    AlertEndpoints,
    CameraEndpoints,
    ControlEndpoints,
    DocumentEndpoints,
    EventEndpoints,
    FleetEndpoints,
    GoalEndpoints,
    NodeEndpoints,
    ParameterEndpoints,
    RecordingEndpoints,
    ServiceRegistryEndpoints,
    RobotEndpoints,
    ServiceEndpoints,
    TopicEndpoints,
    LoginEndpoints,
    ModuleEndpoints,
    FoxgloveUrlEndpoints,
    PipeEndpoints,
    ProgramEndpoints,
    FunctionEndpoints,
    RoleElementEndpoints,
    DeviceEndpoints,
    ClusterEndpoints,
    FileEndpoints,
    RoleEndpoints,
    RoleRunEndpoints,
    OAuthEndpoints,
    RealmEndpoints,
    StatusEndpoints,
    ThingEndpoints,
    VocabularyEndpoints,
)
"""Groups of endpoints; each endpoint has its own description."""


def operations() -> list[ApiOperation]:
    """All operations on the relay's HTTP port."""
    served = [operation_of(each) for group in ENDPOINTS for each in endpoints_of(group)]
    return served + operations_in([each for kind in SERVED for each in vars(kind).values()])
