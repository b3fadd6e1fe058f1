"""Names with their realm: ``toad@lab1`` (SPEC 3.1). Names are unique within one realm.

A name without ``@`` belongs to the realm :data:`DEFAULT_REALM`, which every relay has. Names contain no ``@``.
"""

from __future__ import annotations

DEFAULT_REALM = "default"


def split_name(text: str) -> tuple[str, str]:
    """Split at the first ``@`` into name and realm. Neither is checked."""
    name, at, realm = text.partition("@")
    return name, realm if at else DEFAULT_REALM


def full_name(name: str, realm: str) -> str:
    """The name that is unique on the whole relay: ``name@realm``, or ``name`` in the default realm."""
    return name if realm == DEFAULT_REALM else f"{name}@{realm}"
