"""Text from outside: check whether it can be a name, and escape it for logs and terminals."""

from __future__ import annotations


def escape_unprintable(text: str, longest: int | None = None) -> str:
    """Replace line breaks, control, bidirectional and other invisible characters by escapes.

    Otherwise escape sequences would act on a terminal, and line breaks would forge log lines.

    :param longest: most characters; longer text is cut
    """
    if longest is not None and len(text) > longest:
        text = text[:longest] + "…"
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else _escaped(each) for each in text)


def is_printable(text: str) -> bool:
    """Whether a name is printable and without U+FFFD, which replaces bytes that are not UTF-8.

    Two names that differ only in such bytes would be equal.
    """
    return text.isprintable() and "\ufffd" not in text


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
