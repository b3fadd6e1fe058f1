"""Pipes, as the HTTP API takes them and answers with them."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from relay_protocol.limits import NAME

PipeName = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_-]{0,62}\Z")]
Path = Annotated[str, Meta(min_length=1, max_length=NAME)]
RobotText = Annotated[str, Meta(max_length=NAME)]
ProgramText = Annotated[str, Meta(pattern=r"^([A-Za-z]\w{0,63})?\Z")]

PipeState = Literal["running", "waiting", "refused", "stopped"]

MAX_FIELDS = 32
MAX_TABLE = 256


class PipeEnd(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One end of a pipe: a topic, a service or an action of a robot, or a port or a function of a program.

    :param robot: name of a robot; `name@realm` for one that the owner reaches by an account in another realm
    :param topic: of the robot
    :param type: of the topic or service, such as `std_msgs/msg/String`; without it, as the robot says. Needed for a
        topic that no node has yet
    :param service: of the robot, instead of a topic. As the target it is called for each message, with the fields as
        its arguments. As the source its replies are carried: with a `rate` it is called that often, without arguments;
        without one, the replies to calls by the owner's other pipes
    :param action: of the robot, instead of a topic. As the target each message sends a goal, with the fields in it; one
        goal is executed at a time. As the source the results of goals by the owner's other pipes are carried
    :param program: of the owner, connected by ICPI, instead of a robot. The other end is at a robot
    :param port: of the program. As the target it is set to each message. As the source its value is carried: with a
        `rate` it is asked for that often; without one, whenever the program publishes it. A value that is no object is
        the field `data`
    :param function: of the program, instead of a port: as a service, with the fields in their order as its arguments
    """

    robot: RobotText = ""
    topic: Annotated[str, Meta(pattern=r"^(/|\Z)", max_length=NAME)] = ""
    type: Annotated[str, Meta(max_length=NAME)] = ""
    service: Annotated[str, Meta(pattern=r"^(/|\Z)", max_length=NAME)] = ""

    action: Annotated[str, Meta(pattern=r"^(/|\Z)", max_length=NAME)] = ""
    program: ProgramText = ""
    port: ProgramText = ""
    function: ProgramText = ""

    def __post_init__(self) -> None:
        of_robot, of_program = (
            (self.topic, self.service, self.action),
            (self.port, self.function, self.program),
        )
        if self.program:
            good = bool(self.port) != bool(self.function) and not (self.robot or self.type or any(of_robot))
        else:
            good = bool(self.robot) and sum(map(bool, of_robot)) == 1 and not any(of_program)
        if not good:
            raise ValueError(
                "an end of a pipe has a 'robot' and a 'topic', a 'service' or an 'action', "
                "or a 'program' and a 'port' or a 'function'"
            )

    @property
    def name(self) -> str:
        """Of the topic, service, action, port or function."""
        return self.topic or self.service or self.action or self.port or self.function

    @property
    def address(self) -> str:
        """As users write it."""
        if self.program:
            return f"programs/{self.program}/{'ports' if self.port else 'functions'}/{self.name}"
        return f"{self.robot}{self.name}{'()' if self.service else '{}' if self.action else ''}"


class FieldMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One value that is carried from a field to a field.

    :param source: field of the source's messages or replies, such as `axes[0]` or `twist.linear.x`
    :param target: field of the target's messages or arguments, without indices
    :param scale: a number is multiplied by it
    :param offset: and this is added
    :param table: values of the target by values of the source as text, such as `{"true": "open", "false": "closed"}`;
        then scale and offset do not apply, and a value that is not in the table is not carried
    """

    source: Path
    target: Annotated[
        str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z][A-Za-z0-9_]*)*\Z", max_length=NAME)
    ]
    scale: float = 1.0
    offset: float = 0.0
    table: Annotated[dict[str, bool | int | float | str], Meta(max_length=MAX_TABLE)] = {}


class PipeSettings(msgspec.Struct, frozen=True):
    """The settings of a pipe, as they are stored.

    :param fields: values to carry in one message; without any, whole messages are carried, and a service is called
        without arguments
    :param rate: most messages a second, the newest ones; 0: all
    """

    source: PipeEnd
    target: PipeEnd
    fields: Annotated[list[FieldMapping], Meta(max_length=MAX_FIELDS)] = []
    rate: Annotated[float, Meta(ge=0, le=10_000)] = 0.0


class NewPipe(PipeSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A pipe to add.

    :param name: unique in the realm of its owner
    :param start: whether it begins at once
    """

    name: PipeName
    start: bool = True


class PipeStatus(PipeSettings, frozen=True, kw_only=True):
    """A pipe and its state. Figures count from its latest start.

    :param owner: the user by whose rights it runs
    :param state: `waiting` goes on by itself; `refused` and `stopped` need a start
    :param why: what it waits for, why it was refused or ended, or why the latest message was not carried
    :param moves: whether it moves a robot, so that it takes control like a client
    :param messages: carried; to a service, calls that it answered
    :param drops: not carried: the target was not ready, a value did not fit, a service failed, or was still at work
        when a newer message came
    :param latency_ms: mean time from the arrival at the relay to the sending, or to the reply of a service, of recent
        messages, without waiting for the rate limit; null before the first
    :param encoded: of `messages`, those that were carried as CDR, without being decoded
    """

    name: str
    owner: str
    state: PipeState
    why: str
    moves: bool
    messages: int
    drops: int
    latency_ms: float | None
    encoded: int = 0


class PipeList(msgspec.Struct, frozen=True):
    """The caller's pipes; for an administrator of a realm, all of the realm."""

    pipes: list[PipeStatus]
