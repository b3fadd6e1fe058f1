"""The files of ``deploy/cluster``: their options and paths are valid, and the time limit allows a drain."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click
import pytest
import yaml

from relay_server.cli.serve import serve
from relay_server.cluster.drain import ASK_SECONDS, MOVE_SECONDS
from relay_server.http.relay_status import StatusEndpoints
from relay_server.run import STOP_SECONDS

FOLDER = Path(__file__).parents[3] / "deploy" / "cluster"
LEAVING = ASK_SECONDS + MOVE_SECONDS + STOP_SECONDS
VARIABLES = {each.envvar for each in serve.params if isinstance(each, click.Option)} | {"SWITCHBOARD_DB"}


def compose() -> dict[str, Any]:
    found = yaml.safe_load((FOLDER / "compose.yaml").read_text())
    return {name: each for name, each in found["services"].items() if name.startswith("relay")}


def kubernetes(kind: str) -> list[dict[str, Any]]:
    found = yaml.safe_load_all((FOLDER / "kubernetes.yaml").read_text())
    return [each for each in found if each["kind"] == kind]


@pytest.fixture
def pod() -> Any:
    (relays,) = kubernetes("StatefulSet")
    return relays["spec"]["template"]["spec"]


def check(arguments: list[str], environment: dict[str, str]) -> None:
    """The options are valid for ``switchboard serve`` and form the settings of a cluster."""
    assert arguments[0] == "serve"
    context = serve.make_context("serve", arguments[1:])
    assert context.params["name"] == "fleet.example.org"
    used = {name for name in environment if name.startswith("SWITCHBOARD_")}
    assert used <= VARIABLES
    assert {"SWITCHBOARD_DB", "SWITCHBOARD_CLUSTER_BUS", "SWITCHBOARD_CLUSTER_SECRET"} <= used
    assert environment["SWITCHBOARD_CLUSTER_LISTEN"].startswith("0.0.0.0:")
    assert context.params["tls_cert"] and context.params["tls_key"]


def test_relays_of_the_compose_file_are_one_cluster() -> None:
    relays = compose()
    assert len(relays) == 3
    for name, relay in relays.items():
        check(relay["command"], relay["environment"])
        assert relay["environment"]["SWITCHBOARD_CLUSTER_HOST"] == name
        assert int(relay["stop_grace_period"].removesuffix("s")) > LEAVING
        assert f"{name}:/data" in relay["volumes"]


def test_pods_are_one_cluster(pod: Any) -> None:
    (relay,) = pod["containers"]
    check(relay["args"], {each["name"]: each.get("value", "") for each in relay["env"]})
    assert pod["terminationGracePeriodSeconds"] > LEAVING
    assert relay["readinessProbe"]["httpGet"]["path"] == "/readyz"
    assert relay["livenessProbe"]["httpGet"]["path"] == "/livez"
    assert StatusEndpoints.ready and StatusEndpoints.live
    mounted = {each["name"] for each in relay["volumeMounts"]}
    (relays,) = kubernetes("StatefulSet")
    claims = {each["metadata"]["name"] for each in relays["spec"]["volumeClaimTemplates"]}
    assert mounted == claims | {each["name"] for each in pod["volumes"]}


def test_services_reach_the_ports_of_the_pods(pod: Any) -> None:
    ports = {each["name"]: each["containerPort"] for each in pod["containers"][0]["ports"]}
    (relays,) = kubernetes("StatefulSet")
    labels = relays["spec"]["template"]["metadata"]["labels"]
    services = kubernetes("Service")
    assert relays["spec"]["serviceName"] in {each["metadata"]["name"] for each in services}
    for service in services:
        assert service["spec"]["selector"].items() <= labels.items()
        for port in service["spec"]["ports"]:
            assert port.get("targetPort", port["port"]) in {*ports, *ports.values()}
    (robots,) = (each for each in services if each["metadata"]["name"] == "switchboard-robots")
    assert robots["spec"]["sessionAffinity"] == "ClientIP"


def test_the_balancer_checks_each_relay_of_the_compose_file() -> None:
    """Connections of a robot stay together."""
    text = (FOLDER / "haproxy.cfg").read_text()
    servers = re.findall(r"^    server (\S+) (\S+):(\d+)", text, re.MULTILINE)
    assert [host for _, host, _ in servers] == [*compose(), *compose()]
    assert {port for _, _, port in servers} == {"9090", "9091"}
    assert "option httpchk GET /readyz" in text
    assert "balance source" in text.partition("listen robots")[2]
