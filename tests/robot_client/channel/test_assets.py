"""Assets: which files of a robot are sent, and in which parts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import Deferred, execute

from relay_protocol import limits, link
from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from robot_client.channel import assets as module
from robot_client.channel.assets import ChannelAssets, asset_path, read_part
from tests.worlds.robot_channel import RecordingWriter


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """A prefix with the package ``arm``, and files beside it."""
    index = tmp_path / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "arm").touch()
    (index / "arm-camera").touch()
    (tmp_path / "share/arm-camera").mkdir()
    (tmp_path / "share/arm-camera/lens.stl").touch()
    share = tmp_path / "share/arm"
    (share / "meshes/sub.stl").mkdir(parents=True)
    for name in ("meshes/base.stl", "meshes/BASE.DAE", "meshes/a b.png", "package.xml", "noext"):
        (share / name).write_bytes(name.encode())
    (share / "meshes/link.stl").symlink_to("base.stl")
    (share / "meshes/renamed.stl").symlink_to("../package.xml")
    (share / "meshes/loop.stl").symlink_to("loop.stl")
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret.stl").write_bytes(b"secret")
    (share / "meshes/out.stl").symlink_to(outside / "secret.stl")
    (share / "away").symlink_to(outside)
    (tmp_path / "share/fonts").mkdir()
    (tmp_path / "share/fonts/x.png").touch()
    (tmp_path / "share/armour").mkdir()
    (tmp_path / "share/armour/x.stl").touch()
    return tmp_path


@pytest.mark.parametrize(
    ("uri", "name"),
    [
        ("package://arm/meshes/base.stl", "base.stl"),
        ("package://arm/meshes/BASE.DAE", "BASE.DAE"),
        ("package://arm/meshes/a%20b.png", "a b.png"),
        ("package://arm/meshes/link.stl", "base.stl"),
        ("package://arm-camera/lens.stl", "lens.stl"),
    ],
)
def test_files_of_packages_are_found_with_links_resolved(prefix: Path, uri: str, name: str) -> None:
    assert asset_path(uri, [prefix / "none", prefix]).name == name


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("file:///etc/passwd", "is no asset"),
        ("package://arm", "is no asset"),
        ("package://arm/", "is no asset"),
        ("package://../x.stl", "is no asset"),
        ("package://arm/" + "x" * limits.ASSET_URI + ".stl", "is no asset"),
        ("package://arm/../../outside/secret.stl", "downwards"),
        ("package://arm/meshes/%2e%2e/%2e%2e/%2e%2e/outside/secret.stl", "downwards"),
        ("package://arm/meshes%2f..%2f..%2farmour%2fx.stl", "downwards"),
        ("package://arm//etc/x.stl", "downwards"),
        ("package://arm/meshes/./base.stl", "downwards"),
        ("package://arm/meshes\\base.stl", "downwards"),
        ("package://arm/meshes/base.stl%00.png", "downwards"),
        ("package://arm/meshes/none.stl", "no such file"),
        ("package://arm/meshes/loop.stl", "no such file"),
        ("package://arm/meshes/base.stl/x.stl", "no such file"),
        ("package://arm/meshes/out.stl", "out of the package"),
        ("package://arm/away/secret.stl", "out of the package"),
        ("package://arm/package.xml", "of this kind"),
        ("package://arm/noext", "of this kind"),
        ("package://arm/meshes/renamed.stl", "of this kind"),
        ("package://fonts/x.png", "no package 'fonts'"),
        ("package://ament_index/x.png", "no package"),
    ],
)
def test_all_else_is_refused_with_a_reason(prefix: Path, uri: str, words: str) -> None:
    with pytest.raises(SwitchboardError, match=words):
        asset_path(uri, [prefix])


@pytest.fixture
def workspace(prefix: Path) -> Path:
    """The sources of the package ``arm`` that ``colcon build --symlink-install`` has installed in the prefix.

    Beside them are files that no link of the package may reach through this directory.
    """
    source, build = prefix / "ws/src/arm", prefix / "ws/build/arm"
    for folder in (source / "meshes", build, prefix / "ws/src-private"):
        folder.mkdir(parents=True)
    (source / "meshes/hand.stl").write_bytes(b"hand")
    (source / "meshes/notes.txt").write_bytes(b"notes")
    (source / "meshes/to_notes.stl").symlink_to("notes.txt")
    (source / "meshes/to_outside.stl").symlink_to(prefix / "outside/secret.stl")
    (prefix / "ws/src-private/key.stl").write_bytes(b"key")
    share = prefix / "share/arm"
    for name in ("hand", "to_notes", "to_outside"):
        (share / f"meshes/{name}.stl").symlink_to(source / f"meshes/{name}.stl")
    # As of packages in Python: over the build directory.
    (build / "meshes").symlink_to(source / "meshes")
    (share / "linked").symlink_to(build / "meshes")
    (share / "meshes/beside.stl").symlink_to(prefix / "ws/src-private/key.stl")
    (share / "meshes/dots.stl").symlink_to("../../../ws/src/arm/../../src-private/key.stl")
    return prefix / "ws/src"


@pytest.mark.parametrize("path", ["meshes/hand.stl", "linked/hand.stl"])
@pytest.mark.parametrize("linked_root", [False, True])
def test_links_may_lead_to_the_directories_of_the_settings(
    prefix: Path, workspace: Path, path: str, linked_root: bool
) -> None:
    uri, root = f"package://arm/{path}", workspace
    if linked_root:
        root = prefix / "home"
        root.symlink_to(workspace)
    with pytest.raises(Refused, match=r"add the directory it leads to to 'roots' in \[assets\]"):
        asset_path(uri, [prefix])
    assert asset_path(uri, [prefix], [root]).read_bytes() == b"hand"


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("meshes/to_outside.stl", "out of the package"),
        ("meshes/beside.stl", "out of the package"),
        ("meshes/dots.stl", "out of the package"),
        ("meshes/out.stl", "out of the package"),
        ("linked/../../../ws/src/arm/meshes/hand.stl", "downwards"),
        ("linked/%2e%2e/hand.stl", "downwards"),
        ("meshes/to_notes.stl", "of this kind"),
    ],
)
def test_links_lead_nowhere_else(prefix: Path, workspace: Path, path: str, words: str) -> None:
    (prefix / "loop").symlink_to("loop")
    roots = [workspace, prefix / "none", prefix / "loop"]
    assert asset_path("package://arm/meshes/hand.stl", [prefix], roots)
    with pytest.raises(Refused, match=words):
        asset_path(f"package://arm/{path}", [prefix], roots)


def test_a_directory_of_the_settings_is_no_package(prefix: Path, workspace: Path) -> None:
    for uri in ("package://src/arm/meshes/hand.stl", f"package://{workspace}/arm/meshes/hand.stl"):
        with pytest.raises(SwitchboardError):
            asset_path(uri, [prefix], [workspace])


class Scene:
    """One channel's assets; reading takes place when the test says so, or at once."""

    def __init__(self, prefix: Path) -> None:
        self.writer = RecordingWriter()
        self.held: list[Callable[[], None]] | None = None
        self.assets = ChannelAssets(self.writer, lambda: [prefix], self._run)

    def _run(self, work: Callable[[], link.AssetPart]) -> Deferred[link.AssetPart]:
        if self.held is None:
            return execute(work)
        waiting: Deferred[link.AssetPart] = Deferred()
        self.held.append(lambda: waiting.callback(work()))
        return waiting

    def get(self, uri: str, offset: int = 0) -> Any:
        """The answer to a request."""
        self.assets.get(link.GetAsset(number=7, uri=uri, offset=offset))
        return self.writer.sent[-1]


def test_a_file_is_sent_in_parts(prefix: Path) -> None:
    body = bytes(range(256)) * (limits.ASSET_PART // 128)
    (prefix / "share/arm/meshes/base.stl").write_bytes(body)
    scene, found, versions = Scene(prefix), b"", set()
    while len(found) < len(body):
        part = scene.get("package://arm/meshes/base.stl", len(found))
        assert (part.number, part.offset, part.size) == (7, len(found), len(body))
        versions.add(part.version)
        found += part.data
    assert found == body
    assert len(versions) == 1
    (prefix / "share/arm/meshes/base.stl").write_bytes(b"another")
    assert scene.get("package://arm/meshes/base.stl").version not in versions


def test_a_file_that_cannot_be_sent_is_answered_with_the_reason(
    prefix: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(prefix)
    assert scene.get("package://arm/meshes/sub.stl").reason == "it is no file"
    assert "UTF-8" in scene.get("package://arm/meshes/%ff.stl").reason
    monkeypatch.setattr(limits, "ASSET", 3)
    failed = scene.get("package://arm/meshes/base.stl")
    assert (failed.request, failed.reference) == ("get_asset", "7")
    assert "at most 3 are sent" in failed.reason


def test_a_directory_that_became_a_link_after_the_check_leads_nowhere(prefix: Path) -> None:
    path = asset_path("package://arm/meshes/base.stl", [prefix])
    assert read_part(1, path, 0).data == b"meshes/base.stl"
    path.parent.rename(prefix / "moved")
    (prefix / "outside/base.stl").write_bytes(b"secret")
    path.parent.symlink_to(prefix / "outside")
    with pytest.raises(NotFound, match="was moved"):
        read_part(1, path, 0)


def test_reads_are_bounded_and_end_with_the_channel(prefix: Path) -> None:
    scene = Scene(prefix)
    scene.held = []
    request = link.GetAsset(number=1, uri="package://arm/meshes/base.stl")
    for _ in range(module.READS):
        scene.assets.get(request)
    with pytest.raises(Unavailable, match="are being read already"):
        scene.assets.get(request)
    scene.held.pop(0)()
    scene.assets.get(request)
    assert len(scene.writer.sent) == 1
    scene.assets.close()
    for finish in scene.held:
        finish()
    assert len(scene.writer.sent) == 1
