"""What others wrote: whether it can be a name, and made harmless for logs and terminals."""

from __future__ import annotations


def inert(text: str, longest: int | None = None) -> str:
    """Text with line breaks, control, bidirectional and other invisible characters written as escapes.

    Escape sequences would act on a terminal, line breaks would forge log lines.

    :param longest: characters after which it is cut
    """
    if longest is not None and len(text) > longest:
        text = text[:longest] + "…"
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else _escaped(each) for each in text)


def legible(text: str) -> bool:
    """Whether names may be written so: printable, and without U+FFFD, which stands for bytes that were no text.

    Two names that differ in such bytes would look the same, and be the same.
    """
    return text.isprintable() and "\ufffd" not in text


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
