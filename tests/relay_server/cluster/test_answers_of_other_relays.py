"""The body of a forwarded answer, whose client takes nothing."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.web.http_headers import Headers

from relay_server.cluster.forwarding import STALL_SECONDS, _AnswerPipe


class Home:
    """The answer of the home, and its connection."""

    def __init__(self, kind: bytes) -> None:
        self.headers = Headers({b"content-type": [kind]})
        self.reading = True
        self.stopped = False
        self.protocol: Any = None

    def deliverBody(self, protocol: Any) -> None:
        self.protocol = protocol
        protocol.makeConnection(self)

    def pauseProducing(self) -> None:
        self.reading = False

    def resumeProducing(self) -> None:
        self.reading = True

    def stopProducing(self) -> None:
        self.stopped = True


class Transport:
    """The connection to a client."""

    transport = None

    def __init__(self, client: Client) -> None:
        self._client = client

    def abortConnection(self) -> None:
        self._client.cut = True


class Client:
    """The request of a client."""

    def __init__(self) -> None:
        self.producer: Any = None
        self.written = b""
        self.cut = False
        self.transport = Transport(self)

    def registerProducer(self, producer: Any, streaming: bool) -> None:
        self.producer = producer

    def unregisterProducer(self) -> None:
        self.producer = None

    def write(self, data: bytes) -> None:
        self.written += data


@pytest.mark.parametrize("kind", [b"multipart/x-mixed-replace; boundary=frame", b"application/octet-stream"])
def test_a_client_that_takes_nothing_is_cut(kind: bytes) -> None:
    """The home's connection is not read meanwhile, so its end is not seen."""
    clock, home, client = Clock(), Home(kind), Client()
    pipe: Any = _AnswerPipe(client, clock)  # type: ignore[arg-type]
    done = Deferred.fromCoroutine(pipe.run(home))
    done.addErrback(lambda _: None)
    home.protocol.dataReceived(b"some")
    assert client.written == b"some"
    for _ in range(3):
        client.producer.pauseProducing()
        assert not home.reading
        clock.advance(STALL_SECONDS - 1)
        client.producer.resumeProducing()
        assert home.reading
    clock.advance(2 * STALL_SECONDS)
    assert not client.cut
    client.producer.pauseProducing()
    clock.advance(STALL_SECONDS)
    assert client.cut
    done.cancel()
    assert home.stopped
    assert not clock.getDelayedCalls()
