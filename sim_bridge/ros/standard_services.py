# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The services that simulators have in common (package simulation_interfaces), for sim_node."""

from collections.abc import Generator
import signal
import traceback
from typing import Any, TYPE_CHECKING

from rclpy.action import ActionServer, CancelResponse
from sim_bridge.ros.standard_answers import name_of, offer, Refused
from sim_bridge.ros.standard_entities import Entities
from sim_bridge.tasks.run_state import MAX_PERIODS, MAX_STEPS, RunState
from simulation_interfaces.action import SimulateSteps
from simulation_interfaces.msg import Result, SimulatorFeatures
from simulation_interfaces.srv import (
    GetSimulationState,
    GetSimulatorFeatures,
    ResetSimulation,
    SetSimulationState,
    StepSimulation,
)
from tap_ros.contract import CONTROL_PERIOD
from tap_ros.errors import TapError
from tap_ros.text import escaped

if TYPE_CHECKING:
    from rclpy.action.server import ServerGoalHandle
    from sim_bridge.ros.sim_node import SimNode

FEATURES = (
    'ENTITY_TAGS', 'ENTITY_BOUNDS', 'ENTITY_BOUNDS_BOX', 'ENTITY_CATEGORIES',
    'ENTITY_STATE_GETTING', 'ENTITY_STATE_SETTING', 'ENTITY_INFO_GETTING',
    'SIMULATION_RESET', 'SIMULATION_RESET_STATE', 'SIMULATION_STATE_GETTING',
    'SIMULATION_STATE_SETTING', 'SIMULATION_STATE_PAUSE', 'STEP_SIMULATION_SINGLE',
    'STEP_SIMULATION_MULTIPLE', 'STEP_SIMULATION_ACTION')
INFO = (f'A step is a control period of {CONTROL_PERIOD:g} s, in which the arm stands still: at '
        f'most {MAX_PERIODS} a StepSimulation, {MAX_STEPS} a SimulateSteps. The clock never goes '
        'back, also at a reset. Entities are the objects; the arm moves by commands alone.')


class StandardServices:
    """
    Offers the services and the action under the name of the node: sim_node/get_entities ...

    :param node: SimNode.
    """

    def __init__(self, node: 'SimNode') -> None:
        self._node = node
        self._stepping = False
        offer(node, {
            GetSimulatorFeatures: self._on_get_features, ResetSimulation: self._on_reset,
            GetSimulationState: self._on_get_state, StepSimulation: self._on_step,
            SetSimulationState: self._on_set_state, **Entities(node).answers})
        self._server = ActionServer(
            node, SimulateSteps, name_of(SimulateSteps), self._simulate_steps,
            cancel_callback=lambda _: CancelResponse.ACCEPT)

    def _on_get_features(self, _: Any, response: Any) -> None:
        response.features = SimulatorFeatures(
            features=[getattr(SimulatorFeatures, name) for name in FEATURES
                      if hasattr(SimulatorFeatures, name)],  # earlier versions lack some
            custom_info=INFO)

    def _on_reset(self, request: Any, response: Any) -> None:
        if request.scope in (ResetSimulation.Request.SCOPE_DEFAULT,
                             ResetSimulation.Request.SCOPE_ALL):
            self._node.restart()
        elif request.scope == ResetSimulation.Request.SCOPE_STATE:
            self._node.repeat()
        else:
            raise Refused(
                Result.RESULT_FEATURE_UNSUPPORTED,
                f'scope is {request.scope}; expected 0 or 255 (the first scene) or 2 (the present '
                'scene): the clock never goes back, and nothing can be spawned')

    def _on_get_state(self, _: Any, response: Any) -> None:
        response.state.state = int(self._node.state)

    def _on_set_state(self, request: Any, response: Any) -> None:
        state = request.state.state
        if state not in list(RunState):
            raise Refused(
                Result.RESULT_FEATURE_UNSUPPORTED, f'state is {state}; expected '
                + ', '.join(f'{known} ({known.name.lower()})' for known in RunState))
        if state == self._node.state:
            raise Refused(SetSimulationState.Response.ALREADY_IN_TARGET_STATE,
                          f'the simulation is {self._node.state.name.lower()} already')
        if state == RunState.STOPPED:
            self._node.set_state(RunState.PAUSED)  # whatever becomes of the reset
            try:
                self._node.restart()
            except TapError as error:
                raise Refused(
                    SetSimulationState.Response.STATE_TRANSITION_ERROR, str(error)) from error
        self._node.set_state(RunState(state))
        if state == RunState.QUITTING:
            self._node.get_logger().info('quitting: set_simulation_state asks for it')
            signal.raise_signal(signal.SIGTERM)  # which run_node heeds when this is answered

    def _on_step(self, request: Any, response: Any) -> None:
        self._check_steps(request.steps, MAX_PERIODS)
        for _ in range(request.steps):
            self._node.wait_period()

    def _check_steps(self, steps: int, most: int) -> None:
        """Refuse steps that cannot be made."""
        reason = ''
        if self._node.state is not RunState.PAUSED:
            reason = (f'the simulation is {self._node.state.name.lower()}; pause it first with '
                      'set_simulation_state, state 2')
        elif self._stepping:
            reason = 'simulate_steps is in progress; cancel it or wait for its end'
        elif not 1 <= steps <= most:
            reason = f'steps is {steps}; expected 1 to {most}'
        if reason:
            raise Refused(Result.RESULT_OPERATION_FAILED, reason)

    async def _simulate_steps(self, handle: 'ServerGoalHandle') -> SimulateSteps.Result:
        """Step, and do between two steps what else is asked of the node."""
        result = Result(result=Result.RESULT_OPERATION_FAILED)
        try:
            self._check_steps(handle.request.steps, MAX_STEPS)
            self._stepping = True
            try:
                result.error_message = await self._step(handle)
            finally:
                self._stepping = False
            if not result.error_message:
                result.result = Result.RESULT_OK
        except TapError as error:
            result.error_message = str(error)
        except Exception as error:
            self._node.get_logger().error(traceback.format_exc())
            result.error_message = f'internal error: {type(error).__name__}: {escaped(error)}'
        if result.result == Result.RESULT_OK:
            handle.succeed()
        elif handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        return SimulateSteps.Result(result=result)

    async def _step(self, handle: 'ServerGoalHandle') -> str:
        """Make the steps of a goal; return what ended it early, else an empty string."""
        node, steps = self._node, handle.request.steps
        scene = node.scenes
        for done in range(1, steps + 1):
            node.wait_period()
            handle.publish_feedback(SimulateSteps.Feedback(
                completed_steps=done, remaining_steps=steps - done))
            if done == steps:
                break
            assert node.executor is not None
            node.executor.wake()  # else it would wait for a message
            await _Turn()
            why = ('cancelled' if handle.is_cancel_requested else
                   'the scene was reset' if node.scenes != scene else
                   '' if node.state is RunState.PAUSED else
                   f'the simulation was set {node.state.name.lower()}')
            if why:
                return f'{why} after {done} of {steps} steps'
        return ''


class _Turn:
    """Awaited once, it gives the executor back for one turn."""

    def __await__(self) -> Generator[None]:
        yield
