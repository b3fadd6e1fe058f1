"""A program on a robot that finds and follows faces, here or by workers: ``python -m bench.offload_device``.

It reads commands from standard input, one JSON object a line, and answers each with a line. Its processor time is
that of all its threads, the link's among them.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import cv2
import numpy as np
from skimage import data

from relay_protocol.function_link import CallFunction
from relay_protocol.functions import encode_value
from robot_client.functions import vision
from robot_client.offload import Cloud
from robot_client.offload.cloud import _wait, result_of

FRAME = (640, 480)
SMALL = (320, 240)
"""Pixels of the frames that are followed, and of those that are analysed in hundreds."""

FRAME_BYTES = 100_000
QUALITY = 85
STEP = 2
"""Pixels that the face moves from frame to frame."""
NOISE = 2.0
KINDS = 8
"""Different frames; a camera's are all different, but they take long to make."""

DEADLINE = 600.0


def frames(size: tuple[int, int]) -> list[bytes]:
    """Frames of a face that moves, as JPEG."""
    person = np.ascontiguousarray(data.astronaut()[:480, :, ::-1])
    random = np.random.default_rng(0)
    made = []
    for number in range(KINDS):
        pixels = np.full((480, 640, 3), 110, np.uint8)
        pixels[:, number * STEP : number * STEP + 512] = person
        small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        noisy = np.clip(small + random.normal(0, NOISE, small.shape), 0, 255).astype(np.uint8)
        made.append(vision.encode_jpeg(noisy, QUALITY))
    return made


class Device:
    """The functions, here and there."""

    def __init__(self) -> None:
        cv2.setNumThreads(1)
        self.cloud = Cloud()
        self.frames = frames(FRAME)
        self.small = frames(SMALL)
        self.face = vision.detect_faces(self.frames[0])[0]

    def run(self, where: str, name: str, **arguments: Any) -> tuple[Any, float]:
        """Call a function; its result, and the seconds for which it ran."""
        if where == "here":
            began = time.perf_counter()
            found = getattr(vision, name)(**arguments)
            return found, time.perf_counter() - began
        request = CallFunction(function=name, arguments=encode_value(arguments), deadline=DEADLINE)
        reply = _wait(self.cloud._begin(request, DEADLINE).future, DEADLINE, name)
        return result_of(reply), reply.seconds

    def once(self, where: str, name: str, count: int) -> dict[str, Any]:
        """Milliseconds of calls of ``detect_faces`` or ``track_face``, with transmission and without."""
        whole, alone = [], []
        for number in range(count):
            began = time.perf_counter()
            _, ran = self.run(where, name, **self.arguments(name, number))
            whole.append((time.perf_counter() - began) * 1000)
            alone.append(ran * 1000)
        return {"whole": whole, "alone": alone, "bytes": len(self.frames[0])}

    def arguments(self, name: str, number: int) -> dict[str, Any]:
        """Of the number-th call."""
        image = self.frames[(number + 1) % KINDS]
        if name == "detect_faces":
            return {"image": image}
        return {"before": self.frames[number % KINDS], "image": image, "face": self.face}

    def calls(self, count: int) -> dict[str, Any]:
        """Milliseconds of calls of a function that does nothing with a frame, beside its own time."""
        frame, added = bytes(FRAME_BYTES), []
        for _ in range(count):
            began = time.perf_counter()
            _, ran = self.run("cloud", "size_of", data=frame)
            added.append((time.perf_counter() - began - ran) * 1000)
        return {"added": added}

    def follow(self, where: str, seconds: float, hertz: float) -> dict[str, Any]:
        """Find the face in the newest frame of a camera, and follow it from the frame before.

        Frames that come while it is at work are left out. The processor's milliseconds are those for each frame
        that was taken.
        """
        began, used, taken, number = time.monotonic(), time.process_time(), 0, 0
        while (due := began + number / hertz) < began + seconds:
            time.sleep(max(0.0, due - time.monotonic()))
            self.run(where, "detect_faces", **self.arguments("detect_faces", number))
            self.run(where, "track_face", **self.arguments("track_face", number))
            taken += 1
            number = max(number + 1, int((time.monotonic() - began) * hertz))
        ms = (time.process_time() - used) * 1000 / taken
        return {"ms": ms, "hertz": taken / (time.monotonic() - began)}

    def analyse(self, where: str, count: int) -> dict[str, Any]:
        """Analyse so many frames at once."""
        images = [self.small[number % KINDS] for number in range(count)]
        began, used = time.perf_counter(), time.process_time()
        _, ran = self.run(where, "analyse_frames", frames=images)
        took = time.perf_counter() - began
        return {
            "ms": took * 1000,
            "alone": ran * 1000,
            "percent": 100 * (time.process_time() - used) / took,
            "bytes": sum(map(len, images)),
        }


def main() -> None:
    """Answer commands until standard input ends."""
    device = Device()
    print("READY", flush=True)
    for line in sys.stdin:
        command = json.loads(line)
        print(json.dumps(getattr(device, command.pop("do"))(**command)), flush=True)


if __name__ == "__main__":
    main()
