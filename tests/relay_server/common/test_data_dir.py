"""A data folder belongs to one relay at a time."""

from __future__ import annotations

from pathlib import Path

import pytest

from relay_protocol.errors import Unavailable
from relay_server.common.data_dir import DataDir


def test_a_second_relay_is_refused_with_a_reason(tmp_path: Path) -> None:
    """It can use the folder when the first relay has ended."""
    first = DataDir(tmp_path)
    with pytest.raises(Unavailable, match="another relay runs on this data folder"):
        DataDir(tmp_path)
    first.release()
    DataDir(tmp_path).release()


def test_leftovers_of_a_killed_relay_do_not_prevent_a_start(tmp_path: Path) -> None:
    """A lock file and a socket without an owner are replaced."""
    (tmp_path / "relay.lock").write_text("1")
    socket = tmp_path / "relay.sock"
    socket.touch()
    folder = DataDir(tmp_path)
    folder.clear_socket(socket)
    assert not socket.exists()
    folder.release()


def test_a_relay_keeps_its_name(tmp_path: Path) -> None:
    """Robots sign for the relay's name, so it must survive restarts."""
    folder = DataDir(tmp_path)
    name = folder.relay_name()
    assert name.startswith("relay-")
    assert folder.relay_name() == name
    folder.release()
