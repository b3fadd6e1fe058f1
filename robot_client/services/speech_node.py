"""The service ``speech`` in the graph."""

from __future__ import annotations

from typing import Any

from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger

from relay_protocol.errors import Refused
from robot_client.services.health import ServiceFinding
from robot_client.services.node_runner import LATCHED
from robot_client.services.speech import WAITING, Output, SpeechQueue, SpeechStatus, SpeechSynthesizer


class Speech:
    """Says what comes on the topic ``say``."""

    def __init__(self, node: Any, voice: SpeechSynthesizer, output: Output) -> None:
        self._node = node
        self._speaking = node.create_publisher(Bool, "speaking", LATCHED)
        self._said = node.create_publisher(String, "said", WAITING)
        self._speaking.publish(Bool(data=False))
        self._speaker = SpeechQueue(voice, output, self._tell)
        node.create_subscription(String, "say", self._say, 2 * WAITING)
        node.create_service(Trigger, "say/hush", self._hush)

    def finding(self) -> ServiceFinding:
        """What it does."""
        return self._speaker.finding()

    def close(self) -> None:
        """Be silent."""
        self._speaker.close()

    def _say(self, message: String) -> None:
        try:
            self._speaker.say(message.data)
        except Refused as error:
            self._node.get_logger().warning(str(error))

    def _hush(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        forgotten = self._speaker.hush()
        response.success = True
        response.message = f"{forgotten} texts are not said" if forgotten else "nothing was to be said"
        return response

    def _tell(self, told: SpeechStatus) -> None:
        """In the speaker's thread: publishers may be used in any."""
        self._speaking.publish(Bool(data=told.speaking))
        if told.said is not None:
            self._said.publish(String(data=told.said))
