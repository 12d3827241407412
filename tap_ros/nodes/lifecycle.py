# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Managed (lifecycle) nodes whose weights can be changed while they are inactive."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
import traceback
from typing import Any, ClassVar, TYPE_CHECKING

from rcl_interfaces.msg import SetParametersResult
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from std_msgs.msg import String
from tap_ros.errors import TapError
from tap_ros.nodes.model_card import describe_weights
from tap_ros.nodes.topics import LATCHED
from tap_ros.text import escaped, listing

if TYPE_CHECKING:
    from rclpy.parameter import Parameter
    from tap_ros.nodes.parameters import Parameters


def declare_autostart(parameters: 'Parameters') -> None:
    """Declare the parameter autostart of a managed node."""
    parameters.declare(
        'autostart', True,
        'Load the weights and be active at once; false: wait for the transitions configure and '
        'activate.')


class ManagedNode(LifecycleNode):
    """
    Loads its weights in the transition configure, and works while it is active.

    Heartbeat, diagnostics, topics and services are there in every state, so that who asks is told
    why nothing is done. What the weights are is published on <node>/model_card. A subclass defines
    what to load, and calls autostart('configure') and autostart('activate') while it is made;
    weights that cannot be used are fatal then.

    :cvar reloaded: names of the parameters that can be changed while the node is not active;
        unless it is unconfigured they are tried at once, and refused when they cannot be used.
    :ivar active: whether it works.
    """

    reloaded: ClassVar[tuple[str, ...]] = ()

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.active = False
        self._failure: Exception | None = None  # of the transition that was tried last
        self._starting = False  # by itself: a failure is raised, and logged by who starts nodes
        self._loaded: tuple[Any, str] | None = None  # for parameters that are about to change
        self._card = ''  # what the weights are
        self._cards = self.create_publisher(String, '~/model_card', LATCHED)
        # First, as rclpy calls the newest callback first: what others refuse is not loaded.
        self.add_on_set_parameters_callback(self._before_set)
        self.add_post_set_parameters_callback(self._after_set)
        self._service_change_state.callback = self._answering(self._service_change_state.callback)

    # What a subclass defines

    @abstractmethod
    def load(self, changed: Mapping[str, Any]) -> Any:
        """
        Load weights; the node goes on with those that it has.

        :param changed: {parameter: value} that are not set yet, of those in `reloaded`.
        :return: what `use` takes.
        :raises TapError: when they cannot be used.
        """

    @abstractmethod
    def use(self, loaded: Any) -> None:
        """Go on with what `load` returned."""

    @abstractmethod
    def unload(self) -> None:
        """Let go what `use` was given."""

    @abstractmethod
    def described(self) -> str:
        """Say what the node works with, for the log."""

    @abstractmethod
    def files(self, changed: Mapping[str, Any]) -> list[Path]:
        """Return the files of the weights; changed: as for load."""

    def resume(self) -> None:
        """
        Begin to work.

        :raises TapError: when that is not possible now.
        """

    def pause(self) -> None:
        """End what is being done."""

    # For subclasses

    def autostart(self, transition: str) -> None:
        """
        Do a transition, if the node is to start by itself.

        :param transition: 'configure' or 'activate'.
        :raises Exception: why it could not be done.
        """
        if not self.get_parameter('autostart').value:
            if transition == 'activate':
                self.get_logger().info(f'waiting: {self.why_not()}')
            return
        trigger = {'configure': self.trigger_configure, 'activate': self.trigger_activate}
        self._starting = True
        done = trigger[transition]()
        self._starting = False
        if done != TransitionCallbackReturn.SUCCESS:
            assert self._failure is not None
            raise self._failure

    def why_not(self) -> str:
        """Say why the node does not work and what to do; '' while it is active."""
        if self.active:
            return ''
        state, command = self._state(), f'ros2 lifecycle set {self.get_fully_qualified_name()}'
        if state == 'finalized':
            return 'the node is shut down; start it again'
        if state == 'inactive':
            return f'the node is inactive; activate it: {command} activate'
        if state == 'unconfigured':
            return f'the node has no weights yet; {command} configure, then activate'
        return f'the node is {state}; ask again'

    # Transitions

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the weights."""
        return self._try('configure', lambda: self._use(self._load({})))

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""
        def begin() -> None:
            ready = f'ready: {self.described()}'
            self._cards.publish(String(data=self._card))
            self.resume()
            self.active = True  # last: nothing may fail after it
            self.get_logger().info(ready)

        return self._try('activate', begin)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End what is being done, and do nothing more."""
        self._stop()
        self.get_logger().info('inactive; weights can be changed by parameters')
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the weights go."""
        return self._try('cleanup', self.unload)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End what is being done, and let the weights go, for good."""
        self._stop()
        return self._try('shutdown', self.unload)

    def _stop(self) -> None:
        """Do nothing more; what `pause` raises is logged, and the node is inactive anyway."""
        if not self.active:
            return
        self.active = False
        try:
            self.pause()
        except Exception as error:
            self._log(error, 'deactivate')

    def _load(self, changed: Mapping[str, Any]) -> tuple[Any, str]:
        """Load weights; return them and what they are, which a file may not be for long."""
        card = describe_weights(self.files(changed))
        return self.load(changed), card

    def _use(self, loaded: tuple[Any, str]) -> None:
        """Go on with what _load returned."""
        self.use(loaded[0])
        self._card = loaded[1]

    def _try(self, transition: str, do: Callable[[], object]) -> TransitionCallbackReturn:
        """Do what a transition does; when it fails, the node stays in the state that it has."""
        try:
            do()
        except Exception as error:
            self._failure = error
            if not self._starting:
                self._log(error, transition)
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _log(self, error: Exception, what: str) -> None:
        """Log why something failed; for what is no error of ours, with where it came from."""
        if isinstance(error, TapError):
            self.get_logger().error(f'{what}: {escaped(error, 1000)}')
        else:
            for line in ''.join(traceback.format_exception(error)).splitlines():
                self.get_logger().error(f'{what}: {escaped(line)}')

    def _answering(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Let the service answer where rclpy raises: when the state has no such transition."""
        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except rclpy_implementation.RCLError:
                wanted = escaped(request.transition.label or request.transition.id, 40)
                self.get_logger().warning(
                    f'change_state: a node that is {self._state()} has no transition {wanted}')
                response.success = False
                return response

        return answer

    def _state(self) -> str:
        """Return the label of the present state."""
        label: str = self._state_machine.current_state[1]
        return label

    # Parameters

    def _before_set(self, parameters: Iterable['Parameter']) -> SetParametersResult:
        """Try the weights that are to be used from now on."""
        self._loaded = None
        changed = {parameter.name: parameter.value for parameter in parameters
                   if parameter.name in self.reloaded}
        if not changed or self._state() in ('unconfigured', 'configuring', 'finalized'):
            return SetParametersResult(successful=True)
        if self.active:
            if all(self.get_parameter(name).value == value for name, value in changed.items()):
                return SetParametersResult(successful=True)
            return SetParametersResult(successful=False, reason=(
                f'{listing(changed)} cannot be changed while the node is active; deactivate it '
                f'first: ros2 lifecycle set {self.get_fully_qualified_name()} deactivate'))
        try:
            self._loaded = self._load(changed)
        except TapError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:
            self._log(error, 'parameters')
            return SetParametersResult(
                successful=False, reason=f'{type(error).__name__}: {escaped(error)}')
        return SetParametersResult(successful=True)

    def _after_set(self, parameters: Iterable['Parameter']) -> None:
        """Use what was tried."""
        if self._loaded is not None:
            loaded, self._loaded = self._loaded, None
            self._use(loaded)
            self.get_logger().info(f'loaded: {self.described()}')
