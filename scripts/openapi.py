"""Print the OpenAPI document of the relay's HTTP API. No relay runs: it is made of the signatures of handlers.

With ``--types`` it has only what types are made of (``make api-types``): parameters, bodies and successful answers. The
name of the session cookie differs by relay; here it is ``switchboard_session``.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import relay_server
from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations


def main() -> None:
    found = document(operations(), relay_server.VERSION, "switchboard_session")
    if sys.argv[1:] == ["--types"]:
        found["components"] = {"schemas": found["components"]["schemas"]}
        for methods in found["paths"].values():
            for method, operation in methods.items():
                methods[method] = _typed(operation)
    json.dump(found, sys.stdout, indent=2)


def _typed(operation: dict[str, Any]) -> dict[str, Any]:
    """An operation without errors, headers of answers, and words."""
    left = {name: operation[name] for name in ("parameters", "requestBody") if name in operation}
    responses = {
        status: {"description": "", **{name: part for name, part in answer.items() if name == "content"}}
        for status, answer in operation["responses"].items()
        if status < "400"
    }
    return {**left, "responses": responses}


if __name__ == "__main__":
    main()
