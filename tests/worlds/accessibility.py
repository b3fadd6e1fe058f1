"""axe-core's rules (WCAG 2.2 and good practice) for a page of the portal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from playwright.sync_api import Page

AXE = Path(__file__).parents[2] / "web_client" / "node_modules" / "axe-core" / "axe.min.js"


def violations(page: Page) -> list[str]:
    """Rules that a page violates, each with the elements."""
    # Not by a <script> on the page, which its CSP would refuse.
    page.evaluate(AXE.read_text("utf-8"))
    found: list[dict[str, Any]] = page.evaluate("axe.run().then(({ violations }) => violations)")
    return [f"{each['id']}: {[node['html'][:200] for node in each['nodes']]}" for each in found]
