"""Words to sound by eSpeak NG, whose library is called where it is: in the package espeakng-loader, or in the system.

Source: eSpeak NG, src/include/espeak-ng/speak_lib.h.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from relay_protocol.errors import Invalid, Unavailable

_SYNCHRONOUS = 2
"""Output goes to the callback, within ``espeak_Synth``."""
_DONT_EXIT = 0x8000
"""Without it the library ends the process when its data is missing."""
_UTF8 = 1
_END_PAUSE = 0x1000
_RATE, _VOLUME = 1, 2
_GO_ON, _ENOUGH = 0, 1

_LONGEST_PATH = 140
"""The library has 160 bytes for the path of its data, and some of them are for names within."""

_Callback = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.c_void_p)

MISSING = (
    "eSpeak NG is not here: install 'robot-switchboard[services]', or the system's own "
    "(Debian, Ubuntu: apt install libespeak-ng1)"
)


def find() -> tuple[str, str | None]:
    """Where the library is, and its data; ``None`` where it knows that itself.

    :raises Unavailable: it is nowhere
    """
    try:
        import espeakng_loader
    except ImportError:
        pass
    else:
        return str(espeakng_loader.get_library_path()), str(espeakng_loader.get_data_path())
    system = ctypes.util.find_library("espeak-ng")
    if system is None:
        raise Unavailable(MISSING)
    return system, None


class Espeak:
    """One voice. There is one library in a process, so make one of these, and use it in one thread at a time.

    :param voice: its name or a language: ``en``, ``en-us``, ``de``, ``cs`` …
    :param words_per_minute: 80 to 450
    :param volume: 0 to 200, 100 as it is made
    :raises Unavailable: the library is missing, or does not start
    :raises Invalid: there is no such voice
    :ivar rate: samples per second of what it gives
    """

    def __init__(self, voice: str = "en", words_per_minute: int = 160, volume: int = 100) -> None:
        file, data = find()
        try:
            self._library: Any = ctypes.CDLL(file)
        except OSError as error:
            raise Unavailable(f"eSpeak NG can't be loaded: {error}") from None
        self._library.espeak_Synth.argtypes = [
            ctypes.c_char_p,
            ctypes.c_size_t,
            ctypes.c_uint,
            ctypes.c_int,
            ctypes.c_uint,
            ctypes.c_uint,
            ctypes.c_void_p,
            ctypes.c_void_p,
        ]
        self._short: tempfile.TemporaryDirectory[str] | None = None
        if data and len(data.encode()) > _LONGEST_PATH:
            self._short = tempfile.TemporaryDirectory(prefix="speech-")
            link = Path(self._short.name, "espeak-ng-data")
            link.symlink_to(data)
            data = str(link)
        path = data.encode() if data else None
        self.rate: int = self._library.espeak_Initialize(_SYNCHRONOUS, 0, path, _DONT_EXIT)
        if self.rate <= 0:
            raise Unavailable(f"eSpeak NG does not start; are its data there? ({Path(data or '/usr/share')})")
        # Kept: the library calls it as long as it lives.
        self._callback = _Callback(self._take)
        self._library.espeak_SetSynthCallback(self._callback)
        if not voice or self._library.espeak_SetVoiceByName(voice.encode()) != 0:
            raise Invalid(f"eSpeak NG has no voice '{voice}'")
        self._library.espeak_SetParameter(_RATE, words_per_minute, 0)
        self._library.espeak_SetParameter(_VOLUME, volume, 0)
        self._parts: list[bytes] = []
        self._left = 0
        self._stopped: Callable[[], bool] = lambda: False

    def sound(self, text: str, longest: float, stopped: Callable[[], bool] = lambda: False) -> bytes:
        """A text as sound: signed 16 bit samples of one channel, in this machine's byte order.

        :param longest: seconds of sound after which it is cut
        :param stopped: asked now and then; true ends it
        :raises Unavailable: the library fails
        """
        said = text.replace("\0", " ").encode() + b"\0"
        self._parts, self._left, self._stopped = [], round(longest * self.rate), stopped
        failed = self._library.espeak_Synth(said, len(said), 0, 1, 0, _UTF8 | _END_PAUSE, None, None)
        parts, self._parts = self._parts, []
        if failed:
            raise Unavailable(f"eSpeak NG could not say it (error {failed})")
        return b"".join(parts)

    def _take(self, samples: Any, count: int, _: Any) -> int:
        if samples and count > 0:
            count = min(count, self._left)
            self._left -= count
            self._parts.append(ctypes.string_at(samples, count * ctypes.sizeof(ctypes.c_short)))
        return _ENOUGH if self._left <= 0 or self._stopped() else _GO_ON
