"""Texts of settings with fields, as ``I have arrived at {name}.``, which :meth:`str.format` fills in."""

from __future__ import annotations

import string


def check_template(setting: str, text: str, fields: list[str]) -> None:
    """Check that a text can be filled in.

    :param setting: that has the text
    :param fields: names that it may have in brackets, without formats or parts of values
    :raises ValueError: the text has another field, or a single bracket
    """
    allowed = " and ".join(f"{{{each}}}" for each in fields)
    hint = f"it may have {allowed}; write {{{{ and }}}} for brackets"
    try:
        parts = list(string.Formatter().parse(text))
    except ValueError as error:
        raise ValueError(f"{setting} = '{text}': {error}; {hint}") from None
    for _, name, format, conversion in parts:
        if name is not None and (name not in fields or format or conversion):
            field = name + f"!{conversion}" * bool(conversion) + f":{format}" * bool(format)
            raise ValueError(f"{setting} = '{text}' has the field {{{field}}}; {hint}")
