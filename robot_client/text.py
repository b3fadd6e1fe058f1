"""What others wrote, made harmless for logs and terminals."""

from __future__ import annotations

LONGEST = 2000


def inert(text: str) -> str:
    """Text without line breaks, control or invisible characters, at most :data:`LONGEST` long.

    Escape sequences would act on a terminal, line breaks would forge log lines.
    """
    if len(text) > LONGEST:
        text = text[:LONGEST] + "…"
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else _escaped(each) for each in text)


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
