"""What form a client asks for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from relay_protocol import rosbridge
from relay_protocol.limits import KIB
from relay_server.channels import encodings
from relay_server.channels.encodings import MessageEncoding
from relay_server.sessions import fragments as incoming


def asked(topic: bool = False, **fields: Any) -> tuple[MessageEncoding, list[tuple[str, str, rosbridge.Id]]]:
    """The form of a question, and what was told about it."""
    told: list[tuple[str, str, rosbridge.Id]] = []
    ask: encodings.EncodingRequest
    if topic:
        ask = rosbridge.Subscribe(topic="/scan", id="q", **fields)
    else:
        ask = rosbridge.CallService(service="/reset", id="q", **fields)
    return encodings.asked(ask, lambda *words: told.append(words), topic=topic), told


def test_nothing_asked_is_plain() -> None:
    """Who asks for nothing gets plain JSON, whole."""
    assert asked() == (encodings.PLAIN, [])


@pytest.mark.parametrize("compression", ["none", "png", "cbor", "cbor-raw"])
def test_known_compressions(compression: str) -> None:
    """Each compression of the protocol can be had for topics."""
    assert asked(topic=True, compression=compression) == (MessageEncoding(compression), [])


def test_raw_is_for_topics() -> None:
    """An answer has no time of arrival: cbor-raw counts as cbor there."""
    assert asked(compression="cbor-raw") == (MessageEncoding("cbor"), [])


def test_unknown_compression() -> None:
    """An unknown compression is an error that names the known ones, and plain JSON is sent."""
    form, [(level, words, id)] = asked(compression="zip")
    assert (form, level, id) == (encodings.PLAIN, "error", "q")
    assert "'zip'" in words and "cbor-raw" in words


@pytest.mark.parametrize("size", [None, 0, -5])
def test_no_fragments(size: int | None) -> None:
    """No size, zero and less mean whole messages."""
    assert asked(fragment_size=size) == (encodings.PLAIN, [])


def test_small_fragments() -> None:
    """Fragments smaller than the least are raised to it, and the client is warned."""
    form, [(level, words, _)] = asked(fragment_size=10)
    assert (form, level) == (MessageEncoding("none", 64), "warning")
    assert "64" in words


def test_a_good_size_is_taken() -> None:
    """A sensible size is taken as it is."""
    assert asked(fragment_size=1000) == (MessageEncoding("none", 1000), [])


def test_the_specification_says_the_same() -> None:
    """The sizes and counts of SPEC 1.6 are the code's."""
    spec = (Path(__file__).parents[3] / "protocol" / "SPEC.md").read_text("utf-8")
    section = spec[spec.index("### 1.6 ") : spec.index("## 2. ")]
    assert all(f"| `{compression}` |" in section for compression in encodings.COMPRESSIONS)
    assert f"longer than {encodings.MOST_PNG // KIB} KiB" in section
    assert f"Less than {encodings.LEAST} counts as {encodings.LEAST}" in section
    assert f"at most {encodings.MOST_FRAGMENTS:,} fragments" in section
    assert f"{incoming.PARTS:,} fragments together" in section
