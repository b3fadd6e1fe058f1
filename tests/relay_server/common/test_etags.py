"""Entity tags of requests, also as proxies change them."""

from __future__ import annotations

import pytest

from relay_server.common.etags import PreconditionFailed, check_match, tag_of, weak

TAG = tag_of(b"a state")
BARE = TAG.strip('"')


@pytest.mark.parametrize(
    "match",
    [
        "*",
        TAG,
        f'"x", {TAG}',
        f'"", {TAG}',
        weak(TAG),
        f'"{BARE}-gzip"',
        f'W/"{BARE}-br"',
        f'"{BARE}--gzip"',
        f'"{BARE};gzip"',
    ],
)
def test_a_state_that_the_client_has_matches(match: str) -> None:
    """nginx makes tags weak when it compresses; Apache, Caddy and Jetty append a suffix."""
    check_match(TAG, match)
    check_match(weak(TAG), match)


@pytest.mark.parametrize(
    "match",
    ["", '""', 'W/""', f'"", "x{BARE}"', '"x"', f'"{BARE}x"', f'"{BARE}-gzip-x"', f'"x{BARE}"', '"-gzip"'],
)
def test_any_other_does_not(match: str) -> None:
    with pytest.raises(PreconditionFailed):
        check_match(TAG, match)
