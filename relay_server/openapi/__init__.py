"""The HTTP API as an OpenAPI document, made of what stands at its routes and of the types that validate.

``operation`` is the vocabulary; ``answers``, ``kept`` and ``told`` are the shapes of what is answered; ``document``
makes the document, ``page`` a page of it for people.
"""

from relay_server.openapi.document import document
from relay_server.openapi.operation import (
    JSON,
    PROBLEM,
    Answer,
    Credential,
    Operation,
    Parameter,
    Problem,
    described,
    header,
    operations_in,
    query,
    raw,
)
from relay_server.openapi.page import page

__all__ = [
    "JSON",
    "PROBLEM",
    "Answer",
    "Credential",
    "Operation",
    "Parameter",
    "Problem",
    "described",
    "document",
    "header",
    "operations_in",
    "page",
    "query",
    "raw",
]
