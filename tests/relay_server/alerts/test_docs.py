"""The examples of docs/guides/alerts.md work as they are printed."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

from relay_server.alerts.apprise import PARAMETERS
from relay_server.alerts.webhook import signature
from tests.worlds.alerts import SECRET

PAGE = Path(__file__).parents[3] / "docs/guides/alerts.md"


def test_the_documented_receiver_checks_signatures() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    shown: dict[str, Any] = {}
    exec(code, shown)  # a page of this repository
    genuine, now = shown["genuine"], int(time.time())

    def headers(at: int) -> dict[str, str]:
        stamp = str(at)
        return {"Switchboard-Timestamp": stamp, "Switchboard-Signature": signature(SECRET, stamp, b"{}")}

    assert genuine(SECRET, headers(now), b"{}")
    assert not genuine(SECRET, headers(now), b"[]")
    assert not genuine(SECRET + "x", headers(now), b"{}")
    assert not genuine(SECRET, headers(now - 600), b"{}")


def test_the_page_names_the_services_that_can_be_allowed() -> None:
    (listed,) = re.findall(r"These can be allowed: (.*?)\. ", PAGE.read_text(), re.DOTALL)
    assert re.findall(r"`(\w+)`", listed) == list(PARAMETERS)
