# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A goal that is moved: what the planner goes to, what it does meanwhile, what is recorded."""

from action_msgs.msg import GoalStatus
import numpy as np
import pytest
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.recording.reader import iter_episodes

pytestmark = pytest.mark.slow
MOVED = {'object_1': (14.5, 44.25)}


def set_goal(loop, pixels):
    """Move objects of the goal, {name: (u, v)}; return all its pixels (K, 2) once they came."""
    before = to_nanoseconds(loop.goal_objects.wait(10).header.stamp)
    loop.client.set_goal(pixels)
    for topic in (loop.goal_image, loop.goal_objects):
        topic.wait(10, lambda m: to_nanoseconds(m.header.stamp) > before)
    return decode_objects(loop.goal_objects.wait(1), 'goal_objects')[1]


def test_a_goal_that_moves_on_the_way_ends_the_request_and_the_next_one_reaches_it(loop):
    handle = loop.begin_moving(mode='subgoal', step_budget=1000)
    before = loop.client.call('predict').subgoals[0]
    set_goal(loop, MOVED)
    result = loop.ended(handle, GoalStatus.STATUS_ABORTED, 'a new goal has come on')
    assert result.steps >= 1 and '/goal/objects' in result.message
    after = loop.client.call('predict').subgoals[0]
    assert len(after.object_maps) == 2, 'objects and picture of the goal go together'
    assert before.image.data != after.image.data
    count = len(loop.moves())
    # The goal is where the objects are now: nothing is left to do.
    last = loop.image.wait(10)
    objects = loop.objects.wait(10, lambda m: m.header.stamp == last.header.stamp)
    names, pixels = decode_objects(objects, 'objects')
    np.testing.assert_allclose(set_goal(loop, dict(zip(names, pixels))), pixels, atol=1e-3)
    result = loop.reached(mode='direct')
    assert result.success and 'reached' in result.message and result.expected_distance < 0.1
    assert len(loop.moves()) == count


def test_a_recording_has_the_goal_that_holds_at_the_end_of_an_episode(loop):
    loop.client.record(False)
    folder = loop.client.record().removeprefix('recording to ')
    loop.reset(seed=7)
    set_goal(loop, {'object_1': (31.5, 44.25)})
    loop.reached(mode='direct', step_budget=2)
    # Twice at the last moment of the episode: the later one counts.
    set_goal(loop, {'object_1': (30.0, 44.25)})
    pixels = set_goal(loop, MOVED)
    picture = loop.goal_image.wait(1)
    loop.reset(seed=8)
    drawn = decode_objects(loop.goal_objects.wait(1), 'goal_objects')[1]
    loop.reach(mode='direct', step_budget=1)  # by then the recorder knows of the new episode
    loop.client.record(False)
    # What the scene before sent last may reach the recorder after the bag was begun.
    episode, = (e for e in iter_episodes(folder) if e.seed == 7)
    following, = (e for e in iter_episodes(folder) if e.seed == 8)
    assert (len(episode), episode.outcome) == (3, 'failure')
    np.testing.assert_array_equal(episode.goal_pixels, pixels)
    np.testing.assert_allclose(episode.goal_pixels[1], MOVED['object_1'], atol=1e-4)
    assert episode.goal_frame.tobytes() == bytes(picture.data)
    assert episode.goal_mask is not None
    np.testing.assert_array_equal(following.goal_pixels, drawn)
