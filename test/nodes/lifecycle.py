# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The services by which the states of a lifecycle node are changed."""

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from tap_ros.nodes.calls import call


class Lifecycle:
    """States and parameters of a node, asked by another one."""

    def __init__(self, client, name):
        self._change = client.create_client(ChangeState, f'{name}/change_state')
        self._get = client.create_client(GetState, f'{name}/get_state')
        self._set = client.create_client(SetParameters, f'{name}/set_parameters')
        for each in (self._change, self._get, self._set):
            assert each.wait_for_service(60)

    def now(self):
        """Return the id of the state."""
        return call(self._get, GetState.Request(), 30).current_state.id

    def to(self, transition):
        """Ask for a transition, by name or id, and tell whether it was done."""
        if isinstance(transition, str):
            transition = getattr(Transition, f'TRANSITION_{transition.upper()}')
        request = ChangeState.Request(transition=Transition(id=transition))
        return call(self._change, request, 60).success

    def set(self, name, value):
        """Set a parameter; return why it was not set, '' if it was."""
        message = ParameterMessage(
            name=name, value=Parameter(name, value=str(value)).get_parameter_value())
        result, = call(self._set, SetParameters.Request(parameters=[message]), 60).results
        assert result.successful == (not result.reason)
        return result.reason
