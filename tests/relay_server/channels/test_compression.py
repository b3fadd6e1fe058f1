"""The format that a client requests."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import rosbridge
from relay_protocol.limits import KIB
from relay_server.channels import encodings
from relay_server.channels.encodings import MessageEncoding
from relay_server.sessions import fragments as incoming
from tests.worlds.specification import CHAPTERS, unwrapped


def asked(topic: bool = False, **fields: Any) -> tuple[MessageEncoding, list[tuple[str, str, rosbridge.Id]]]:
    """The format of a request, and the reported problems."""
    reported: list[tuple[str, str, rosbridge.Id]] = []
    ask: encodings.EncodingRequest
    if topic:
        ask = rosbridge.Subscribe(topic="/scan", id="q", **fields)
    else:
        ask = rosbridge.CallService(service="/reset", id="q", **fields)
    return encodings.requested_encoding(ask, lambda *words: reported.append(words), topic=topic), reported


def test_plain_json_is_the_default() -> None:
    """A request without options gets plain JSON in one message."""
    assert asked() == (encodings.PLAIN, [])


@pytest.mark.parametrize("compression", ["none", "png", "cbor", "cbor-raw"])
def test_known_compressions(compression: str) -> None:
    assert asked(topic=True, compression=compression) == (MessageEncoding(compression), [])


def test_raw_is_for_topics() -> None:
    """An answer has no time of arrival, so cbor-raw counts as cbor."""
    assert asked(compression="cbor-raw") == (MessageEncoding("cbor"), [])


def test_unknown_compression() -> None:
    """The error names the known compressions, and plain JSON is sent."""
    form, [(level, words, id)] = asked(compression="zip")
    assert (form, level, id) == (encodings.PLAIN, "error", "q")
    assert "'zip'" in words and "cbor-raw" in words


@pytest.mark.parametrize("size", [None, 0, -5])
def test_no_fragments(size: int | None) -> None:
    """Without a size, or with zero or less, messages are whole."""
    assert asked(fragment_size=size) == (encodings.PLAIN, [])


def test_small_fragments() -> None:
    """Smaller fragments are raised to the minimum, with a warning."""
    form, [(level, words, _)] = asked(fragment_size=10)
    assert (form, level) == (MessageEncoding("none", 64), "warning")
    assert "64" in words


def test_a_good_size_is_taken() -> None:
    assert asked(fragment_size=1000) == (MessageEncoding("none", 1000), [])


def test_limits_equal_the_specification() -> None:
    """The limits of SPEC 1.6 are those of the code."""
    section = unwrapped(CHAPTERS["1.6"])
    assert all(f"| `{compression}` |" in section for compression in encodings.COMPRESSIONS)
    assert f"longer than {encodings.MAX_PNG // KIB} KiB" in section
    assert f"Less than {encodings.MIN_FRAGMENT} counts as {encodings.MIN_FRAGMENT}" in section
    assert f"at most {encodings.MAX_FRAGMENTS:,} fragments" in section
    assert f"{incoming.PARTS:,} fragments together" in section
