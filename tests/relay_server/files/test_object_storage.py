"""Files in an S3-compatible storage: a server of moto, which checks what S3 checks."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from pathlib import Path

import boto3
import pytest
from moto.server import ThreadedMotoServer

from relay_protocol.errors import Invalid
from relay_server.files.build import open_storage
from relay_server.files.object_storage import ObjectStorage
from relay_server.files.storage import LocalStorage, StoringStopped
from relay_server.recordings.library import Library, RecordingEntry
from relay_server.recordings.library import open_storage as open_recording_storage
from tests.worlds.file_uploads import FileWorld, Steps

CONTENT = random.Random(1).randbytes(9 * 2**20)
"""More than one part of an upload, and more than one request of a download."""


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def storage(endpoint: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> ObjectStorage:
    """A bucket of this test."""
    settings = {"ENDPOINT_URL": endpoint, "ACCESS_KEY_ID": "key", "SECRET_ACCESS_KEY": "secret"}
    for name, value in {**settings, "REGION": "us-east-1", "ALLOW_HTTP": "true"}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    bucket = "b" + hashlib.sha256(request.node.name.encode()).hexdigest()[:20]
    client = boto3.client("s3", endpoint_url=endpoint, region_name="us-east-1")
    client.create_bucket(Bucket=bucket)
    found = open_storage(Path("/nowhere"), f"s3://{bucket}/files")
    assert isinstance(found, ObjectStorage)
    return found


def test_contents_are_stored_read_and_deleted(storage: ObjectStorage, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.write_bytes(CONTENT)
    assert storage.size("7") is None
    storage.store(source, "7")
    assert not source.exists()
    assert storage.size("7") == len(CONTENT)
    content = storage.open("7")
    parts = [content.read(offset, 256 * 1024) for offset in range(0, len(CONTENT), 256 * 1024)]
    assert b"".join(parts) == CONTENT
    assert content.read(len(CONTENT), 10) == b""
    assert content.read(5_000_000, 3_000_000) == CONTENT[5_000_000:8_000_000]
    assert content.read(100, 5) == CONTENT[100:105]
    content.close()
    storage.delete("7")
    storage.delete("7")
    assert storage.size("7") is None
    with pytest.raises(FileNotFoundError):
        storage.open("7")


def test_an_empty_file_is_stored(storage: ObjectStorage, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.write_bytes(b"")
    storage.store(source, "1")
    assert storage.size("1") == 0
    assert storage.open("1").read(0, 10) == b""


def test_a_storage_that_refuses_leaves_the_source(
    storage: ObjectStorage, endpoint: str, tmp_path: Path
) -> None:
    absent = ObjectStorage("s3://there-is-no-such-bucket/files")
    source = tmp_path / "source"
    source.write_bytes(b"content")
    with pytest.raises(OSError):
        absent.store(source, "1")
    assert source.read_bytes() == b"content"


def test_a_file_whose_upload_is_stopped_stays_and_leaves_no_parts(
    storage: ObjectStorage, endpoint: str, tmp_path: Path
) -> None:
    source = tmp_path / "source"
    source.write_bytes(CONTENT * 3)
    asked: list[int] = []

    def stopping() -> bool:
        asked.append(len(asked))
        return len(asked) > 2

    with pytest.raises(StoringStopped):
        storage.store(source, "3", stopping)
    assert source.read_bytes() == CONTENT * 3
    assert storage.size("3") is None
    client = boto3.client("s3", endpoint_url=endpoint, region_name="us-east-1")
    for bucket in client.list_buckets()["Buckets"]:
        assert "Uploads" not in client.list_multipart_uploads(Bucket=bucket["Name"])


def test_a_finished_recording_is_moved_read_and_deleted(
    storage: ObjectStorage, endpoint: str, tmp_path: Path
) -> None:
    client = boto3.client("s3", endpoint_url=endpoint, region_name="us-east-1")
    client.create_bucket(Bucket="recordings-of-robots")
    library = Library(tmp_path, 10**9, storage=open_recording_storage("s3://recordings-of-robots/files/"))
    library.open()
    entry = RecordingEntry("a-1", 1, "rover", 1, "ann", ("/odom",), (), 1.0, 10**6, 60.0)
    library.path(entry).write_bytes(CONTENT)
    library.move(entry, lambda: False)
    library.move(entry, lambda: False)
    assert library.on_disk() == set()
    [stored] = client.list_objects_v2(Bucket="recordings-of-robots")["Contents"]
    assert stored["Key"] == "files/recordings/a-1.mcap"
    content = library.open_content(entry)
    assert content.read(8_999_000, 500) == CONTENT[8_999_000:8_999_500]
    content.close()
    library.delete(entry.id)
    assert "Contents" not in client.list_objects_v2(Bucket="recordings-of-robots")
    with pytest.raises(FileNotFoundError):
        library.open_content(entry)


def test_a_robot_uploads_into_it_also_when_the_relay_dies(storage: ObjectStorage, tmp_path: Path) -> None:
    world = FileWorld(tmp_path)
    world.storage = storage
    for at in (4, 6, 8):
        name, content = f"{at}.bag", bytes([at]) * 40_000
        world.start_relay(Steps(at, True, world.cut))
        path = world.write(name, content)
        world.run(3)
        world.cut()
        world.start_relay(Steps())
        world.run(60)
        assert not path.exists()
        [file] = [each for each in world.stored() if each.name == f"bags/{name}"]
        assert world.read(file) == content
    assert world.incoming() == []


@pytest.mark.parametrize("url", ["s3://", "https://example.org", "/srv/files", "s3:bucket"])
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(Invalid):
        open_storage(Path("/nowhere"), url)


def test_without_a_url_files_are_in_the_folder(tmp_path: Path) -> None:
    assert isinstance(open_storage(tmp_path, ""), LocalStorage)
