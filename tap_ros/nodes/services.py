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


def internal_error(error: Exception) -> str:
    """Return the message of a response to an unexpected error."""
    return f'internal error: {type(error).__name__}: {escaped(error)}'


def refusal(kind: type, reason: str, error: Exception) -> Any:
    """Return a response of this type, with the fields success and message, that refuses."""
    return kind(success=False, message=reason)


def answering(node: Node, callback: Callable[[Any, Any], Any],
              refuse: Callable[[type, str, Exception], Any] = refusal
              ) -> Callable[[Any, Any], Any]:
    """
    Wrap the callback of a service so that any exception becomes a response.

    :param node: rclpy Node, for its log.
    :param refuse: makes a response of a type, a reason and the exception.
    """
    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except TapError as error:
            return refuse(type(response), str(error), error)
        except Exception as error:
            log_error(node, 'service', error)
            return refuse(type(response), internal_error(error), error)

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
