# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A service whose answers are sent when they are ready, by any thread."""

from tap_ros.nodes.topics import SERVICE_QOS


def create_late_service(node, service_type, name, take):
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
    service.send_response = lambda request, header: take(
        request, lambda response: send(response, header))
    return service


def take_waiting(service):
    """
    Take the requests that wait in DDS where no executor does so any more.

    :param service: what create_late_service returned.
    """
    with service.handle:
        while True:
            request, header = service.handle.service_take_request(service.srv_type.Request)
            if header is None:
                return
            service.send_response(request, header)
