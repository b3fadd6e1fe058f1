"""Video: one stream for each camera and form of it that is watched, made once by the robot, shown to all.

``stream`` is a table of states like a channel, with a link of its own to the robot; ``hub`` has all streams;
``pictures`` looks at what robots send before anybody gets it; ``keys`` knows when a key frame is asked for,
``patience`` how long somebody waits for his first picture; ``ends`` says what links and viewers are.
"""

from relay_server.video.ends import (
    NO_CAMERA,
    NothingCame,
    NotMade,
    TooOften,
    VideoLink,
    Viewer,
    Wish,
    differing,
)
from relay_server.video.hub import Videos
from relay_server.video.pictures import Picture
from relay_server.video.states import State
from relay_server.video.stream import Stream

__all__ = [
    "NO_CAMERA",
    "NotMade",
    "NothingCame",
    "Picture",
    "State",
    "Stream",
    "TooOften",
    "VideoLink",
    "Videos",
    "Viewer",
    "Wish",
    "differing",
]
