# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Lifecycle (managed) nodes that load weights, and the model cards of these weights."""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_msgs.msg import String
from tap_ros.base.errors import WeightsError
from tap_ros.base.text import escaped
from tap_ros.ros.calls import log_error
from tap_ros.ros.topics import LATCHED
from tap_ros.weights.weights import stored_digest

MAX_CARD_BYTES = 2**18


class LifecycleBase(LifecycleNode):
    """
    Loads its weights in the transition configure, and works while it is active.

    Heartbeat, diagnostics, topics and services exist in every state, so that a request is refused
    with the reason. The model cards of the weights are published on <node>/model_card. A subclass
    implements `load` and its like, and calls autostart('configure') and autostart('activate') in
    its constructor; weights that cannot be used are fatal then. The parameter weights can be
    changed while the node is unconfigured.

    :param options: of rclpy's Node.
    :ivar active: whether the node works.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.active = False
        self._failure: Exception | None = None  # of the last transition
        self._starting = False  # a failure of autostart is raised, and logged by run.main
        self._loaded = self._card = ''
        self._cards = self.create_publisher(String, '~/model_card', LATCHED)
        self.add_on_set_parameters_callback(self._check_weights)
        served = {service.srv_type: service for service in self.services}
        self._get_state: Callable[..., Any] = served[GetState].callback
        served[ChangeState].callback = self._answering(served[ChangeState].callback)

    # What a subclass implements

    @abstractmethod
    def load(self) -> str:
        """
        Load the weights; return what the node works with, for the log.

        :raises TapError: when they cannot be used.
        """

    @abstractmethod
    def unload(self) -> None:
        """Release the weights."""

    @abstractmethod
    def files(self) -> list[Path]:
        """Return the files of the weights."""

    def resume(self) -> None:
        """
        Begin to work.

        :raises TapError: when that is not possible now.
        """

    def pause(self) -> None:
        """End the work in progress."""

    # For subclasses

    def autostart(self, transition: str) -> None:
        """
        Trigger a transition if the parameter autostart is set.

        :param transition: 'configure' or 'activate'.
        :raises Exception: why the transition failed.
        """
        if not self.get_parameter('autostart').value:
            if transition == 'activate':
                self.get_logger().info(f'waiting: {self.why_not()}')
            return
        self._starting = True
        done = (self.trigger_configure if transition == 'configure' else self.trigger_activate)()
        self._starting = False
        if done != TransitionCallbackReturn.SUCCESS:
            assert self._failure is not None
            raise self._failure

    def why_not(self) -> str:
        """Return why the node does not work and the remedy; '' while it is active."""
        if self.active:
            return ''
        state, command = self._state, f'ros2 lifecycle set {self.get_fully_qualified_name()}'
        return {
            'finalized': 'the node is shut down; start it again',
            'inactive': f'the node is inactive; activate it: {command} activate',
            'unconfigured': f'the node has no weights yet; {command} configure, then activate',
        }.get(state, f'the node is {state}; ask again')

    # Transitions

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the weights."""
        def load() -> None:
            card = '\n'.join(map(model_card, self.files()))
            self._loaded, self._card = self.load(), card

        return self._try('configure', load)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""
        def begin() -> None:
            self._cards.publish(String(data=self._card))
            self.resume()
            self.active = True  # last: nothing may fail after it
            self.get_logger().info(f'ready: {self._loaded}')

        return self._try('activate', begin)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the work in progress; a failure is logged, and the node is inactive anyway."""
        if self.active:
            self.active = False
            self._try('deactivate', self.pause)
        self.get_logger().info('inactive')
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release the weights."""
        return self._try('cleanup', self.unload)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the work in progress and release the weights, for good."""
        self.on_deactivate(state)
        return self._try('shutdown', self.unload)

    def _try(self, transition: str, do: Callable[[], object]) -> TransitionCallbackReturn:
        """Perform a transition; when it fails, the node keeps its state."""
        try:
            do()
        except Exception as error:
            self._failure = error
            if not self._starting:
                log_error(self, transition, error)
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _answering(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Wrap change_state: rclpy raises, and answers nothing, for a transition not available."""
        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except RuntimeError:
                wanted = escaped(request.transition.label or request.transition.id, 40)
                self.get_logger().warning(
                    f'change_state: a node that is {self._state} has no transition {wanted}')
                response.success = False
                return response

        return answer

    @property
    def _state(self) -> str:
        """Return the label of the present state."""
        return self._get_state(None, GetState.Response()).current_state.label

    def _check_weights(self, parameters: Iterable[Parameter]) -> SetParametersResult:
        """Refuse other weights unless the node is unconfigured."""
        same = all(one.name != 'weights' or not self.has_parameter('weights')
                   or one.value == self.get_parameter('weights').value for one in parameters)
        if same or self._state in ('unconfigured', 'finalized'):
            return SetParametersResult(successful=True)
        steps = ['deactivate'] * self.active + ['cleanup']
        return SetParametersResult(successful=False, reason=(
            'weights cannot be changed while some are loaded; first: '
            + ', then '.join(f'ros2 lifecycle set {self.get_fully_qualified_name()} {step}'
                             for step in steps)))


def model_card(weights: Path) -> str:
    """Return the model card beside a file of weights, and a line with the file's digest."""
    name = escaped(weights.name)
    text = f'# {name}\n\nNo model card is beside this file.\n'
    card = weights.with_suffix('.md')
    with suppress(OSError, ValueError):  # ValueError: it is no text
        if card.is_file() and card.stat().st_size <= MAX_CARD_BYTES:
            text = card.read_text(encoding='utf-8')
    digest = 'unknown'
    with suppress(WeightsError):  # loading raises it
        digest = stored_digest(weights)
    return f'{text.rstrip()}\n\nLoaded: `{name}`, SHA-256 of its content `{digest}`.\n'
