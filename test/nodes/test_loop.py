# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The whole loop over DDS: simulate, predict a subgoal, plan, push, record; all of it real."""

from collections import Counter
from pathlib import Path
import re

from loop import SEED
from mcap.reader import make_reader
import numpy as np
from processes import LocalNode, until
import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from tap_ros.base.errors import TapError
from tap_ros.nodes.planner.node import VisualMpcNode
from tap_ros.nodes.predictor.node import PredictorNode
from tap_ros.recording.cache import open_recordings
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL, PREDICTORS
import yaml

pytestmark = pytest.mark.slow
FOLDER = Path(__file__).parents[2] / 'config' / 'layouts'
MOVED = {'object_1': (14.5, 44.25)}



def test_all_viewers_show_topics_of_the_nodes_as_they_are_offered(loop):
    wanted = {'/diagnostics'}
    for file in FOLDER.iterdir():
        found = set(re.findall(r'(?<=["\' ])/[a-z_]+(?:/[a-z_]+)*', file.read_text()))
        assert len(found) > 2, file
        wanted |= {name.removesuffix('/data') for name in found}

    def missing():
        return wanted - {name for name, _ in (*loop.node.get_topic_names_and_types(),
                                              *loop.node.get_service_names_and_types())}

    assert until(lambda: not missing()), missing()
    layout = yaml.safe_load((FOLDER / 'tap_ros.rviz').read_text())
    for display in layout['Visualization Manager']['Displays']:
        shown = display.get('Topic') or display.get('Description Topic')
        if shown:
            info, = loop.node.get_publishers_info_by_topic(shown['Value'])
            latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            assert shown['Durability Policy'] == ('Transient Local' if latched else 'Volatile')
            assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE


def set_goal(loop, pixels):
    """Move objects of the goal, {name: (u, v)}; return the View of it once it came."""
    before = loop.client.goal().stamp_ns
    loop.client.set_goal(pixels)
    return loop.client.goal(before)


def test_a_goal_that_moves_on_the_way_ends_the_request_and_the_next_one_reaches_it(loop):
    reaching = loop.begin_moving(mode='subgoal', step_budget=1000)
    before = loop.client.call('predict').subgoals[0]
    set_goal(loop, MOVED)
    result = loop.ended(reaching, 'aborted', 'a new goal has come on')
    assert result.steps >= 1 and '/goal/objects' in result.message
    after = loop.client.call('predict').subgoals[0]
    assert len(after.object_maps) == 2, 'objects and picture of the goal go together'
    assert before.image.data != after.image.data
    count = len(loop.moves())
    # The goal is where the objects are now: nothing is left to do.
    here = loop.client.camera()
    moved = set_goal(loop, dict(zip(here.names, here.pixels)))
    np.testing.assert_allclose(moved.pixels, here.pixels, atol=1e-3)
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
    goal = set_goal(loop, MOVED)
    loop.reset(seed=8)
    drawn = loop.client.goal().pixels
    loop.reached(mode='direct', step_budget=1)  # by then the recorder knows of the new episode
    loop.client.record(False)
    # What the scene before sent last may reach the recorder after the bag was begun.
    episode, = (e for e in open_recordings(folder) if e.seed == 7)
    following, = (e for e in open_recordings(folder) if e.seed == 8)
    assert (len(episode), episode.outcome) == (3, 'failure')
    np.testing.assert_array_equal(episode.goal_pixels, goal.pixels)
    np.testing.assert_allclose(episode.goal_pixels[1], MOVED['object_1'], atol=1e-4)
    np.testing.assert_array_equal(episode.goal_frame, goal.image)
    assert episode.goal_mask is not None
    np.testing.assert_array_equal(following.goal_pixels, drawn)


def test_every_node_ends_cleanly_and_the_bag_holds_every_episode(loop):
    loop.client.record(False)
    bag = Path(loop.client.record().removeprefix('recording to '))
    loop.reset()
    loop.client.call('predict')
    loop.reset(seed=7)
    loop.reached(mode='direct', step_budget=2, seed=3)
    moves = loop.moves()
    loop.reset()
    feedback = []
    loop.begin(feedback.append, mode='direct')
    # The second command follows on the picture of the first step: a step was made.
    assert until(lambda: len(feedback) > 1, 120)
    for name in ('visual_mpc_node', 'predictor_node', 'sim_node', 'recorder_node'):
        process = loop.processes[name]
        assert process.end() == 0, process.text
        assert 'Traceback' not in process.text
        assert loop.stopped()
    counts = Counter()
    for path in bag.glob('*.mcap'):
        with path.open('rb') as stream:
            counts.update(
                channel.topic for _, channel, _ in make_reader(
                    stream, validate_crcs=True).iter_messages())
    for topic in ('/camera/image_raw', '/camera/camera_info', '/objects', '/joint_states',
                  '/clock', '/goal/image', '/goal/objects', '/episode', '/gripper/command',
                  '/arm/delta_twist_cmds', '/subgoal', '/subgoal/image', '/subgoal/overlay',
                  '/plan/distance', '/predictor_node/model_card', '/visual_mpc_node/model_card'):
        assert counts[topic] > 0
    episodes = list(open_recordings(bag))
    whole, cut_short = episodes[-2:]
    assert (whole.task, whole.seed, len(whole.frames)) == ('push2', 7, 3)
    assert (cut_short.seed, cut_short.outcome) == (SEED, 'failure')
    assert np.allclose(whole.actions[:2, :3], moves)
    assert whole.frames.std() > 5 and np.isfinite(whole.object_pixels).all()
    assert whole.goal_frame is not None


def test_bad_weights_are_refused_by_an_error_that_names_the_file(tmp_path):
    weights = tmp_path / 'weights.safetensors'
    for make, other in ((PredictorNode, FORWARD_MODEL),
                        (VisualMpcNode, PREDICTORS[DEFAULT_PREDICTOR])):
        for content in (None, b'these are not weights', other.read_bytes()):
            weights.unlink(missing_ok=True)
            if content is not None:
                weights.write_bytes(content)
            with pytest.raises(TapError, match=re.escape(str(weights))):
                LocalNode(make, weights=weights)
