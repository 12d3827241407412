# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A service whose answers are sent when they are ready, by any thread."""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING

from tap_ros.nodes.topics import SERVICE_QOS

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.service import Service


def create_late_service(node: 'Node', service_type: type, name: str,
                        take: Callable[[Any, Callable[[Any], object]], object]) -> 'Service':
    """
    Offer a service that keeps no thread of the executor waiting.

    :param node: rclpy Node.
    :param service_type: type of the service.
    :param name: its name.
    :param take: called with each request and a function that sends a response; it may call that
        later, from another thread, and must see that it is called once.
    :return: the rclpy Service.
    """
    # An executor hands what the callback returns to send_response, together with whom it is for.
    service = node.create_service(
        service_type, name, lambda request, response: request, qos_profile=SERVICE_QOS)
    send = service.send_response

    def take_request(request: Any, header: Any) -> None:
        take(request, lambda response: send(response, header))

    service.send_response = take_request  # type: ignore[method-assign,assignment]
    return service


def take_waiting(service: 'Service') -> None:
    """
    Take the requests that wait in DDS where no executor does so any more.

    :param service: what create_late_service returned.
    """
    with service.handle:
        while True:
            request, header = service.handle.service_take_request(
                service.srv_type.Request)  # type: ignore[attr-defined]
            if header is None:
                return
            service.send_response(request, header)
