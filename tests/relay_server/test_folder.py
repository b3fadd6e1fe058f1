"""The data folder belongs to one relay at a time."""

from __future__ import annotations

from pathlib import Path

import pytest

from relay_protocol.errors import Unavailable
from relay_server.common.data_dir import DataDir


def test_a_second_relay_is_refused_in_words(tmp_path: Path) -> None:
    """While one relay holds the folder, another can't have it; afterwards it can."""
    first = DataDir(tmp_path)
    with pytest.raises(Unavailable, match="another relay runs on this data folder"):
        DataDir(tmp_path)
    first.release()
    DataDir(tmp_path).release()


def test_what_a_killed_relay_left_does_not_keep_the_next_from_starting(tmp_path: Path) -> None:
    """A lock file and a socket that nobody holds are taken over."""
    (tmp_path / "relay.lock").write_text("1")
    socket = tmp_path / "relay.sock"
    socket.touch()
    folder = DataDir(tmp_path)
    folder.clear_socket(socket)
    assert not socket.exists()
    folder.release()


def test_a_relay_keeps_its_name(tmp_path: Path) -> None:
    """Robots sign for the relay's name, so it outlives restarts."""
    folder = DataDir(tmp_path)
    name = folder.relay_name()
    assert name.startswith("relay-")
    assert folder.relay_name() == name
    folder.release()
