"""Replies of the relay as results and exceptions."""

from __future__ import annotations

import pytest

from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.function_link import FunctionReply
from relay_protocol.functions import CallFailed
from robot_client.offload.cloud import result_of


@pytest.mark.parametrize(
    ("state", "code", "error"),
    [
        ("refused", "unavailable", Unavailable),
        ("refused", "too_many_jobs", CallFailed),
        ("failed", "lost", CallFailed),
    ],
)
def test_a_call_for_which_there_is_no_worker_is_unavailable(
    state: str, code: str, error: type[SwitchboardError]
) -> None:
    with pytest.raises(error, match="no worker"):
        result_of(FunctionReply(state=state, code=code, error="no worker"))
