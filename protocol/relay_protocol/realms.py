"""Names with their realm: ``toad@lab1`` (SPEC section 3.1). Names are unique within one realm.

Without ``@`` a name is of the realm :data:`DEFAULT_REALM`, which every relay has. No name has an ``@`` in it.
"""

from __future__ import annotations

DEFAULT_REALM = "default"


def parted(text: str) -> tuple[str, str]:
    """A name and its realm, neither of them checked: what follows the first ``@`` is the realm."""
    name, at, realm = text.partition("@")
    return name, realm if at else DEFAULT_REALM


def full_name(name: str, realm: str) -> str:
    """The name by which the whole relay knows somebody or something of a realm."""
    return name if realm == DEFAULT_REALM else f"{name}@{realm}"
