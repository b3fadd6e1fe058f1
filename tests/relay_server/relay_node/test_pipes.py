"""The rosbridge services about pipes: malformed arguments."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from twisted.internet.defer import Deferred

from relay_protocol.errors import Invalid
from relay_server.pipes.service import PipeService
from relay_server.relay_node.pipes import PipeRosServices

NEW = '"name":"p","source":{"robot":"a","topic":"/a"},"target":{"robot":"b","topic":"/b"}'


@pytest.mark.parametrize(
    ("pipe", "words"),
    [
        ("{", "not JSON"),
        ("[]", "got `array`"),
        (f'{{{NEW},"rate":NaN}}', "not JSON"),
        (f'{{{NEW},"name":"q"}}', "the key 'name' twice"),
        (f'{{{NEW},"fields":[{{"source":"a","source":"b","target":"c"}}]}}', "the key 'source' twice"),
    ],
)
def test_a_pipe_that_can_not_be_read_is_invalid(pipe: str, words: str) -> None:
    handler = PipeRosServices(cast(PipeService, None)).handlers()["/relay/add_pipe"]
    failures: list[Any] = []
    client: Any = SimpleNamespace()
    Deferred.fromCoroutine(handler(client, {"pipe": pipe})).addErrback(failures.append)
    assert failures[0].check(Invalid)
    assert words in str(failures[0].value)
