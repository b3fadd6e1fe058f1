"""Drives a robot by a gamepad: ``python -m robot_client.apps.joystick``.

The robot moves only while a button on the shoulder is held. It stops at once when the button is released, the stick is
centred, the gamepad is unplugged or the program ends. When the connection is lost, relay and robot stop it. After any
of these the stick and the button must be released before they count again.
"""

from __future__ import annotations

import enum
import math
import os
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import click

from relay_protocol.clocks import now as seconds_since_boot
from relay_protocol.command_output import OutputCommand
from robot_client.apps.connection import RosbridgeConnection, errors_as_click
from robot_client.apps.driver import Driver, MaximumSpeeds, StopRequest, VelocityCommand
from robot_client.apps.program import ExitSignal, StatusLine, driving, run_connected
from robot_client.command_line import Number

AXIS_MAX = 32767.0
"""SDL's largest value of an axis."""


class Gamepad(Protocol):
    """An input device for driving."""

    @property
    def problem(self) -> str:
        """Why the connected device cannot be used; empty otherwise."""

    def read(self) -> GamepadState | None:
        """Its state; ``None`` when no device is connected, and once when the device has changed."""


class ButtonLayout(NamedTuple):
    """Where a pad has what, by the numbers of pygame.

    :ivar ahead: axis; -1 is away from oneself
    :ivar left: axis; -1 is to the left
    :ivar hold: the dead man's button
    :ivar stop: button
    :ivar back: button that releases control
    """

    ahead: int
    left: int
    hold: int
    stop: int
    back: int


def _controls(pad: Any) -> int:
    return int(pad.get_numaxes() + pad.get_numbuttons())


class Gamepads:
    """The first gamepad whose layout is known; one that is unplugged is gone, and the next one counts.

    :param layout: of gamepads that SDL does not know; without it they do not drive, since any of their buttons could
        be pressed by accident. What SDL knows has the same buttons in the same places.
    :raises click.ClickException: there is no pygame
    """

    def __init__(self, layout: ButtonLayout | None) -> None:
        # Without a window there is no focus to have; signals are ours.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ["SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS"] = "1"
        os.environ["SDL_NO_SIGNAL_HANDLERS"] = "1"
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
            from pygame._sdl2 import controller
        except ImportError as error:
            raise click.ClickException(f"a gamepad needs pygame: pip install '.[apps]' ({error})") from None
        self._pygame: Any = pygame
        self._controller: Any = controller
        self._layout = layout
        self._open: Any = None
        self._known = False
        self._unknown: Any = None
        pygame.display.init()  # events come by it
        pygame.joystick.init()
        controller.init()

    @property
    def problem(self) -> str:
        """Names the device, and the buttons that are pressed, so that their numbers can be found."""
        pad = self._unknown
        if pad is None or not pad.get_init():
            return ""
        pressed = " ".join(str(button) for button in range(pad.get_numbuttons()) if pad.get_button(button))
        pressed = f"(pressed: {pressed or 'no button'})"
        if self._layout is not None:
            return f"{pad.get_name()} lacks axes or buttons of --axes and --buttons {pressed}"
        return f"the layout of {pad.get_name()} is not known; give --axes and --buttons {pressed}"

    def read(self) -> GamepadState | None:
        """Its state now."""
        # For a gamepad that SDL does not know, only the event queue reports the removal.
        removed = {
            event.instance_id
            for event in self._pygame.event.get()
            if event.type == self._pygame.JOYDEVICEREMOVED
        }
        if self._open is not None and not self._is_attached(removed):
            self._open.quit()
            self._open = None
            # Also when another gamepad is connected: the button was held on this one.
            return None
        if self._open is None:
            self._open_first()
        if self._open is None:
            return None
        return self._read_controller() if self._known else self._read_joystick()

    def _is_attached(self, removed: set[int]) -> bool:
        if self._known:
            return bool(self._open.attached())
        return self._open.get_init() and self._open.get_instance_id() not in removed

    def _open_first(self) -> None:
        devices = range(self._pygame.joystick.get_count())
        known = next((device for device in devices if self._controller.is_controller(device)), None)
        self._known = known is not None
        if known is not None:
            self._open = self._controller.Controller(known)
            self._unknown = None
            return
        # Some devices report themselves as a joystick without axes or buttons.
        pads = sorted(map(self._pygame.joystick.Joystick, devices), key=_controls, reverse=True)
        self._open = next((pad for pad in pads if self._fits(pad)), None)
        self._unknown = pads[0] if pads and self._open is None else None
        for pad in pads:
            if pad not in (self._open, self._unknown):
                pad.quit()

    def _fits(self, pad: Any) -> bool:
        layout = self._layout
        if layout is None:
            return False
        axes, buttons = max(layout.ahead, layout.left), max(layout.hold, layout.stop, layout.back)
        return bool(axes < pad.get_numaxes() and buttons < pad.get_numbuttons())

    def _read_controller(self) -> GamepadState:
        pygame, pad = self._pygame, self._open
        return GamepadState(
            -pad.get_axis(pygame.CONTROLLER_AXIS_LEFTY) / AXIS_MAX,
            -pad.get_axis(pygame.CONTROLLER_AXIS_LEFTX) / AXIS_MAX,
            bool(pad.get_button(pygame.CONTROLLER_BUTTON_RIGHTSHOULDER)),
            bool(pad.get_button(pygame.CONTROLLER_BUTTON_B)),
            bool(pad.get_button(pygame.CONTROLLER_BUTTON_BACK)),
        )

    def _read_joystick(self) -> GamepadState:
        layout = self._layout
        assert layout is not None
        return GamepadState(
            -self._axis(layout.ahead),
            -self._axis(layout.left),
            self._button(layout.hold),
            self._button(layout.stop),
            self._button(layout.back),
        )

    def _axis(self, number: int) -> float:
        return float(self._open.get_axis(number)) if number < self._open.get_numaxes() else 0.0

    def _button(self, number: int) -> bool:
        return bool(self._open.get_button(number)) if number < self._open.get_numbuttons() else False


FROZEN_SECONDS = 0.5
"""Longest time between two readings. After a longer one stick and button must be released."""


class GamepadState(NamedTuple):
    """State of a gamepad.

    :ivar ahead: of the stick, -1 (backward) to 1
    :ivar left: of the stick, -1 (right) to 1
    :ivar pressed: whether the dead man's button is pressed
    :ivar stop: whether the stop button is pressed
    :ivar back: whether the button that releases control is pressed
    """

    ahead: float
    left: float
    pressed: bool
    stop: bool = False
    back: bool = False


class Stick(NamedTuple):
    """Requested motion as a fraction of the maximum speeds: -1 to 1, ahead and to the left."""

    ahead: float
    left: float


CENTERED = Stick(0.0, 0.0)


class StickCurve(NamedTuple):
    """Response curve of the stick.

    :ivar dead: deadzone, 0 to 1, because worn sticks do not return to the centre
    :ivar expo: 0 (linear) to 1 (cubic, fine near the centre)
    """

    dead: float = 0.15
    expo: float = 0.4

    def apply(self, state: GamepadState) -> Stick:
        """Zero in the deadzone, continuous at its edge, 1 at full deflection."""
        far = math.hypot(state.ahead, state.left)
        if not math.isfinite(far) or far <= self.dead:
            return CENTERED
        part = (min(far, 1.0) - self.dead) / (1.0 - self.dead)
        strength = (1.0 - self.expo) * part + self.expo * part**3
        return Stick(state.ahead / far * strength, state.left / far * strength)


class DeadmanPhase(enum.Enum):
    """State of the dead man's control."""

    NO_GAMEPAD = "no gamepad"
    MUST_RELEASE = "release stick and button"
    READY = "hold the button to drive"
    DRIVING = "driving"


class DriveEnd(enum.Enum):
    """Why driving ended."""

    RELEASED = "the button was released"
    UNPLUGGED = "the gamepad is gone"
    FROZEN = "the program stood still for too long"
    NOT_ALLOWED = "driving is not possible any more"


class Deadman:
    """State machine of the dead man's button.

    :param curve: of the stick
    :ivar phase: current state
    :ivar ended: why driving ended last
    """

    def __init__(self, curve: StickCurve) -> None:
        self.phase = DeadmanPhase.NO_GAMEPAD
        self.ended: DriveEnd | None = None
        self._curve = curve
        self._updated_at = math.inf

    def update(self, state: GamepadState | None, allowed: bool, now: float) -> Stick | None:
        """Motion for the robot now; ``None`` for none, and the robot must stop if it was driving.

        :param state: ``None`` without a gamepad
        :param allowed: whether the robot can be driven
        :param now: seconds, including suspends
        """
        froze, self._updated_at = now - self._updated_at > FROZEN_SECONDS, now
        stick = CENTERED if state is None else self._curve.apply(state)
        if self.phase is DeadmanPhase.DRIVING:
            self._while_driving(state, allowed, froze)
            return stick if self.phase is DeadmanPhase.DRIVING else None
        if state is None:
            self.phase = DeadmanPhase.NO_GAMEPAD
        elif self.phase is DeadmanPhase.READY and state.pressed:
            # Start with a centred stick: the robot obeys only after the controls were released.
            self.phase = DeadmanPhase.DRIVING if allowed else DeadmanPhase.MUST_RELEASE
            return CENTERED if allowed else None
        elif self.phase is not DeadmanPhase.READY:
            self.phase = (
                DeadmanPhase.READY if not state.pressed and stick == CENTERED else DeadmanPhase.MUST_RELEASE
            )
        return None

    def require_release(self) -> None:
        """Ignore stick and button until they have been released."""
        if self.phase is not DeadmanPhase.NO_GAMEPAD:
            self.phase = DeadmanPhase.MUST_RELEASE

    def _while_driving(self, state: GamepadState | None, allowed: bool, froze: bool) -> None:
        if state is None:
            self.phase, self.ended = DeadmanPhase.NO_GAMEPAD, DriveEnd.UNPLUGGED
        elif not state.pressed:
            self.phase, self.ended = DeadmanPhase.READY, DriveEnd.RELEASED
        elif froze:
            self.phase, self.ended = DeadmanPhase.MUST_RELEASE, DriveEnd.FROZEN
        elif not allowed:
            self.phase, self.ended = DeadmanPhase.MUST_RELEASE, DriveEnd.NOT_ALLOWED


NAME = "joystick"
POLL_SECONDS = 0.02
"""Interval of gamepad readings."""

COMMAND_SECONDS = 0.05
"""Interval of commands; zero velocity is sent at once."""


class Joystick:
    """Drives a robot by a gamepad.

    :param pad: the gamepad
    :param deadman: its dead man's control
    :param topic: of the commands
    :param wanted: maximum speeds; the robot's own limits apply too
    :param report: takes the state, and details that change all the time
    :param clock: seconds, including suspends
    """

    def __init__(
        self,
        pad: Gamepad,
        deadman: Deadman,
        topic: str,
        wanted: MaximumSpeeds,
        report: Callable[[str, str], None],
        clock: Callable[[], float] = seconds_since_boot,
    ) -> None:
        self._pad = pad
        self._deadman = deadman
        self._topic = topic
        self._wanted = wanted
        self._report = report
        self._clock = clock
        self._driver: Driver
        self._stop = StopRequest()
        self._sent = -math.inf
        self._last = CENTERED
        self._pressed = (False, False)

    def begin(self, connection: RosbridgeConnection) -> None:
        """Stick and button must be released on a new connection; a pressed stop button still stops."""
        self._pressed = (False, False)
        self._deadman.require_release()
        self._driver = Driver(connection, self._topic, NAME, self._clock, self._stop)

    def step(self) -> bool:
        """Receive one message, read the gamepad, and drive."""
        driver = self._driver
        driver.poll(POLL_SECONDS)
        now = self._clock()
        state = self._pad.read()
        self._press(state)
        was = self._deadman.phase
        allowed = driver.in_control and not driver.blocked_by and not driver.unresponsive
        stick = self._deadman.update(state, allowed, now)
        if stick is not None:
            self._drive(stick, now)
        elif was is DeadmanPhase.DRIVING:
            driver.halt()
        if was is DeadmanPhase.READY and self._deadman.phase is DeadmanPhase.MUST_RELEASE:
            driver.request_control()
        text, details = self._state(stick)
        self._report(text, details)
        return True

    def leave(self) -> None:
        """Stop the robot and release control."""
        self._deadman.require_release()
        self._driver.release_control()

    def lost(self, why: str, seconds: float) -> None:
        """Report it. The robot stops by itself."""
        self._deadman.require_release()
        self._report(f"{why}; again in {seconds:.1f} s", "")

    def _press(self, state: GamepadState | None) -> None:
        """Act on buttons that were pressed since the last reading."""
        pressed = (False, False) if state is None else (state.stop, state.back)
        before, self._pressed = self._pressed, pressed
        if pressed[0] and not before[0]:
            self._deadman.require_release()
            self._driver.stop()
        if pressed[1] and not before[1]:
            self._deadman.require_release()
            self._driver.release_control()

    def _drive(self, stick: Stick, now: float) -> None:
        stands = stick == CENTERED and self._last != CENTERED
        self._last = stick
        if stands or now - self._sent >= COMMAND_SECONDS:
            self._sent = now
            self._driver.drive(self._command(stick))

    def _command(self, stick: Stick) -> VelocityCommand:
        top = self._wanted.within(self._driver.limits)
        return VelocityCommand(stick.ahead * top.speed, stick.left * top.turn)

    def _state(self, stick: Stick | None) -> tuple[str, str]:
        driver, phase = self._driver, self._deadman.phase
        words = phase.value
        if phase is DeadmanPhase.NO_GAMEPAD and self._pad.problem:
            words = self._pad.problem
        elif phase is DeadmanPhase.READY and not driver.in_control:
            words = "press the button to take control"
        elif phase is DeadmanPhase.MUST_RELEASE and driver.in_control:
            words = f"you have control: {phase.value}"
        for also in (
            driver.blocked_by,
            driver.refusal,
            "" if self._stop.done else self._stop.text,
            driver.requested_by and f"{driver.requested_by} asks for control",
        ):
            if also:
                words += f" ({also})"
        if driver.unresponsive:
            words += " (the robot does not answer)"
        moving = ""
        if stick is not None:
            command = self._command(stick)
            moving = f"{command.speed:+.2f} m/s {command.turn:+.2f} rad/s"
        if driver.round_trip is not None:
            moving += f"  round trip {driver.round_trip * 1000:.0f} ms"
        return words, moving.strip()


def _layout(axes: tuple[int, int] | None, buttons: tuple[int, int, int] | None) -> ButtonLayout | None:
    if axes is None and buttons is None:
        return None
    if axes is None or buttons is None:
        raise click.UsageError("--axes and --buttons describe a gamepad together: give both")
    (ahead, left), (hold, stop, back) = axes, buttons
    return ButtonLayout(ahead, left, hold, stop, back)


@click.command(cls=OutputCommand, context_settings={"help_option_names": ["-h", "--help"]})
@driving
@click.option(
    "--dead",
    type=Number(0.0, 0.9),
    default=StickCurve().dead,
    show_default=True,
    help="Deadzone of the stick, 0 to 0.9.",
)
@click.option(
    "--expo",
    type=Number(0.0, 1.0),
    default=StickCurve().expo,
    show_default=True,
    help="Response curve: 0 is linear, 1 is fine near the centre.",
)
@click.option(
    "--axes",
    type=(int, int),
    metavar="AHEAD LEFT",
    help="Axes of a pad that SDL does not know; such a pad drives only with --axes and --buttons.",
)
@click.option(
    "--buttons",
    type=(int, int, int),
    metavar="HOLD STOP BACK",
    help="Buttons of a pad that SDL does not know. The program shows the numbers of pressed buttons.",
)
def main(
    url: str,
    topic: str,
    speed: float,
    turn: float,
    dead: float,
    expo: float,
    axes: tuple[int, int] | None,
    buttons: tuple[int, int, int] | None,
) -> None:
    """Drive the robot at URL (ws://relay/robots/NAME) by a gamepad.

    The button on the right shoulder takes control when it is pressed first; from then on the robot moves while it is
    held; the left stick steers. B stops the robot until it is resumed. BACK releases control.

    The access token is read from SWITCHBOARD_TOKEN. SIGINT and SIGTERM end the program.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.joystick $ROBOT
      python -m robot_client.apps.joystick $ROBOT --speed 0.5 --expo 0.7
      python -m robot_client.apps.joystick $ROBOT --axes 1 0 --buttons 7 2 8
    """
    exit_signal = ExitSignal()
    gamepads = Gamepads(_layout(axes, buttons))
    status = StatusLine(sys.stdout, time.monotonic)
    program = Joystick(
        gamepads, Deadman(StickCurve(dead, expo)), topic, MaximumSpeeds(speed, turn), status.show
    )
    with errors_as_click():
        run_connected(url, program, exit_signal)
    status.finish("ended")


if __name__ == "__main__":
    main()
