"""Recordings: what topics and cameras of a robot say, kept by the relay in MCAP files.

``recorder`` is one recording while it runs, a member of the robot's channel like any client; ``writer`` writes its
file in a thread of its own, ``mcap_file`` knows the format; ``library`` has the files, ``mender`` makes those readable
that broke off, ``recordings`` has all of a relay's; ``rights`` says who may record and have what, ``desk`` finds it,
``sweeping`` deletes those of robots that were removed.
"""

from relay_server.recording.desk import PAGE, PAGE_MOST, Download, RecordingDesk
from relay_server.recording.library import FOLDER, Library, kept_of
from relay_server.recording.recordings import Ask, Recordings
from relay_server.recording.sweeping import sweep

__all__ = [
    "FOLDER",
    "PAGE",
    "PAGE_MOST",
    "Ask",
    "Download",
    "Library",
    "RecordingDesk",
    "Recordings",
    "kept_of",
    "sweep",
]
