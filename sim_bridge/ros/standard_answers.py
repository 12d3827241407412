# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the services of simulation_interfaces are offered and answered."""

from collections.abc import Callable, Mapping
import re
from typing import Any, TYPE_CHECKING

from simulation_interfaces.msg import Result
from tap_ros.errors import TapError
from tap_ros.nodes.services import answering
from tap_ros.nodes.topics import SERVICE_QOS

if TYPE_CHECKING:
    from rclpy.node import Node

Answer = Callable[[Any, Any], None]  # fills the response of a request, or raises


class Refused(TapError):
    """A request is not done; with the code for its Result."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


def offer(node: 'Node', answers: Mapping[type, Answer]) -> None:
    """
    Offer services under the name of a node.

    :param node: rclpy Node.
    :param answers: service type -> what fills a response, but for its Result, which is by what
        it raises: Refused with its code, any other TapError as a failed operation.
    """
    for kind, answer in answers.items():
        node.create_service(kind, name_of(kind), answering(node, _responding(answer), refusal),
                            qos_profile=SERVICE_QOS)


def name_of(kind: type) -> str:
    """Return the name of a service under that of its node, as other simulators call it."""
    return '~/' + re.sub('(?<=[a-z])(?=[A-Z])', '_', kind.__name__).lower()


def refusal(kind: type, message: str, code: int = Result.RESULT_OPERATION_FAILED) -> Any:
    """Return a response of this type with a Result alone."""
    return kind(result=Result(result=code, error_message=message))


def _responding(answer: Answer) -> Callable[[Any, Any], Any]:
    """Let a function fill a response; its Result is by what the function raises."""
    def respond(request: Any, response: Any) -> Any:
        try:
            answer(request, response)
        except Refused as error:
            return refusal(type(response), str(error), error.code)
        except TapError as error:
            return refusal(type(response), str(error))
        if hasattr(response, 'result'):  # all but GetSimulatorFeatures
            response.result.result = Result.RESULT_OK
        return response

    return respond
