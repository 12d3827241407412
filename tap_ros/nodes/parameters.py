# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Node parameters with a description and a range, refused with a reason when wrong."""

from collections.abc import Iterable, Sequence
from typing import Any, TYPE_CHECKING

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from tap_ros.errors import ConfigError

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.parameter import Parameter


class Parameters:
    """
    The parameters of one node: declare each once, then read them by name.

    :param node: rclpy Node.
    """

    def __init__(self, node: 'Node') -> None:
        self._node = node
        self._choices: dict[str, tuple[str, ...]] = {}
        node.add_on_set_parameters_callback(self._check_choices)

    def __getitem__(self, name: str) -> Any:
        """Return the present value."""
        return self._node.get_parameter(name).value

    def declare(self, name: str, default: Any, description: str, low: float | None = None,
                high: float | None = None, choices: Sequence[str] | None = None,
                read_only: bool = True) -> Any:
        """
        Declare one parameter and return its value.

        :param name: name of the parameter.
        :param default: its value unless one is given at the start; also sets the type.
        :param description: one sentence with the unit.
        :param low: smallest value of a number; goes with `high`.
        :param high: largest value of a number.
        :param choices: the only values of a string.
        :param read_only: False if a running node heeds a change.
        :return: the value.
        :raises ConfigError: when the value given at the start is of another type or out of range.
        """
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        if low is not None and high is not None and isinstance(default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))]
        elif low is not None:
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        if choices is not None:
            self._choices[name] = tuple(choices)
            descriptor.additional_constraints = 'one of: ' + ', '.join(choices)
        try:
            return self._node.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            reason = str(error).split('Reason: ')[-1].removesuffix(f': {name}')
            raise ConfigError(
                f'parameter {name}: {reason}. {description} Default: {default!r}') from error

    def _check_choices(self, parameters: Iterable['Parameter']) -> SetParametersResult:
        """Refuse strings that are none of the choices."""
        for parameter in parameters:
            choices = self._choices.get(parameter.name)
            if choices is not None and parameter.value not in choices:
                return SetParametersResult(
                    successful=False,
                    reason=f'{parameter.name} is {parameter.value!r}; '
                           f'valid choices: {", ".join(choices)}')
        return SetParametersResult(successful=True)


def declare_device(parameters: Parameters) -> None:
    """Declare the parameter device."""
    parameters.declare('device', 'cpu', 'Where the network runs, as torch names it: cpu, cuda.',
                       choices=['cpu', 'cuda'])


def check_device(device: str) -> None:
    """
    Raise ConfigError for a device that is not available.

    :param device: 'cpu' or 'cuda'.
    """
    import torch  # here, since it takes seconds, and not every node has a device
    if device == 'cuda' and not torch.cuda.is_available():
        raise ConfigError('parameter device: torch finds no GPU for cuda; valid here: cpu')
