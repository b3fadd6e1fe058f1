"""Pipes between endpoints of a robot in memory, with a real database."""

from __future__ import annotations

from typing import Any

from twisted.internet import reactor
from twisted.internet.task import deferLater

from relay_protocol import link
from relay_server.cluster.homes import RobotHomes, SingleHome
from relay_server.icpi.programs import ProgramRegistry
from relay_server.pipes import service as module
from relay_server.pipes.schemas import NewPipe, PipeEnd
from relay_server.pipes.service import PipeService, PipeUser, pipe_user
from tests.worlds.relay import STRING
from tests.worlds.session_manager import HERE, SessionsWorld


class PipeScene:
    """ann's robot rover, and the service."""

    def __init__(self, front: SessionsWorld) -> None:
        self.front = front
        self.world = front.world
        self.programs = ProgramRegistry()
        self.service = self.new_service()

    def new_service(self, homes: RobotHomes | None = None) -> PipeService:
        """The service of a relay that starts now."""
        return PipeService(
            self.world.clock,
            self.front.service,
            self.front.store,
            self.front.bus,
            self.programs,
            clock_ns=self.world.now_ns,
            wall=self.front.wall,
            homes=homes or SingleHome(),
        )

    async def begin(self) -> PipeUser:
        """The robot is online; returns ann."""
        ann, _ = await self.front.logged_in()
        self.world.robot_comes()
        await self.service.start()
        return pipe_user(ann, HERE)

    async def begin_with(
        self, graph: link.Graph, motion: link.MotionPolicy | None, *pipes: NewPipe
    ) -> PipeUser:
        """These pipes of ann run.

        :param graph: of the robot, in addition
        :param motion: ``None``: nothing of it moves the robot
        """
        ann = await self.begin()
        self.world.registry.graph(self.world.robot, graph)
        if motion is not None:
            self.world.registry.described(self.world.robot, link.Describe(motion=motion))
        for each in pipes:
            await self.service.add(ann, each)
        self.joins()
        return ann

    def joins(self) -> None:
        """The robot has joined the channel, and answers all requests."""
        self.world.robot_joins()
        self.world.define()
        self.answers()

    def answers(self, times: int = 5) -> None:
        """The robot confirms advertisements and subscriptions, and the service checks again, so many times."""
        for _ in range(times):
            self.world.define()
            for made in self.world.link.take(link.Advertise):
                self.world.channel.message(
                    link.Advertised(number=made.number, topic=made.topic, type=made.type, encoding="cdr")
                )
            self.passes(module.CHECK_SECONDS)
            for made in self.world.link.all(link.Subscribe):
                self.world.subscribed(made.number, made.type or STRING)

    def passes(self, seconds: float) -> None:
        self.world.clock.advance(seconds)

    def pongs(self) -> None:
        """The robot answers the pings of a pipe that moves it."""
        for _ in range(2):
            self.passes(module.PING_SECONDS)
            for ping in self.world.link.pings:
                if not ping.called:
                    ping.callback(0.001)

    def sends(self, body: bytes, stamp: int | None = None) -> None:
        """The robot sends a message of the source.

        :param stamp: nanoseconds of its clock, if not now
        """
        number = self.world.link.all(link.Subscribe)[-1].number
        self.world.channel.sample(number, body, self.world.now_ns() if stamp is None else stamp)

    @property
    def carried(self) -> list[bytes]:
        """Messages that the robot got."""
        return [body for _, _, body in self.world.link.samples]

    async def state(self, user: PipeUser, name: str = "copy") -> tuple[str, str]:
        found = await self.service.pipe(user, name)
        return found.state, found.why


def copy(
    name: str = "copy", source: str = "/chatter", target: str = "/copy", type: str = "", **more: Any
) -> NewPipe:
    return NewPipe(name=name, source=PipeEnd("rover", source), target=PipeEnd("rover", target, type), **more)


async def settled(scene: PipeScene) -> None:
    """Waits until the database has written all pending writes, and their consequences."""
    for _ in range(5):
        await scene.front.store.write(lambda session: None)
        await deferLater(reactor, 0.02, lambda: None)  # type: ignore[arg-type]
