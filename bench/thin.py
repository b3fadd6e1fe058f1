"""Thin links. A downlink to a client is measured in :mod:`bench.downlink`, small topics on an uplink in
:mod:`bench.uplink`. Here an uplink becomes thin: how old pictures are 5 s later, how much smaller, and how soon they
are as before.

Real relay, daemon and simulated robot, whose bytes go through a proxy that hands on so many a second and holds back
what comes beyond that. A picture is as old as the stamp in its header says, by the clock both ends share here.
"""

from __future__ import annotations

import statistics
import time

from bench import downlink, uplink
from bench.cameras import CAMERAS, Camera, Scene, scene
from bench.report import Options, Row
from tests.worlds.video_clients import Shown, VideoViewer

KILOBITS = (1000, 200)
"""Per second."""

SETTLES = 5.0
"""Seconds in which pictures become small enough."""

TARGET_MS = 300.0
"""What the robot keeps their delay under (`target_delay_ms` in its settings)."""

BACK_SECONDS = 120.0
"""Until they are as they were."""


def run(options: Options) -> list[Row]:
    """Downlinks, an uplink, then both cameras, each over both uplinks."""
    rows = downlink.run(options) + uplink.run(options)
    for camera in CAMERAS[:1] if options.quick else CAMERAS:
        with scene(camera) as at:
            for kilobits in KILOBITS[:1] if options.quick else KILOBITS:
                rows += _squeezed(at, camera, kilobits, options)
    return rows


def _squeezed(at: Scene, camera: Camera, kilobits: int, options: Options) -> list[Row]:
    seconds, settles = options.pick(1, 20), options.pick(1, SETTLES)
    with VideoViewer(at.relay, at.tokens[0], "rover") as eye:
        whole = eye.watch_until("pictures are as asked for", lambda _: eye.playing["reduced"] == 0, 60)
        before = statistics.median(len(each.body) for each in [whole, *eye.watch(2)])
        at.proxy.squeeze(kilobits * 1000)
        try:
            eye.watch(settles)
            pictures = eye.watch(seconds)
            playing = eye.playing
        finally:
            at.proxy.squeeze(None)
            freed = time.monotonic()
        eye.watch_until("pictures are as before", lambda each: _whole(eye, each, camera), BACK_SECONDS)
        back = time.monotonic() - freed
    delays = sorted(each.delay_ms for each in pictures)
    p95 = delays[min(len(delays) - 1, round(0.95 * (len(delays) - 1)))]
    what = f"{camera.name}, uplink of {kilobits} kbit/s"
    note = (
        f"{what}: {len(pictures) / seconds:.1f} pictures a second of {playing['width']}×{playing['height']}, quality "
        f"{playing['quality']}; the oldest {delays[-1]:.0f} ms"
    )
    rows = [
        Row(
            "thin",
            f"{what}: age of a picture after {settles:g} s, median",
            "ms",
            statistics.median(delays),
            bar=TARGET_MS,
        ),
        Row(
            "thin", f"{what}: age of a picture after {settles:g} s, p95", "ms", p95, bar=TARGET_MS, note=note
        ),
        Row(
            "thin",
            f"{what}: bytes of a picture",
            "bytes",
            statistics.median(len(each.body) for each in pictures),
            before,
            "before",
            0.5,
        ),
        Row("thin", f"{what}: as before, after it is freed", "s", back, bar=BACK_SECONDS),
    ]
    for row in rows:
        print(f"    {row.what}: {row.ours:.1f} {row.unit}", flush=True)
    return rows


def _whole(eye: VideoViewer, shown: Shown, camera: Camera) -> bool:
    return eye.playing["reduced"] == 0 and shown.head["width"] == camera.width
