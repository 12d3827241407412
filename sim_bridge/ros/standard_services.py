# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The services that simulators have in common (package simulation_interfaces), for sim_node."""

from collections.abc import Callable
import re
import signal
from typing import Any

from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3
import numpy as np
from sim_bridge.ros.sim_node import MAX_PERIODS
from sim_bridge.simulator import PoseError
from sim_bridge.world_protocol import RunState
from simulation_interfaces.msg import EntityFilters, EntityState, Result, SimulatorFeatures
from simulation_interfaces.srv import (
    GetEntities,
    GetEntitiesStates,
    GetEntityState,
    GetSimulationState,
    GetSimulatorFeatures,
    ResetSimulation,
    SetEntityState,
    SetSimulationState,
    StepSimulation,
)
from tap_ros.contract import CONTROL_PERIOD, WORLD_FRAME
from tap_ros.errors import TapError
from tap_ros.nodes.services import answering
from tap_ros.nodes.topics import SERVICE_QOS
from tap_ros.text import escaped, listing

Answer = Callable[[Any, Any], None]  # fills the response of a request, or raises
INVALID_POSE = 101  # of SetEntityState, in versions before 1.5.1 too
FEATURES = (
    'ENTITY_STATE_GETTING', 'ENTITY_STATE_SETTING', 'SIMULATION_RESET', 'SIMULATION_RESET_STATE',
    'SIMULATION_STATE_GETTING', 'SIMULATION_STATE_SETTING', 'SIMULATION_STATE_PAUSE',
    'STEP_SIMULATION_SINGLE', 'STEP_SIMULATION_MULTIPLE')
INFO = (f'A step is a control period of {CONTROL_PERIOD:g} s, in which the arm stands still: at '
        f'most {MAX_PERIODS} a StepSimulation. The clock never goes back, also at a reset. '
        'Entities are the objects; the arm moves by commands alone.')


class Refused(TapError):
    """A request is not done; with the code for its Result."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class StandardServices:
    """
    Offers the services under the name of the node: sim_node/get_entities ...

    Each service has a function that fills its response, but for its Result, which is by what it
    raises: Refused with its code, any other TapError as a failed operation.

    :param node: SimNode. Services of entities are offered if its world can put objects.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        answers: dict[type, Answer] = {
            GetSimulatorFeatures: self._on_get_features, ResetSimulation: self._on_reset,
            GetSimulationState: self._on_get_state, StepSimulation: self._on_step,
            SetSimulationState: self._on_set_state}
        if hasattr(node.sim, 'put_object'):
            answers |= {
                GetEntities: self._on_get_entities, GetEntitiesStates: self._on_get_states,
                GetEntityState: self._on_get_entity, SetEntityState: self._on_put_entity}
        for kind, answer in answers.items():
            node.create_service(kind, name_of(kind), answering(node, _responding(answer), refusal),
                                qos_profile=SERVICE_QOS)

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
            signal.raise_signal(signal.SIGTERM)  # which run.main heeds when this is answered

    def _on_step(self, request: Any, response: Any) -> None:
        if self._node.state is not RunState.PAUSED:
            raise Refused(
                Result.RESULT_OPERATION_FAILED, f'the simulation is '
                f'{self._node.state.name.lower()}; pause it first with set_simulation_state, '
                'state 2')
        if not 1 <= request.steps <= MAX_PERIODS:
            raise Refused(Result.RESULT_OPERATION_FAILED,
                          f'steps is {request.steps}; expected 1 to {MAX_PERIODS}')
        for _ in range(request.steps):
            self._node.wait_period()

    def _on_get_entities(self, request: Any, response: Any) -> None:
        if request.filters != EntityFilters():
            raise Refused(Result.RESULT_FEATURE_UNSUPPORTED,
                          'filters: expected none; a scene has few objects')
        response.entities = list(self._node.sim.object_names)

    def _on_get_states(self, request: Any, response: Any) -> None:
        self._on_get_entities(request, response)
        response.states = [self._state(name) for name in response.entities]

    def _on_get_entity(self, request: Any, response: Any) -> None:
        response.state = self._state(request.entity)

    def _on_put_entity(self, request: Any, response: Any) -> None:
        self._index(request.entity)
        state = request.state
        if state.header.frame_id not in ('', WORLD_FRAME):
            raise Refused(
                Result.RESULT_FEATURE_UNSUPPORTED, f"header.frame_id is '"
                f"{escaped(state.header.frame_id)}'; expected '{WORLD_FRAME}' or nothing")
        pose = [*_numbers(state.pose.position), *_numbers(state.pose.orientation)]
        velocity = [*_numbers(state.twist.linear), *_numbers(state.twist.angular)]
        try:
            self._node.put_object(request.entity, np.array(pose), np.array(velocity))
        except PoseError as error:
            raise Refused(INVALID_POSE, str(error)) from error

    def _index(self, name: str) -> int:
        names = self._node.sim.object_names
        if name not in names:
            raise Refused(Result.RESULT_NOT_FOUND,
                          f"entity '{escaped(name)}' is not there; there are {listing(names)}")
        return names.index(name)

    def _state(self, name: str) -> EntityState:
        """Return the pose and motion of an entity, as in the newest picture."""
        index, sim = self._index(name), self._node.sim
        pose, motion = sim.object_poses()[index], sim.object_motions()[index]
        state = EntityState(
            pose=Pose(position=_fill(Point(), pose[:3]),
                      orientation=_fill(Quaternion(), pose[3:])),
            twist=Twist(linear=_fill(Vector3(), motion[:3]), angular=_fill(Vector3(), motion[3:])))
        state.header.stamp, state.header.frame_id = self._node.stamp, WORLD_FRAME
        return state


def _fill(message: Any, numbers: np.ndarray) -> Any:
    """Fill a message with fields x, y, z (and w)."""
    for axis, number in zip('xyzw', numbers.tolist()):
        setattr(message, axis, number)
    return message


def _numbers(message: Any) -> list[float]:
    """Return the fields x, y, z (and w) of a message."""
    return [getattr(message, axis) for axis in 'xyzw' if hasattr(message, axis)]


def name_of(kind: type) -> str:
    """Return the name of a service under that of its node, as other simulators call it."""
    return '~/' + re.sub('(?<=[a-z])(?=[A-Z])', '_', kind.__name__).lower()


def refusal(kind: type, reason: str, error: Exception) -> Any:
    """Return a response of this type with a Result alone."""
    code = getattr(error, 'code', Result.RESULT_OPERATION_FAILED)
    return kind(result=Result(result=code, error_message=reason))


def _responding(answer: Answer) -> Callable[[Any, Any], Any]:
    """Let a function fill a response; its Result is that it did not raise."""
    def respond(request: Any, response: Any) -> Any:
        answer(request, response)
        if hasattr(response, 'result'):  # all but GetSimulatorFeatures
            response.result.result = Result.RESULT_OK
        return response

    return respond
