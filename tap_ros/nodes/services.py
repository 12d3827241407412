# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services that answer whatever happens, at once or later, and errors in the log."""

from collections.abc import Callable
import traceback
from typing import Any

from rclpy.node import Node
from rclpy.service import Service
from tap_ros.errors import TapError
from tap_ros.nodes.topics import SERVICE_QOS
from tap_ros.text import escaped


def log_error(node: Node, what: str, error: BaseException) -> None:
    """Log an error in one line; an unexpected one, that is no TapError, with its traceback."""
    if isinstance(error, TapError):
        node.get_logger().error(f'{what}: {escaped(error, 1000)}')
        return
    for line in ''.join(traceback.format_exception(error)).splitlines():
        node.get_logger().error(f'{what}: {escaped(line)}')


def reason(node: Node, what: str, error: Exception) -> str:
    """Return why something failed, for whoever asked for it; log what was not expected."""
    if isinstance(error, TapError):
        return str(error)
    log_error(node, what, error)
    return f'internal error: {type(error).__name__}: {escaped(error)}'


def answering(node: Node, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Wrap the callback of a service so that any exception becomes a refusal with its reason."""
    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:
            return type(response)(success=False, message=reason(node, 'service', error))

    return answer


def create_deferred_service(node: Node, service_type: type, name: str,
                            take: Callable[[Any, Callable[[Any], object]], object]) -> Service:
    """
    Offer a service whose responses may be sent later, by any thread.

    :param take: called with each request and a function that sends its response; that function
        has to be called exactly once.
    :return: the rclpy Service.
    """
    # An executor hands what the callback returns to send_response, together with the client's id.
    service = node.create_service(
        service_type, name, lambda request, response: request, qos_profile=SERVICE_QOS)
    send = service.send_response

    def take_request(request: Any, header: Any) -> None:
        take(request, lambda response: send(response, header))

    service.send_response = take_request  # type: ignore[method-assign,assignment]
    return service


def take_pending_requests(service: Service) -> None:
    """Take the requests of a deferred service that wait after its executor has ended."""
    with service.handle:
        while True:
            request, header = service.handle.service_take_request(
                service.srv_type.Request)  # type: ignore[attr-defined]
            if header is None:
                return
            service.send_response(request, header)
