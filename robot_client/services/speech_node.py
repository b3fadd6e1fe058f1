"""ROS node of the service ``speech``."""

from __future__ import annotations

from typing import Any

from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger

from relay_protocol.errors import Refused
from robot_client.services.health import ServiceFinding
from robot_client.services.node_runner import LATCHED
from robot_client.services.speech import MAX_WAITING, Output, SpeechQueue, SpeechStatus, SpeechSynthesizer


class Speech:
    """Speaks the texts of the topic ``say``."""

    def __init__(self, node: Any, voice: SpeechSynthesizer, output: Output) -> None:
        self._node = node
        self._speaking = node.create_publisher(Bool, "speaking", LATCHED)
        self._completed = node.create_publisher(String, "said", MAX_WAITING)
        self._speaking.publish(Bool(data=False))
        self._queue = SpeechQueue(voice, output, self._publish_status)
        node.create_subscription(String, "say", self._on_text, 2 * MAX_WAITING)
        node.create_service(Trigger, "say/cancel", self._cancel)

    def finding(self) -> ServiceFinding:
        """State of the speech."""
        return self._queue.finding()

    def close(self) -> None:
        """Stop speaking."""
        self._queue.close()

    def _on_text(self, message: String) -> None:
        try:
            self._queue.add(message.data)
        except Refused as error:
            self._node.get_logger().warning(str(error))

    def _cancel(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        cancelled = self._queue.cancel()
        response.success = True
        response.message = f"{cancelled} texts cancelled" if cancelled else "no text was waiting"
        return response

    def _publish_status(self, status: SpeechStatus) -> None:
        """Runs in the speech thread; publishers are thread-safe."""
        self._speaking.publish(Bool(data=status.speaking))
        if status.completed is not None:
            self._completed.publish(String(data=status.completed))
