"""Web pages that are not the relay's, on two origins."""

from __future__ import annotations

import re
import subprocess
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

ROOT = Path(__file__).resolve().parents[2]


class _Handler(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Nothing."""


class OtherPages:
    """A web server with an empty page.

    :ivar listed: its origin by one name
    :ivar unlisted: its origin by another name
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._folder = folder
        (folder / "index.html").write_text("<!DOCTYPE html><title>Another site</title><body></body>")
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, directory=str(folder)))
        self.listed = f"http://localhost:{self._server.server_port}"
        self.unlisted = f"http://pages.localhost:{self._server.server_port}"
        Thread(target=self._server.serve_forever, daemon=True).start()

    def add_program(self, name: str, text: str) -> None:
        """Serve a program as a module, with the packages that it imports."""
        program = self._folder / f"source of {name}"
        program.write_text(text)
        node = [str(ROOT / "scripts" / "with-node.sh"), "node"]
        script = str(ROOT / "tests" / "e2e" / "clients" / "bundle.mjs")
        modules = str(ROOT / "web_client" / "node_modules")
        subprocess.run(
            [*node, script, modules, str(program), str(self._folder / name)], check=True, timeout=100
        )

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()


def readme_example(address: str, robot: str, token: str) -> str:
    """The example with roslib.js, for a relay at an address.

    :param token: an access token
    """
    (example,) = re.findall(r"```js\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert "127.0.0.1:9090" in example and "robot-one" in example
    example = example.replace("127.0.0.1:9090", address).replace("robot-one", robot)
    return f'const TOKEN = "{token}"\n{example}'
