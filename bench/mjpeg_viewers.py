"""Viewers of MJPEG streams that look at nothing but the delimiters. Started by the measurements, as a process.

Arguments: port, count, file with the HTTP request, bytes a second each reads (0: all, -1: none). Prints READY when all
have asked; a line on the standard input is answered by what has come since the line before, as JSON. Ends with it.
"""

from __future__ import annotations

import json
import selectors
import socket
import sys
from pathlib import Path

DELIMITER = b"--boundarydonotcross\r\n"
PARTS_A_SECOND = 10
"""How often one that reads slowly reads."""


class Viewer:
    """One connection.

    :param rate: bytes a second; 0: all
    """

    def __init__(self, port: int, request: bytes, rate: float) -> None:
        self.socket = socket.socket()
        if rate:
            # What waits in the kernel counts as read for the relay.
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16384)
        self.socket.connect(("127.0.0.1", port))
        self.socket.sendall(request)
        self.socket.setblocking(False)
        self.pictures = 0
        self.sees = False
        """Whether there was any picture yet."""
        self.bytes = 0
        self._tail = b""

    def read(self, most: int) -> bool:
        """Count what is there; whether it is still open."""
        try:
            data = self.socket.recv(most)
        except BlockingIOError:
            return True
        except ConnectionResetError:
            return False
        self.bytes += len(data)
        self.pictures += (self._tail + data).count(DELIMITER)
        self.sees = self.sees or self.pictures > 1
        self._tail = data[1 - len(DELIMITER) :]
        return bool(data)


def main() -> None:
    """Read until the standard input ends."""
    port, count, request, rate = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4])
    viewers = [Viewer(port, request.read_bytes(), rate) for _ in range(count)]
    selector = selectors.DefaultSelector()
    selector.register(sys.stdin, selectors.EVENT_READ)
    if not rate:
        for each in viewers:
            selector.register(each.socket, selectors.EVENT_READ, each)
    print("READY", flush=True)
    while True:
        ready = selector.select(1 / PARTS_A_SECOND if rate > 0 else None)
        if rate > 0 and not ready:
            for each in viewers:
                each.read(int(rate / PARTS_A_SECOND))
        for key, _ in ready:
            if key.data is not None:
                if not key.data.read(1 << 18):
                    selector.unregister(key.data.socket)
                continue
            if not sys.stdin.readline():
                return
            pictures = [each.pictures for each in viewers]
            waiting = sum(not each.sees for each in viewers)
            told = {"waiting": waiting, "least": min(pictures), "pictures": sum(pictures)}
            print(json.dumps({**told, "bytes": sum(each.bytes for each in viewers)}), flush=True)
            for each in viewers:
                each.pictures = each.bytes = 0


if __name__ == "__main__":
    main()
