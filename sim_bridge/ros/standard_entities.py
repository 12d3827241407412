# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Entities for simulation_interfaces: the objects of sim_node's scene."""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING

from geometry_msgs.msg import Accel, Point, Pose, Quaternion, Twist, Vector3
import numpy as np
from sim_bridge.ros.standard_answers import Answer, Refused
from sim_bridge.world import entities
from sim_bridge.world.scene import object_names
from simulation_interfaces.msg import (
    Bounds,
    EntityCategory,
    EntityFilters,
    EntityState,
    Result,
    TagsFilter,
)
from simulation_interfaces.srv import (
    GetEntities,
    GetEntitiesStates,
    GetEntityBounds,
    GetEntityInfo,
    GetEntityState,
    SetEntityState,
)
from tap_ros.contract import WORLD_FRAME
from tap_ros.text import escaped, listing

if TYPE_CHECKING:
    from sim_bridge.ros.sim_node import SimNode

INVALID_POSE = 101  # of SetEntityState, in versions before 1.5.1 too


class Entities:
    """
    Answers what is asked about objects.

    :param node: SimNode.
    :ivar answers: by the type of the service.
    """

    def __init__(self, node: 'SimNode') -> None:
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
        names = object_names(self._node.sim.task.num_objects)
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
        names = object_names(sim.task.num_objects)
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
