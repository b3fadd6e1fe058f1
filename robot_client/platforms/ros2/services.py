"""Services that the ROS 2 platform offers, answered whenever the answer comes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from rclpy.serialization import serialize_message

from robot_client.platforms.base import OnCall
from robot_client.platforms.ros2.executor import ReactorBridge, Spinner
from robot_client.platforms.ros2.types import Interface, parse


class _PendingResponse(NamedTuple):
    """Stands for a response until there is one."""

    request: Any


class RosService:
    """One service.

    An executor calls a service's callback and gives what it returns to ``send_response``, with the header of the
    request. A callback that waits would hold the executor up, and a coroutine that waits keeps the single-threaded one
    turning at full speed. So ours returns at once, and ``send_response`` of this service keeps the header instead
    of sending; executors of all releases find both on the service itself.

    :param spinner: of the node it is on
    """

    def __init__(
        self,
        spinner: Spinner,
        hop: ReactorBridge,
        interface: Interface,
        on_call: OnCall,
        on_close: Callable[[RosService], None],
    ) -> None:
        self.name, self.type, self._kind = interface
        self._spinner = spinner
        self._hop = hop
        self._on_call: OnCall | None = on_call
        self._on_close = on_close
        self._made = threading.Lock()
        with self._made:
            self._service = spinner.node.create_service(self._kind, self.name, self._called)
            self._send = self._service.send_response
            self._service.send_response = self._responded

    def close(self) -> None:
        """Offer it no more."""
        if self._on_call is None:
            return
        self._on_call = None
        self._spinner.do(self._spinner.node.destroy_service, self._service)
        self._on_close(self)

    # --- in the executor's thread

    def _called(self, request: Any, _: Any) -> _PendingResponse:
        with self._made:  # the first call may come before send_response is ours
            return _PendingResponse(request)

    def _responded(self, asked: _PendingResponse, header: Any) -> None:
        body = bytes(serialize_message(asked.request))
        self._hop.put(self._arrived, (body, header), len(body))

    # --- in the reactor's thread

    def _arrived(self, call: tuple[bytes, Any]) -> None:
        body, header = call
        if self._on_call is not None:
            self._on_call(body, partial(self._answer, header))

    def _answer(self, header: Any, body: bytes) -> None:
        response = parse(body, self._kind.Response, f"response of type {self.type}")
        if self._on_call is not None:
            self._spinner.do(self._send, response, header)
