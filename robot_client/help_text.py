"""Parts of what ``--help`` prints."""

from __future__ import annotations


def examples(*lines: str) -> str:
    """An epilog of examples that is not wrapped anew."""
    body = "\n".join(f"  {line}" for line in lines)
    return f"\b\nExamples:\n{body}"
