"""Positions from NMEA sentences, and the sources of those."""

from __future__ import annotations

import math
import os
import socket
import threading
from functools import reduce
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol.errors import Invalid, Unavailable
from robot_client.services.gps import APPROXIMATED, LONGEST, NO_FIX, SBAS_FIX, Lines, Nmea
from robot_client.services.gps_source import ByteReader, FileSource, source_factory
from robot_client.services.health import Level
from tests.worlds.waiting import wait_for


def sentence(body: str) -> bytes:
    """Add the checksum."""
    return f"${body}*{reduce(lambda total, each: total ^ each, body.encode(), 0):02X}".encode()


GGA = sentence("GPGGA,123519.00,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,")


def test_fix_is_read() -> None:
    fix = Nmea().read(GGA)
    assert fix is not None
    assert (fix.latitude, fix.longitude) == pytest.approx((48.1173, 11.516667), abs=1e-6)
    assert fix.altitude == pytest.approx(545.4 + 46.9)
    assert (fix.status, fix.service) == (0, 1)
    assert fix.variances == pytest.approx((12.96, 12.96, 51.84))


def test_signs_and_variances_of_a_fix() -> None:
    nmea = Nmea()
    nmea.read(sentence("GAGSV,1,1,00"))
    fix = nmea.read(sentence("GNGGA,000000,3351.500,S,15112.500,W,2,12,1.0,10.0,M,,M,,"))
    assert fix is not None
    assert (fix.latitude, fix.longitude) == pytest.approx((-33.858333, -151.208333), abs=1e-6)
    assert fix.status == SBAS_FIX
    assert fix.variances is not None and fix.variances[0] == pytest.approx(1.0)
    assert math.isnan(fix.altitude)  # over the sea, but not over the ellipsoid


@pytest.mark.parametrize("quality", ["0", "6", "7", "8", ""])
def test_no_coordinates_without_a_fix(quality: str) -> None:
    """Estimated and simulated positions count as none."""
    fix = Nmea().read(sentence(f"GPGGA,123519,4807.038,N,01131.000,E,{quality},00,,,M,,M,,"))
    assert fix is not None
    assert fix.status == NO_FIX
    assert math.isnan(fix.latitude) and math.isnan(fix.longitude) and fix.variances is None


@pytest.mark.parametrize(
    "bad",
    [
        GGA[:-1] + b"0",
        GGA[: GGA.index(b"*")],
        GGA[:30],
        b"\xff\x00\x80" * 9,
        b"hello",
        sentence("GPGGA,123519,9907.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),
        sentence("GPGGA,123519,x,N,y,E,1,08,0.9,545.4,M,46.9,M,,"),
        sentence("GPGGA,123519,4807.038,N,01131.000,E,1,08,nan,545.4,M,46.9,M,,"),
        sentence("GPGGA,123519,4807.038,N,01131.000,E,z,08,0.9,545.4,M,46.9,M,,"),
        sentence("GPGGA,1"),
    ],
)
def test_bad_sentences_are_counted(bad: bytes) -> None:
    """The next is read."""
    nmea = Nmea()
    nmea.read(bad)
    assert nmea.read(GGA) is not None
    assert (nmea.good, nmea.bad) in ((1, 1), (2, 0))
    assert nmea.last is not None and nmea.last.variances is not None


def test_wrong_checksum_counts_as_bad() -> None:
    nmea = Nmea()
    assert nmea.read(GGA[:-1] + b"0") is None
    assert (nmea.good, nmea.bad) == (0, 1)


def test_other_sentences_give_no_fix() -> None:
    nmea = Nmea()
    assert nmea.read(sentence("GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W")) is None
    assert nmea.read(sentence("GPXYZ,1,2")) is None
    assert (nmea.good, nmea.bad) == (2, 0)


def test_sentence_after_a_truncated_one_is_read() -> None:
    """On the same line."""
    assert Nmea().read(GGA[:20] + GGA) is not None


@given(st.binary(max_size=100))
def test_any_bytes_are_survived(noise: bytes) -> None:
    nmea = Nmea()
    nmea.read(noise)
    nmea.read(b"$" + noise)
    assert nmea.read(GGA) is not None


@given(st.lists(st.integers(0, 120), max_size=6))
def test_lines_do_not_depend_on_the_pieces(cuts: list[int]) -> None:
    data = GGA + b"\r\n\r\n" + GGA + b"\nrest"
    lines = Lines()
    found: list[bytes] = []
    at = 0
    for cut in [*sorted(cuts), len(data)]:
        found += lines.feed(data[at:cut])
        at = max(at, cut)
    assert found == [GGA, GGA]


def test_too_long_lines_are_discarded_and_counted() -> None:
    lines = Lines()
    for _ in range(100):
        assert list(lines.feed(b"x" * LONGEST)) == []
    assert list(lines.feed(b"end\n" + GGA + b"\n")) == [GGA]
    assert lines.too_long == 1
    assert len(lines._unfinished) <= LONGEST


def test_documented_recording_is_valid() -> None:
    """A closed route with one loss of the fix."""
    lines, nmea = Lines(), Nmea()
    data = Path(__file__).parents[3].joinpath("docs/examples/drive.nmea").read_bytes()
    fixes = [fix for line in lines.feed(data) if (fix := nmea.read(line))]
    assert (nmea.good, nmea.bad, len(fixes)) == (120, 0, 60)
    assert sum(fix.status == NO_FIX for fix in fixes) == 3
    assert abs(fixes[0].latitude - fixes[-1].latitude) < 1e-4


def test_finding_has_the_quality_of_the_fix() -> None:
    nmea = Nmea()
    assert nmea.finding().message == "no position was received yet"
    nmea.read(sentence("GPGGA,123519,,,,,0,00,,,M,,M,,"))
    assert nmea.finding().message == "the receiver has no fix"
    nmea.read(GGA)
    nmea.read(b"$noise")
    found = nmea.finding(too_long=2)
    assert (found.level, found.message) == (Level.OK, "a fix of 8 satellites")
    assert found.values == {"sentences": "2", "bad_sentences": "3", "satellites": "8", "sigma_m": "3.60"}
    assert APPROXIMATED == 1


@pytest.mark.parametrize("bad", ["tcp://host", "tcp://:1", "tcp://host:0", "tcp://host:99999", "tcp://a:b:1"])
def test_invalid_address_is_refused(bad: str) -> None:
    with pytest.raises(Invalid):
        source_factory(bad, 9600, 1.0)


def test_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match="No such file"):
        source_factory(str(tmp_path / "none"), 9600, 1.0)


def test_recording_is_replayed_at_its_pace(tmp_path: Path) -> None:
    file = tmp_path / "drive.nmea"
    file.write_bytes(GGA + b"\n" + sentence("GPXYZ,1") + b"\n" + GGA + b"\n")
    waited: list[float] = []
    recording = FileSource(file, 0.5, waited.append)
    assert b"".join(recording.read() for _ in range(3)) == file.read_bytes()
    with pytest.raises(EOFError):
        recording.read()
    recording.close()
    assert waited == [0.5, 0.5]


def test_lost_server_is_connected_again() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        came: list[bytes] = []
        reader = ByteReader(
            "test", source_factory(f"tcp://127.0.0.1:{server.getsockname()[1]}", 9600, 1.0), came.append
        )
        try:
            for word in (b"one", b"two"):
                connection, _ = server.accept()
                connection.sendall(word)
                wait_for("it comes", lambda word=word: word in b"".join(came))
                assert reader.finding() is None
                connection.close()
        finally:
            reader.close()


def test_lost_serial_device_is_opened_again() -> None:
    """It is set to raw mode."""
    master, slave = os.openpty()
    came: list[bytes] = []
    reader = ByteReader("the receiver", source_factory(os.ttyname(slave), 4800, 1.0), came.append)
    try:
        wait_for(
            "it is read",
            lambda: os.write(master, b"$A\x03\r\n") and b"$A\x03\r\n" in b"".join(came),
        )
        os.close(slave)
        os.close(master)
        problem = wait_for("the loss", reader.finding)
        assert problem.level is Level.ERROR and problem.message.startswith("the receiver: ")
    finally:
        reader.close()
    assert "gps-source" not in {each.name for each in threading.enumerate()}
