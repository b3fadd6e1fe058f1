"""A receiver of webhooks, and one of e-mail, in their own threads."""

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
    """One received request.

    :param at: monotonic seconds
    """

    at: float
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        """The decoded body."""
        return json.loads(self.body)

    @property
    def reported(self) -> list[str]:
        """Kinds and events of its alerts."""
        return [f"{each['kind']} {each['event']}" for each in self.json["alerts"]]

    def signed_with(self, secret: str) -> bool:
        """Whether the signature is the one of the contract."""
        signed = self.headers["switchboard-timestamp"].encode() + b"." + self.body
        expected = "v1=" + hmac.new(secret.encode(), signed, hashlib.sha256).hexdigest()
        return hmac.compare_digest(self.headers["switchboard-signature"], expected)


class WebhookServer:
    """Stores posted messages."""

    def __init__(self) -> None:
        self.got: list[Delivery] = []
        self.status = 204
        webhook_receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                headers = {name.lower(): value for name, value in self.headers.items()}
                webhook_receiver.got.append(Delivery(time.monotonic(), headers, body))
                self.send_response(webhook_receiver.status)
                self.end_headers()

            def log_message(self, *words: Any) -> None:
                """Logs nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Its URL."""
        return f"http://127.0.0.1:{self.port}/hook"

    @property
    def reported(self) -> list[str]:
        """All reported events, in order of arrival."""
        return [each for delivery in self.got for each in delivery.reported]

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5)


class MailServer:
    """Accepts mail as in RFC 5321, one connection at a time, and stores it."""

    def __init__(self) -> None:
        self.mails: list[str] = []
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def stop(self) -> None:
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
