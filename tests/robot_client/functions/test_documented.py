"""The programs of docs/guides/offload.md."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import cv2
import numpy
import pytest
import pytest_twisted
from twisted.internet.threads import deferToThread

from relay_protocol.functions import FunctionRegistry
from robot_client.offload import cloud, decisions
from tests.worlds.doc_examples import programs

CALLS, DEFERRED, FUNCTION = (
    each.text for each in programs(Path(__file__).parents[3] / "docs/guides/offload.md")
)


def test_the_calls_of_the_document(monkeypatch: pytest.MonkeyPatch) -> None:
    """They call, submit and wait, and declare a function that runs here while nothing is critical."""

    class Submitted:
        def result(self, timeout: float) -> str:
            return f"results within {timeout:g} s"

    monkeypatch.setattr(cloud, "call", lambda name, timeout, **arguments: (name, arguments))
    monkeypatch.setattr(cloud, "submit", lambda name, **arguments: Submitted())
    scope: dict[str, Any] = {"jpeg": b"jpeg", "frames": [b"1", b"2"]}
    exec(CALLS, scope)
    assert scope["faces"] == ("detect_faces", {"image": b"jpeg"})
    assert scope["results"] == "results within 60 s"
    scope["detect"].where = "here"
    assert scope["detect"](b"jpeg") == []
    assert decisions()


@pytest_twisted.ensureDeferred
async def test_the_calls_by_deferreds_of_the_document(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud, "call", lambda name, timeout, **arguments: (name, arguments, timeout > 1))
    scope: dict[str, Any] = {"jpeg": b"jpeg", "detect": lambda image: ["found", image]}
    await eval(compile(DEFERRED, "document", "exec", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT), scope)
    assert scope["faces"] == ("detect_faces", {"image": b"jpeg"}, True)
    assert scope["found"] == ["found", b"jpeg"]
    await deferToThread(scope["workers"].close)


def test_the_function_of_the_document_is_loaded_from_a_folder(tmp_path: Path) -> None:
    (tmp_path / "brightness.py").write_text(FUNCTION)
    registry = FunctionRegistry()
    registry.load(tmp_path)
    assert registry.problems == []
    found = registry.find("brightness")
    assert found is not None
    assert (found.version, found.repeatable) == (1, True)
    jpeg = cv2.imencode(".jpg", numpy.full((8, 8, 3), 100, numpy.uint8))[1].tobytes()
    assert found.call(image=jpeg) == pytest.approx(100, abs=2)
