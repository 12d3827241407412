# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The services that simulators have in common (package simulation_interfaces), for sim_node."""

from collections.abc import Callable, Generator
import re
import signal
import traceback
from typing import Any, TYPE_CHECKING

from geometry_msgs.msg import Accel, Point, Pose, Quaternion, Twist, Vector3
import numpy as np
from rclpy.action import ActionServer, CancelResponse
from sim_bridge.ros.run_state import MAX_PERIODS, MAX_STEPS, RunState
from sim_bridge.world import entities
from sim_bridge.world.scene import object_names
from simulation_interfaces.action import SimulateSteps
from simulation_interfaces.msg import (
    Bounds,
    EntityCategory,
    EntityFilters,
    EntityState,
    Result,
    SimulatorFeatures,
    TagsFilter,
)
from simulation_interfaces.srv import (
    GetEntities,
    GetEntitiesStates,
    GetEntityBounds,
    GetEntityInfo,
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

if TYPE_CHECKING:
    from rclpy.action.server import ServerGoalHandle

Answer = Callable[[Any, Any], None]  # fills the response of a request, or raises
INVALID_POSE = 101  # of SetEntityState, in versions before 1.5.1 too
FEATURES = (
    'ENTITY_TAGS', 'ENTITY_BOUNDS', 'ENTITY_BOUNDS_BOX', 'ENTITY_CATEGORIES',
    'ENTITY_STATE_GETTING', 'ENTITY_STATE_SETTING', 'ENTITY_INFO_GETTING',
    'SIMULATION_RESET', 'SIMULATION_RESET_STATE', 'SIMULATION_STATE_GETTING',
    'SIMULATION_STATE_SETTING', 'SIMULATION_STATE_PAUSE', 'STEP_SIMULATION_SINGLE',
    'STEP_SIMULATION_MULTIPLE', 'STEP_SIMULATION_ACTION')
INFO = (f'A step is a control period of {CONTROL_PERIOD:g} s, in which the arm stands still: at '
        f'most {MAX_PERIODS} a StepSimulation, {MAX_STEPS} a SimulateSteps. The clock never goes '
        'back, also at a reset. Entities are the objects; the arm moves by commands alone.')


class Refused(TapError):
    """A request is not done; with the code for its Result."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class StandardServices:
    """
    Offers the services and the action under the name of the node: sim_node/get_entities ...

    Each service has a function that fills its response, but for its Result, which is by what it
    raises: Refused with its code, any other TapError as a failed operation.

    :param node: SimNode. Services of entities are offered if its world can put objects.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._stepping = False
        answers: dict[type, Answer] = {
            GetSimulatorFeatures: self._on_get_features, ResetSimulation: self._on_reset,
            GetSimulationState: self._on_get_state, StepSimulation: self._on_step,
            SetSimulationState: self._on_set_state}
        if hasattr(node.sim, 'put_object'):
            answers |= Entities(node).answers
        for kind, answer in answers.items():
            node.create_service(kind, name_of(kind), answering(node, _responding(answer), refusal),
                                qos_profile=SERVICE_QOS)
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


class Entities:
    """
    Answers what is asked about objects.

    :param node: SimNode.
    :ivar answers: by the type of the service.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self.answers: dict[type, Answer] = {
            GetEntities: self._on_get_entities, GetEntitiesStates: self._on_get_states,
            GetEntityState: self._on_get_state, GetEntityInfo: self._on_get_info,
            GetEntityBounds: self._on_get_bounds, SetEntityState: self._on_set_state}

    def _on_get_entities(self, request: Any, response: Any) -> None:
        response.entities = self._found(request.filters)

    def _on_get_states(self, request: Any, response: Any) -> None:
        response.entities = self._found(request.filters)
        response.states = [self._state(self._index(name)) for name in response.entities]

    def _on_get_state(self, request: Any, response: Any) -> None:
        response.state = self._state(self._index(request.entity))

    def _on_get_info(self, request: Any, response: Any) -> None:
        shape = self._node.sim.scene.shapes[self._index(request.entity)]
        highest, lowest = entities.box_of(shape)
        response.info.category.category = EntityCategory.CATEGORY_OBJECT
        response.info.tags = [shape.kind]
        response.info.description = (
            f'{shape.kind}, {" x ".join(f"{size:.3f}" for size in highest - lowest)} m')

    def _on_get_bounds(self, request: Any, response: Any) -> None:
        shape = self._node.sim.scene.shapes[self._index(request.entity)]
        response.bounds = Bounds(type=Bounds.TYPE_BOX, points=[
            _fill(Vector3(), corner) for corner in entities.box_of(shape)])

    def _on_set_state(self, request: Any, response: Any) -> None:
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
        except entities.PoseError as error:
            raise Refused(INVALID_POSE, str(error)) from error

    def _index(self, name: str) -> int:
        names = object_names(len(self._node.sim.scene.shapes))
        if name not in names:
            raise Refused(Result.RESULT_NOT_FOUND,
                          f"entity '{escaped(name)}' is not there; there are {listing(names)}")
        return names.index(name)

    def _state(self, index: int) -> EntityState:
        """Return the pose and motion of an entity, as in the newest picture."""
        sim = self._node.sim
        pose, (velocity, acceleration) = sim.object_poses()[index], sim.object_motions()[index]
        state = EntityState(
            pose=Pose(position=_fill(Point(), pose[:3]),
                      orientation=_fill(Quaternion(), pose[3:])),
            twist=Twist(linear=_fill(Vector3(), velocity[0]),
                        angular=_fill(Vector3(), velocity[1])),
            acceleration=Accel(linear=_fill(Vector3(), acceleration[0]),
                               angular=_fill(Vector3(), acceleration[1])))
        state.header.stamp, state.header.frame_id = self._node.stamp, WORLD_FRAME
        return state

    def _found(self, filters: EntityFilters) -> list[str]:
        """Return the names of the entities that pass all filters."""
        sim = self._node.sim
        names = object_names(len(sim.scene.shapes))
        found = set(entities.matching(filters.filter, names) if filters.filter else names)
        categories = {category.category for category in filters.categories}
        if categories and EntityCategory.CATEGORY_OBJECT not in categories:
            found = set()
        if filters.tags.filter_mode not in (
                TagsFilter.FILTER_MODE_ANY, TagsFilter.FILTER_MODE_ALL):
            raise Refused(Result.RESULT_FEATURE_UNSUPPORTED,
                          f'tags.filter_mode is {filters.tags.filter_mode}; expected 0 or 1')
        passes = all if filters.tags.filter_mode == TagsFilter.FILTER_MODE_ALL else any
        within = _reader(filters.bounds)
        return [name for name, shape, pose in zip(names, sim.scene.shapes, sim.object_poses())
                if name in found
                and (not filters.tags.tags or passes(tag == shape.kind
                                                     for tag in filters.tags.tags))
                and within(entities.box_around(entities.box_of(shape), pose))]


def _fill(message: Any, numbers: np.ndarray) -> Any:
    """Fill a message with fields x, y, z (and w)."""
    for axis, number in zip('xyzw', numbers.tolist()):
        setattr(message, axis, number)
    return message


def _numbers(message: Any) -> list[float]:
    """Return the fields x, y, z (and w) of a message."""
    return [getattr(message, axis) for axis in 'xyzw' if hasattr(message, axis)]


def _reader(bounds: Bounds) -> Callable[[np.ndarray], bool]:
    """
    Return what tells whether a box (2, 3), highest corner first, overlaps with bounds.

    :raises Refused: for bounds that are none, and for hulls.
    """
    if bounds.type == Bounds.TYPE_EMPTY:
        return lambda box: True
    if bounds.type not in (Bounds.TYPE_BOX, Bounds.TYPE_SPHERE):
        raise Refused(Result.RESULT_FEATURE_UNSUPPORTED,
                      f'bounds.type is {bounds.type}; expected 0 (none), 1 (box), 3 (sphere)')
    points = np.array([_numbers(point) for point in bounds.points])
    if points.shape == (2, 3):
        first, second = points
        if bounds.type == Bounds.TYPE_BOX and (first >= second).all():
            return lambda box: entities.overlaps_box(box, points)
        if bounds.type == Bounds.TYPE_SPHERE and np.isfinite(first).all() and second[0] >= 0:
            return lambda box: entities.overlaps_sphere(box, first, second[0])
    raise Refused(
        Result.RESULT_OPERATION_FAILED, 'bounds.points: expected two; of a box its highest and '
        'its lowest corner, of a sphere its centre and, as x, its radius')


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
