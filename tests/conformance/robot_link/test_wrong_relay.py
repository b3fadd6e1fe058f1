"""A relay of another name. A file of its own, and the last one: the robot may take a minute to dial again."""

from __future__ import annotations

import contextlib

from conformance_suite import case
from link_relay import PATIENCE_AFTER_ANOTHER_NAME, LinkRelay


@case("challenge", "SPEC 2.2 challenge")
def test_another_relay(relay: LinkRelay) -> None:
    """A relay of another name than the robot was enrolled with gets no signature."""
    relay.control.cut()
    link, _ = relay.dialled("hello", relay.patience)
    relay.challenge(link, "another relay")
    link.wait_end()
    # Otherwise later cases would not work, if there were any.
    relay.patience = PATIENCE_AFTER_ANOTHER_NAME
    with contextlib.suppress(AssertionError):
        link.expect("prove", 0.0)
        raise RuntimeError("it signed for a relay it does not know")
