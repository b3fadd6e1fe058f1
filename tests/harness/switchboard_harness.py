"""Real processes for end-to-end tests: relays, robots (simulator and daemon), a proxy that breaks networks, clients.

Everything listens on loopback, ports come from the OS, every process is reaped by ``stop``.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import random
import selectors
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from switchboard_domains import free_domain
from websockets.sync.client import ClientConnection, connect

from relay_protocol import PROTOCOL_VERSION, identity, limits, link
from relay_protocol.frames import FrameDecoder, JsonFrame

BIN = Path(sys.executable).parent
START_SECONDS = 60.0


def wait_for(what: str, condition: Callable[[], Any], seconds: float = 20.0) -> Any:
    """Poll until ``condition`` gives something true, and return it; fail by name when it does not."""
    until = time.monotonic() + seconds
    while True:
        found = condition()
        if found:
            return found
        if time.monotonic() > until:
            raise AssertionError(f"not within {seconds:g} s: {what}")
        time.sleep(0.02)


def ros_environment(domain: int) -> dict[str, str]:
    """Variables that keep a ROS process to itself."""
    return {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def mortal(command: list[str]) -> list[str]:
    """The same command, ended by SIGTERM as soon as the thread that starts it is gone, however that went.

    So a test run that is killed leaves no robots and relays behind.
    """
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "TERM", "--", *command] if setpriv else command


class Process:
    """One child process with its output in files."""

    def __init__(
        self, command: list[str], folder: Path, name: str, env: dict[str, str] | None = None
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.name = name
        self.out = folder / f"{name}.out"
        self.log = folder / f"{name}.log"
        with self.out.open("ab") as out, self.log.open("ab") as log:
            self._start = out.tell()
            self.popen = subprocess.Popen(
                mortal(command),
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=log,
                env=env,
                start_new_session=True,
            )

    def said(self) -> str:
        """What it has printed since this start."""
        return self.out.read_bytes()[self._start :].decode(errors="replace")

    def wait_to_say(self, start: str) -> str:
        """Wait for a line that begins so, and return it."""

        def line() -> str | None:
            if self.popen.poll() is not None:
                raise AssertionError(
                    f"{self.name} ended with {self.popen.returncode}: {self.log.read_text()[-2000:]}"
                )
            return next((each for each in self.said().splitlines() if each.startswith(start)), None)

        return str(wait_for(f"{self.name} prints {start}", line, START_SECONDS))

    def signal(self, number: int) -> None:
        """Send a signal."""
        self.popen.send_signal(number)

    def kill(self) -> None:
        """kill -9, and reap."""
        self.popen.kill()
        self.popen.wait(10)

    def stop(self, seconds: float = 10.0) -> int:
        """SIGTERM (also to a frozen one), reap, and return the exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGTERM)
            self.popen.send_signal(signal.SIGCONT)
            try:
                self.popen.wait(seconds)
            except subprocess.TimeoutExpired:
                self.popen.kill()
                self.popen.wait(10)
        return int(self.popen.returncode)


class Relay:
    """``switchboard serve`` on a data folder, and the admin command line beside it."""

    def __init__(self, folder: Path, *options: str, database: str | None = None) -> None:
        self.folder = folder
        self.data = folder / "relay-data"
        self._options = options
        self._database = database
        self.http_port = 0
        self.robots_port = 0
        self.process: Process | None = None
        self.start()

    @property
    def _environment(self) -> dict[str, str]:
        extra = {"SWITCHBOARD_DB": self._database} if self._database else {}
        return {**os.environ, **extra}

    def start(self) -> None:
        """Start, on the ports it had before if it ran before."""
        command = [str(BIN / "switchboard"), "serve", "--data", str(self.data), *self._options]
        command += ["--http", f"127.0.0.1:{self.http_port}", "--robots", f"127.0.0.1:{self.robots_port}"]
        self.process = Process(command, self.folder, "relay", self._environment)
        ready = self.process.wait_to_say("READY")
        words = dict(word.split("=") for word in ready.split()[1:])
        self.http_port, self.robots_port = int(words["http"]), int(words["robots"])

    def cli(self, *arguments: str, stdin: str = "") -> Any:
        """Run an admin command with --json; returns what it prints, decoded."""
        done = self.run_cli(*arguments, "--json", stdin=stdin)
        assert done.returncode == 0, f"{arguments}: {done.stderr}"
        return json.loads(done.stdout) if done.stdout.strip() else None

    def run_cli(self, *arguments: str, stdin: str = "") -> subprocess.CompletedProcess[str]:
        """Run an admin command as it is."""
        return subprocess.run(
            [str(BIN / "switchboard"), "--data", str(self.data), *arguments],
            input=stdin,
            capture_output=True,
            text=True,
            timeout=60,
            env=self._environment,
            check=False,
        )

    def user(self, name: str, password: str = "correct horse", *, admin: bool = False) -> str:
        """Add a user and return an access token."""
        self.cli(
            "user", "add", name, "--password-stdin", *(["--admin"] if admin else []), stdin=password + "\n"
        )
        return self.token(name)

    def token(self, user: str, ttl: str = "1h") -> str:
        """An access token of a user."""
        return str(self.cli("token", "create", user, "--ttl", ttl)["token"])

    def state_of(self, robot: str) -> str:
        """``online``, ``in_use`` or ``offline``."""
        for each in self.cli("status")["robots"]:
            if each["name"] == robot:
                return str(each["state"])
        return "offline"

    def url(self, robot: str) -> str:
        """The websocket of a robot."""
        return f"ws://127.0.0.1:{self.http_port}/robots/{robot}"

    def connect(self, robot: str, token: str, **options: Any) -> Client:
        """A websocket client with a Bearer token."""
        headers = {"Authorization": f"Bearer {token}"}
        # Who has stopped reading doesn't see the answer to its close behind what it has not read.
        options.setdefault("close_timeout", 1)
        return Client(connect(self.url(robot), additional_headers=headers, **options))

    def connect_by(self, port: int, robot: str, token: str) -> Client:
        """The same by way of a proxy."""
        headers = {"Authorization": f"Bearer {token}"}
        return Client(connect(f"ws://127.0.0.1:{port}/robots/{robot}", additional_headers=headers))

    def freeze(self) -> None:
        """SIGSTOP."""
        assert self.process is not None
        self.process.signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """SIGCONT."""
        assert self.process is not None
        self.process.signal(signal.SIGCONT)

    def kill(self) -> None:
        """kill -9."""
        assert self.process is not None
        self.process.kill()

    def stop(self) -> int:
        """SIGTERM; the exit code."""
        assert self.process is not None
        return self.process.stop()

    @property
    def log(self) -> str:
        """All it has logged."""
        assert self.process is not None
        return self.process.log.read_text()


class Robot:
    """A simulated robot in a ROS domain of its own, with its daemon, enrolled at a relay.

    :param port: where the daemon dials; a proxy's port, or the relay's
    """

    def __init__(
        self,
        relay: Relay,
        name: str,
        *,
        port: int | None = None,
        camera: bool = False,
        daemon_env: dict[str, str] | None = None,
        enroll_options: tuple[str, ...] = (),
    ) -> None:
        self.relay = relay
        self.name = name
        self.domain = free_domain()
        self.folder = relay.folder / name
        self.record_file = self.folder / "record.jsonl"
        self.state = self.folder / "state"
        self._daemon_env = daemon_env or {}
        self.folder.mkdir(parents=True)
        command = [str(BIN / "switchboard-sim"), "--record", str(self.record_file), "--seed", "1"]
        command += ["--camera" if camera else "--no-camera"]
        self.sim = Process(command, self.folder, "sim", ros_environment(self.domain))
        code = relay.cli("robot", "add", name)["enrolment_code"]
        self.enroll(code, port or relay.robots_port, *enroll_options).check_returncode()
        self.sim.wait_to_say("READY")
        self.daemon = self._daemon()
        self.wait_online()

    def enroll(self, code: str, port: int, *options: str) -> subprocess.CompletedProcess[str]:
        """``switchboard-robot enroll``; options such as ``--tls``, ``--ca`` FILE."""
        command = [
            str(BIN / "switchboard-robot"),
            "enroll",
            "--relay",
            f"127.0.0.1:{port}",
            "--robot",
            self.name,
        ]
        command += ["--code", "-", "--state", str(self.state), *options]
        return subprocess.run(command, input=code, capture_output=True, text=True, timeout=60, check=False)

    def _daemon(self) -> Process:
        command = [str(BIN / "switchboard-robot"), "run", "--state", str(self.state)]
        return Process(command, self.folder, "daemon", {**ros_environment(self.domain), **self._daemon_env})

    def start_daemon(self) -> None:
        """Start the daemon again after it was killed."""
        self.daemon = self._daemon()

    def wait_online(self, seconds: float = 30.0) -> None:
        """Until the relay sees it."""
        wait_for(f"{self.name} is online", lambda: self.relay.state_of(self.name) != "offline", seconds)

    def record(self) -> list[dict[str, Any]]:
        """What the simulated body was told and did: dicts with ``t`` (monotonic ns) and ``event``."""
        if not self.record_file.exists():
            return []
        lines = self.record_file.read_text().splitlines()
        return [json.loads(line) for line in lines if line.endswith("}")]

    def events(self, kind: str, since: int = 0) -> list[dict[str, Any]]:
        """Events of one kind after a moment."""
        return [each for each in self.record() if each["event"] == kind and each["t"] >= since]

    def moving(self) -> bool:
        """Whether it moves, by its own record."""
        changes = [each["event"] for each in self.record() if each["event"] in ("moving", "standstill")]
        return bool(changes) and changes[-1] == "moving"

    def stop(self) -> None:
        """End daemon and simulator."""
        self.daemon.stop()
        self.sim.stop()


class Answer:
    """What came back for an HTTP request."""

    def __init__(self, response: http.client.HTTPResponse) -> None:
        self.status = response.status
        self.headers = response.headers
        self.body = response.read()

    @property
    def json(self) -> Any:
        """The body, decoded."""
        return json.loads(self.body)

    @property
    def cookie(self) -> str:
        """The cookie it sets, as the next request sends it."""
        return str(self.headers["Set-Cookie"]).partition(";")[0]


def ask(
    port: int,
    method: str,
    path: str,
    body: Any = None,
    *,
    headers: dict[str, str] | None = None,
    token: str = "",
    tls: ssl.SSLContext | None = None,
) -> Answer:
    """One HTTP request on a connection of its own.

    :param body: sent as JSON
    :param token: an access token, sent as Bearer
    """
    sent = dict(headers or {})
    if body is not None:
        sent.setdefault("Content-Type", "application/json")
    if token:
        sent["Authorization"] = f"Bearer {token}"
    if tls is None:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    else:
        connection = http.client.HTTPSConnection("127.0.0.1", port, timeout=30, context=tls)
    try:
        connection.request(method, path, None if body is None else json.dumps(body), sent)
        return Answer(connection.getresponse())
    finally:
        connection.close()


class Client:
    """A plain rosbridge client over one websocket."""

    def __init__(self, connecting: Any) -> None:
        self._stack = contextlib.ExitStack()
        self.connection: ClientConnection = self._stack.enter_context(connecting)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave."""
        self._stack.close()

    def send(self, **message: Any) -> None:
        """One operation."""
        self.connection.send(json.dumps(message))

    def receive(self, seconds: float = 10.0) -> dict[str, Any]:
        """The next message."""
        return dict(json.loads(self.connection.recv(timeout=seconds)))

    def until(self, seconds: float = 15.0, **like: Any) -> dict[str, Any]:
        """The next message with these fields; what came before it is passed over."""
        end = time.monotonic() + seconds
        while True:
            message = self.receive(max(0.01, end - time.monotonic()))
            if all(message.get(key) == value for key, value in like.items()):
                return message

    def call(self, service: str, args: Any = None, seconds: float = 15.0) -> dict[str, Any]:
        """Call a service and wait for the answer."""
        call_id = f"call-{random.random()}"
        self.send(op="call_service", id=call_id, service=service, args={} if args is None else args)
        return self.until(seconds, op="service_response", id=call_id)

    def drive(self, v: float, w: float = 0.0, topic: str = "/cmd_vel") -> None:
        """One motion command."""
        self.send(op="publish", topic=topic, msg={"linear": {"x": v}, "angular": {"z": w}})


class FakeRobot:
    """One end of a robot link, spoken by hand: for what no honest robot says."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=10)
        self._decoder = FrameDecoder(limits.COMMAND_FRAME)
        self._heard: list[dict[str, Any]] = []

    def __enter__(self) -> FakeRobot:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, message: link.Message) -> None:
        """One message."""
        self.send_bytes(link.frame(message))

    def send_bytes(self, data: bytes) -> None:
        """Bytes as they are; a peer that has hung up meanwhile is no error."""
        with contextlib.suppress(ConnectionError):
            self.socket.sendall(data)

    def receive(self, seconds: float = 10.0) -> dict[str, Any] | None:
        """The next message, ``None`` at the end of the connection."""
        self.socket.settimeout(seconds)
        while not self._heard:
            try:
                data = self.socket.recv(65536)
            except ConnectionResetError:
                return None
            if not data:
                return None
            frames = self._decoder.feed(data)
            self._heard += [json.loads(each.body) for each in frames if isinstance(each, JsonFrame)]
        return self._heard.pop(0)

    def until(self, op: str, seconds: float = 10.0) -> dict[str, Any]:
        """The next message with this ``op``."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = self.receive(max(0.01, end - time.monotonic()))
            assert message is not None, f"the connection ended before '{op}' came"
            if message["op"] == op:
                return message
        raise AssertionError(f"no '{op}' within {seconds:g} s")

    def ended(self, seconds: float = 10.0) -> bool:
        """Whether the relay hangs up within this time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                if self.receive(max(0.01, end - time.monotonic())) is None:
                    return True
            except TimeoutError:
                return False
        return False

    def hello(self, robot: str, fingerprint: str) -> dict[str, Any]:
        """Say who it claims to be; returns the challenge."""
        self.send(link.Hello(version=PROTOCOL_VERSION, robot=robot, key=fingerprint, encodings=["json"]))
        return self.until("challenge")

    def register(self, robot: str, key: bytes) -> dict[str, Any]:
        """Prove to be a robot; returns ``welcome`` or ``refused``, and the proof as it was sent."""
        challenge = self.hello(robot, identity.fingerprint(identity.public_half(key)))
        nonce = link.from_base64(challenge["nonce"], "the nonce")
        signature = identity.sign(key, challenge["relay"], robot, nonce)
        self.proof = link.Prove(signature=link.to_base64(signature))
        self.send(self.proof)
        return self.receive() or {}

    def enroll(self, robot: str, code: str, key: bytes) -> dict[str, Any]:
        """Hand in a key with a code; returns ``enrolled`` or ``refused``."""
        public = link.to_base64(identity.public_half(key))
        self.send(link.Enroll(version=PROTOCOL_VERSION, robot=robot, code=code, public_key=public))
        return self.receive() or {}


class Driver(threading.Thread):
    """Keeps driving at 10 Hz until told to stop, or until the connection breaks."""

    def __init__(self, client: Client, v: float = 0.2, w: float = 0.6) -> None:
        super().__init__(daemon=True)
        self._client = client
        self._v, self._w = v, w
        self._end = threading.Event()
        self.broken: str | None = None

    def run(self) -> None:
        """Send, and read what comes so that nothing piles up."""
        self._client.send(op="advertise", topic="/cmd_vel", type="geometry_msgs/msg/Twist")
        while not self._end.is_set():
            try:
                self._client.drive(self._v, self._w)
                with contextlib.suppress(TimeoutError):
                    self._client.receive(0.1)
            except Exception as error:
                self.broken = repr(error)
                return

    def stop(self) -> None:
        """Let go, without a zero."""
        self._end.set()
        self.join(10)


class ChaosProxy:
    """A TCP proxy on loopback that can swallow bytes in either direction, or reset everything.

    :param target: port it leads to
    """

    def __init__(self, target: int) -> None:
        self._target = target
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self.forward_up = threading.Event()
        self.forward_down = threading.Event()
        self.forward_up.set()
        self.forward_down.set()
        self._closing = False
        threading.Thread(target=self._accept, daemon=True).start()

    def black_hole(self) -> None:
        """Nothing passes any more; nobody is told. What arrives is kept, as a network's queues keep it."""
        self.forward_up.clear()
        self.forward_down.clear()

    def heal(self) -> None:
        """Everything passes again, late as it is."""
        self.forward_up.set()
        self.forward_down.set()

    def reset(self) -> None:
        """Cut all connections at once."""
        with self._lock:
            for each in list(self._open):
                with contextlib.suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End."""
        self._closing = True
        self._server.close()
        self.heal()
        self.reset()

    def _accept(self) -> None:
        while not self._closing:
            try:
                near, _ = self._server.accept()
                far = socket.create_connection(("127.0.0.1", self._target), timeout=5)
            except OSError:
                if self._closing:
                    return
                with contextlib.suppress(OSError, UnboundLocalError):
                    near.close()
                continue
            far.settimeout(None)
            for each in (near, far):
                each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                self._open |= {near, far}
            threading.Thread(target=self._pump, args=(near, far, self.forward_up), daemon=True).start()
            threading.Thread(target=self._pump, args=(far, near, self.forward_down), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, gate: threading.Event) -> None:
        try:
            while data := source.recv(65536):
                gate.wait()
                sink.sendall(data)
        except OSError:
            pass
        finally:
            gate.wait()
            with self._lock:
                self._open -= {source}
            for each in (source, sink):
                with contextlib.suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)
            source.close()


@contextlib.contextmanager
def running(*things: Any) -> Iterator[None]:
    """Stop these at the end, last one first."""
    try:
        yield
    finally:
        for each in reversed(things):
            each.stop()


def readable(connection: socket.socket, seconds: float) -> bool:
    """Whether bytes (or the end) can be read within this time."""
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ)
        return bool(selector.select(seconds))
