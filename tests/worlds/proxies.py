"""The servers of docs/operate/behind_a_proxy.md, with the configurations that are shown there."""

from __future__ import annotations

import os
import re
import shutil
import socket
import ssl
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.worlds.certificates import Authority
from tests.worlds.doc_scene import ROOT
from tests.worlds.processes import Process, running
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import wait_for

HOST = "robots.example.org"
PAGE = ROOT / "docs" / "operate" / "behind_a_proxy.md"
_PACKAGES = Path(sys.prefix) / "proxies"
_FOLDERS = (os.environ["PATH"], "/usr/sbin", str(_PACKAGES / "usr/sbin"), str(_PACKAGES / "usr/bin"))

_NGINX = """daemon off;
{user}
pid {folder}/nginx.pid;
error_log stderr;
load_module {modules}/ngx_stream_module.so;
events {{}}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
{clients}
}}
"""
_APACHE = """ServerRoot {folder}
ServerName 127.0.0.1
PidFile {folder}/apache.pid
ErrorLog /dev/stderr
Define APACHE_LOG_DIR {folder}
{user}
Listen 127.0.0.1:{port}
{modules}
{clients}
"""
_APACHE_MODULES = "mpm_event authz_core socache_shmcb ssl proxy proxy_http proxy_wstunnel"
_CADDY = """{{
    admin off
    grace_period 1s
    default_bind 127.0.0.1
    auto_https disable_redirects
    https_port {port}
}}
{clients}
"""


class Proxy(NamedTuple):
    """A server in front of a relay.

    :param port: for HTTPS
    :param robots_port: for robots with TLS; the relay's if the server does not take them
    :param context: of clients that trust its certificate
    :param log: the file with its requests, if the configuration has one
    """

    port: int
    robots_port: int
    context: ssl.SSLContext
    log: Path


def shown(file: str) -> str:
    """The configuration that the page shows for a file, without the line with its name."""
    found = re.search(
        rf"^```\w+\n# /etc/{re.escape(file)}\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE
    )
    assert found is not None, f"{PAGE.name} shows no /etc/{file}"
    return found[1]


@contextmanager
def proxy(server: str, relay: Relay, authority: Authority, folder: Path) -> Iterator[Proxy]:
    """A server in front of a relay.

    :param server: ``nginx``, ``haproxy``, ``caddy`` or ``apache2``
    """
    folder.mkdir()
    chain, key = folder / "chain.pem", folder / "key.pem"
    authority.certify(chain, key, name=HOST)
    (folder / "robots.pem").write_bytes(chain.read_bytes() + key.read_bytes())
    port, robots_port = _free_ports()
    places = {
        "/etc/ssl/robots/": f"{folder}/",
        "/etc/haproxy/": f"{folder}/",
        "/var/log/nginx/": f"{folder}/",
        "127.0.0.1:9090": f"127.0.0.1:{relay.http_port}",
        "127.0.0.1:9092": f"127.0.0.1:{relay.robots_port}",
        "listen 443": f"listen 127.0.0.1:{port}",
        "listen 9091": f"listen 127.0.0.1:{robots_port}",
        "bind :443": f"bind 127.0.0.1:{port}",
        "bind :9091": f"bind 127.0.0.1:{robots_port}",
        "VirtualHost *:443": f"VirtualHost 127.0.0.1:{port}",
    }
    command = {"nginx": _nginx, "haproxy": _haproxy, "caddy": _caddy, "apache2": _apache}[server]
    process = Process(command(folder, port, places), folder, server, _environment(folder))
    context = ssl.create_default_context(cafile=str(authority.path))
    takes_robots = server in ("nginx", "haproxy")
    with running(process):
        wait_for(f"{server} answers", lambda: _answers(process, port))
        yield Proxy(
            port, robots_port if takes_robots else relay.robots_port, context, folder / "switchboard.log"
        )


@contextmanager
def path_stripping_proxy(relay: Relay, folder: Path) -> Iterator[str]:
    """The URL of a relay below a path, by an nginx that removes the path, which no page recommends."""
    folder.mkdir()
    port, _ = _free_ports()
    clients = f"""
    server {{
        listen 127.0.0.1:{port};
        location /robots/ {{
            proxy_pass http://127.0.0.1:{relay.http_port}/;
        }}
    }}
    """
    process = Process(_nginx_command(folder, clients), folder, "nginx", _environment(folder))
    with running(process):
        wait_for("nginx answers", lambda: _answers(process, port))
        yield f"http://127.0.0.1:{port}/robots/"


def _nginx(folder: Path, _port: int, places: Mapping[str, str]) -> list[str]:
    clients = _placed("nginx/conf.d/switchboard.conf", places)
    return _nginx_command(folder, clients, _placed("nginx/modules-enabled/90-switchboard.conf", places))


def _nginx_command(folder: Path, clients: str, robots: str = "") -> list[str]:
    program = _program("nginx")
    user = "user root;" if os.getuid() == 0 else ""
    modules = _beside(program, "nginx/modules")
    text = _NGINX.format(user=user, folder=folder, modules=modules, clients=clients) + robots
    return [str(program), "-p", str(folder), "-c", _written(folder / "nginx.conf", text)]


def _haproxy(folder: Path, _port: int, places: Mapping[str, str]) -> list[str]:
    text = _placed("haproxy/haproxy.cfg", places)
    return [str(_program("haproxy")), "-db", "-f", _written(folder / "haproxy.cfg", text)]


def _caddy(folder: Path, port: int, places: Mapping[str, str]) -> list[str]:
    text = _CADDY.format(port=port, clients=_placed("caddy/Caddyfile", places))
    return [
        str(_program("caddy")),
        "run",
        "--adapter",
        "caddyfile",
        "--config",
        _written(folder / "Caddyfile", text),
    ]


def _apache(folder: Path, port: int, places: Mapping[str, str]) -> list[str]:
    program = _program("apache2")
    modules = _beside(program, "apache2/modules")
    text = _APACHE.format(
        folder=folder,
        port=port,
        user="User nobody\nGroup nogroup" if os.getuid() == 0 else "",
        modules="\n".join(
            f"LoadModule {each}_module {modules}/mod_{each}.so" for each in _APACHE_MODULES.split()
        ),
        clients=_placed("apache2/sites-available/switchboard.conf", places),
    )
    return [str(program), "-D", "FOREGROUND", "-f", _written(folder / "apache.conf", text)]


def _placed(file: str, places: Mapping[str, str]) -> str:
    text = shown(file)
    for place, value in places.items():
        text = text.replace(place, value)
    return text


def _written(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def _program(name: str) -> Path:
    found = shutil.which(name, path=os.pathsep.join(_FOLDERS))
    assert found is not None, f"{name} is not there; run scripts/setup.sh proxies"
    return Path(found).resolve()


def _beside(program: Path, modules: str) -> Path:
    """The folder of a program's modules, in the system or among the unpacked packages."""
    folders = (program.parents[1] / "lib" / modules, _PACKAGES / "usr/lib" / modules)
    return next((each for each in folders if each.is_dir()), folders[0])


def _environment(folder: Path) -> dict[str, str]:
    libraries = [str(each) for each in (_PACKAGES / "usr/lib").glob("*-linux-gnu")]
    former = os.environ.get("LD_LIBRARY_PATH")
    return {
        **os.environ,
        "HOME": str(folder),
        "LD_LIBRARY_PATH": os.pathsep.join([*libraries, *([former] if former else [])]),
    }


def _free_ports() -> tuple[int, int]:
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]


def _answers(process: Process, port: int) -> bool:
    assert process.popen.poll() is None, process.log.read_text() + process.said()
    try:
        socket.create_connection(("127.0.0.1", port)).close()
    except OSError:
        return False
    return True
