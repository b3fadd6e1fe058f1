"""Valid addresses of services."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid
from relay_server.service_registry.entries import ADDRESS, check_address

GOOD = [
    "http://10.0.0.7:8000/",
    "https://robots.example.org/map?floor=2&of=%C3%A4#top",
    "ws://[2001:db8::1]:9090/robots/rover",
    "tcp://house:5555",
    "rtsp://camera.local/stream1",
    "ros2+udp://host",
    "/api/v1/robots/rover/services/ask",
    "/",
    "http://h/" + "a" * (ADDRESS - 9),
]
BAD = [
    "",
    "map",
    "//host/path",
    "http://",
    "http:///path",
    "http:host",
    "mailto:ann@example.org",
    "urn:isbn:0451450523",
    "1http://host",
    "http://host:99999/",
    "http://host:x/",
    "http://[::1/",
    "http://a b/",
    "http://h/\n",
    "http://h/ä",
    "http://h/%zz",
    "http://h/<x>",
    "http://h\\path",
    "http://ann@host/",
    "http://ann:secret@host/",
    "http://:@host/",
    "http://host/?token=x",
    "http://host/?a=1&Access_Token=x",
    "http://host/?%74oken=x",
    "http://host/?password",
    "http://host/#access_token=x",
    "/robots/rover/video/stream?ticket=x",
    "javascript:alert(1)",
    "javascript://host/%0aalert(1)",
    "JavaScript://host/",
    "data:text/html,x",
    "file://host/etc/passwd",
    "file:///etc/passwd",
    "blob://host/x",
    "http://h/" + "a" * (ADDRESS - 8),
]


@pytest.mark.parametrize("text", GOOD)
def test_usable_addresses_are_accepted(text: str) -> None:
    """They are stored unchanged."""
    assert check_address(text) == text


@pytest.mark.parametrize("text", BAD)
def test_unsafe_addresses_are_refused(text: str) -> None:
    """The error does not contain the secret."""
    with pytest.raises(Invalid) as caught:
        check_address(text)
    assert "address" in str(caught.value) and "secret" not in str(caught.value)
