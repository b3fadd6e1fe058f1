"""Positions from NMEA 0183 sentences. Pure: bytes in, fixes out."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import pynmea2

from robot_client.services.health import Level, ServiceFinding

LONGEST = 256
"""Bytes of one line; the standard has 82, some receivers write more."""

NO_FIX, FIX, SBAS_FIX, GBAS_FIX = -1, 0, 1, 2
"""Of sensor_msgs/NavSatStatus."""

UNKNOWN, APPROXIMATED = 0, 1
"""Kinds of covariance, of sensor_msgs/NavSatFix."""

QUALITIES: dict[int, tuple[int, float]] = {
    1: (FIX, 4.0),
    2: (SBAS_FIX, 1.0),
    3: (FIX, 4.0),
    4: (GBAS_FIX, 0.02),
    5: (GBAS_FIX, 0.5),
    9: (SBAS_FIX, 1.0),
}
"""By quality in GGA: status, and standard deviation in metres at a dilution of 1. Estimated, manual and simulated
positions (6 to 8) are missing, so they count as no fix."""

SYSTEMS = {"GP": 1, "GL": 2, "GB": 4, "BD": 4, "GA": 8, "GN": 0}
"""By talker id of a sentence: service of NavSatStatus; ``GN`` means several together."""

UPWARD = 2.0
"""Ratio of the standard deviations of height and horizontal position."""


class Fix(NamedTuple):
    """Position of the receiver. Coordinates are NaN without a fix.

    :ivar status: of NavSatStatus
    :ivar service: systems that were received so far, bits of NavSatStatus
    :ivar latitude: degrees
    :ivar longitude: degrees
    :ivar altitude: metres over the ellipsoid (WGS 84), NaN if not known
    :ivar variances: m², east, north and up; ``None`` if not known
    """

    status: int
    service: int
    latitude: float
    longitude: float
    altitude: float
    variances: tuple[float, float, float] | None


class Lines:
    """Cuts bytes into lines; lines too long for a sentence are discarded and counted."""

    def __init__(self) -> None:
        self.too_long = 0
        self._unfinished = b""
        self._skipping = False

    def feed(self, data: bytes) -> Iterator[bytes]:
        """The lines that are complete now, without their ends."""
        *lines, unfinished = (self._unfinished + data).split(b"\n")
        self._unfinished = b""
        for line in lines:
            skipped, self._skipping = self._skipping, False
            if skipped or len(line) > LONGEST:
                self.too_long += not skipped
            elif line.strip():
                yield line.strip()
        if len(unfinished) > LONGEST:
            self.too_long += not self._skipping
            self._skipping = True
        else:
            self._unfinished = unfinished


class Nmea:
    """Reads sentences.

    GGA has the fix. Sentences of other kinds, and those that can't be read, are counted and ignored.

    :ivar good: number of sentences that could be read
    :ivar bad: number of sentences that could not: noise, a wrong checksum, invalid fields
    :ivar satellites: number of satellites in use
    :ivar last: latest fix
    """

    def __init__(self) -> None:
        self.good = 0
        self.bad = 0
        self.satellites = 0
        self.last: Fix | None = None
        self._service = 0

    def read(self, line: bytes) -> Fix | None:
        """The fix in a line; ``None``: the line has none."""
        start = line.rfind(b"$")  # a truncated sentence may precede it
        try:
            sentence = pynmea2.parse(line[max(0, start) :].decode("ascii"), check=True)
            fix = self._fix(sentence) if isinstance(sentence, pynmea2.GGA) else None
        except pynmea2.SentenceTypeError:
            fix = None  # of another kind
        except ValueError:  # pynmea2.ParseError is one
            self.bad += 1
            return None
        self.good += 1
        self.last = fix or self.last
        return fix

    def finding(self, too_long: int = 0) -> ServiceFinding:
        """Diagnostics of the receiver.

        :param too_long: number of lines that were too long for a sentence
        """
        values = {
            "sentences": str(self.good),
            "bad_sentences": str(self.bad + too_long),
            "satellites": str(self.satellites),
        }
        if self.last is None:
            return ServiceFinding(Level.WARN, "no position was received yet", values)
        if self.last.status == NO_FIX:
            return ServiceFinding(Level.WARN, "the receiver has no fix", values)
        if self.last.variances:
            values["sigma_m"] = f"{math.sqrt(self.last.variances[0]):.2f}"
        return ServiceFinding(Level.OK, f"a fix of {self.satellites} satellites", values)

    def _fix(self, sentence: Any) -> Fix:
        """:raises ValueError: a field is invalid"""
        self._service |= SYSTEMS.get(sentence.talker, 0)
        self.satellites = int(sentence.num_sats or 0)
        status, sigma = QUALITIES.get(int(sentence.gps_qual or 0), (NO_FIX, 0.0))
        if status == NO_FIX or not (sentence.lat and sentence.lon):
            return Fix(NO_FIX, self._service, math.nan, math.nan, math.nan, None)
        latitude, longitude = float(sentence.latitude), float(sentence.longitude)
        if not (abs(latitude) <= 90 and abs(longitude) <= 180):
            raise ValueError("the coordinates are out of range")
        altitude = _number(sentence.altitude) + _number(sentence.geo_sep)
        dilution = _number(sentence.horizontal_dil)
        variances = None
        if dilution > 0:
            horizontal = (dilution * sigma) ** 2
            variances = (horizontal, horizontal, horizontal * UPWARD**2)
        return Fix(status, self._service, latitude, longitude, altitude, variances)


def _number(field: Any) -> float:
    """:raises ValueError: it is not a number, or not finite"""
    if field in (None, ""):
        return math.nan
    number = float(field)
    if not math.isfinite(number):
        raise ValueError("not a finite number")
    return number
