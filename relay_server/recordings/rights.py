"""Who may record what, and who may have what was recorded."""

from __future__ import annotations

from relay_protocol.rights import Operation
from relay_server.access import Permit
from relay_server.recordings.library import RecordingEntry


def why_not(permit: Permit, see: Operation, name: str) -> str:
    """Why somebody may not record something; empty when he may.

    :param see: what is needed to see it
    """
    for operation in (Operation.RECORD, see):
        verdict = permit.judge(operation, name)
        if not verdict.allowed:
            return verdict.reason
    return ""


def why_denied(permit: Permit, entry: RecordingEntry) -> str:
    """Why somebody may not have all that a recording holds; empty when he may."""
    if permit.principal.realm != entry.realm:
        return "it was recorded in another realm"
    asked = [(Operation.SUBSCRIBE, topic) for topic in entry.topics]
    asked += [(Operation.VIEW, each) for each in (*entry.cameras, *entry.pictures)]
    return next((reason for see, name in asked if (reason := why_not(permit, see, name))), "")
