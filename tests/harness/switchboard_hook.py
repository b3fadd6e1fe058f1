"""A receiver of webhooks, and one of e-mail, in threads of their own."""

from __future__ import annotations

import hashlib
import hmac
import json
import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple


class Delivery(NamedTuple):
    """One request that came.

    :param at: monotonic seconds
    """

    at: float
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        """The body, decoded."""
        return json.loads(self.body)

    @property
    def told(self) -> list[str]:
        """Kinds and events of its alerts."""
        return [f"{each['kind']} {each['event']}" for each in self.json["alerts"]]

    def signed_with(self, secret: str) -> bool:
        """Whether the signature is the one the contract says."""
        signed = self.headers["switchboard-timestamp"].encode() + b"." + self.body
        expected = "v1=" + hmac.new(secret.encode(), signed, hashlib.sha256).hexdigest()
        return hmac.compare_digest(self.headers["switchboard-signature"], expected)


class Hook:
    """Keeps what is posted to it."""

    def __init__(self) -> None:
        self.got: list[Delivery] = []
        self.status = 204
        hook = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                headers = {name.lower(): value for name, value in self.headers.items()}
                hook.got.append(Delivery(time.monotonic(), headers, body))
                self.send_response(hook.status)
                self.end_headers()

            def log_message(self, *words: Any) -> None:
                """Nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where it listens."""
        return f"http://127.0.0.1:{self.port}/hook"

    @property
    def told(self) -> list[str]:
        """All that was told, in the order it came."""
        return [each for delivery in self.got for each in delivery.told]

    def stop(self) -> None:
        """Listen no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5)


class MailServer:
    """Takes mail as RFC 5321 has it, one connection at a time, and keeps it."""

    def __init__(self) -> None:
        self.mails: list[str] = []
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Listen no more."""
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join(5)

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listening.accept()
            except OSError:
                return
            with connection, connection.makefile("rwb") as lines:
                self._talk(lines)

    def _talk(self, lines: Any) -> None:
        def say(text: str) -> None:
            lines.write(text.encode() + b"\r\n")
            lines.flush()

        say("220 sink")
        for line in lines:
            word = line.strip().upper()
            if word.startswith(b"EHLO"):
                say("250 sink")
            elif word == b"DATA":
                say("354 go on")
                self.mails.append(self._mail(lines))
                say("250 taken")
            elif word == b"QUIT":
                say("221 bye")
                return
            else:
                say("250 yes")

    @staticmethod
    def _mail(lines: Any) -> str:
        kept = []
        for line in lines:
            if line == b".\r\n":
                break
            kept.append(line.decode())
        return "".join(kept)
