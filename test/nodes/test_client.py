# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The public client and the command `call` with real nodes: what they do, and who is silent."""

import math
from pathlib import Path
import re
import threading

import cv2
import numpy as np
from processes import Client, until
import pytest
from std_msgs.msg import Bool
import tap_ros
from tap_ros.__main__ import main
from tap_ros.base.errors import ConfigError
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.predictor.node import OVERLAY_SIDE
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.ros.calls import CallError
from tap_ros.ros.topics import STREAM
from tap_ros.weights import DEFAULT_PREDICTOR

pytestmark = pytest.mark.slow


@pytest.mark.errors('a callback failed')
def test_nothing_that_fails_makes_a_client_deaf():
    heard = []

    def fail_once(message):
        heard.append(message)
        assert len(heard) > 1, 'the first fails'

    with Client('listener', namespace='/deaf') as node:
        node.create_subscription(Bool, 'words', fail_once, STREAM)
        publisher = node.create_publisher(Bool, 'words', STREAM)
        assert until(publisher.get_subscription_count)
        for _ in range(200):  # the thread that spins looks at what is destroyed
            node.destroy_publisher(node.create_publisher(Bool, 'others', STREAM))
        publisher.publish(Bool())
        publisher.publish(Bool())
        assert until(lambda: len(heard) == 2)


def test_it_does_with_the_nodes_what_the_classes_do(loop):
    with tap_ros.Client() as client:
        client.wait_until_ready('sim_node', 'predictor_node', 'visual_mpc_node', 'recorder_node')
        start, goal = client.reset('push2', 3)
        assert start.names == goal.names and start.stamp_ns == goal.stamp_ns
        assert client.camera().stamp_ns == start.stamp_ns
        asked = (start.image, goal.image, start.pixels, goal.pixels)
        answer, = client.predict(*asked)
        wanted, = SubgoalPredictor.load(DEFAULT_PREDICTOR).predict(*asked)
        assert np.abs(answer.image.astype(int) - wanted.image).max() <= 1
        assert answer.expected_pixels == pytest.approx(wanted.expected_pixels, abs=0.01)
        by_topics, = client.predict()
        assert by_topics.expected_pixels == pytest.approx(answer.expected_pixels, abs=0.01)
        for topic, side in ((loop.subgoal, 0), (loop.overlay, OVERLAY_SIDE)):
            shown = topic.wait(10, lambda m: to_nanoseconds(m.header.stamp) == start.stamp_ns)
            assert not side or shown.width == shown.height == side

        reaching = client.reach(mode='direct', step_budget=3)
        steps = [feedback.step for feedback in reaching]
        assert steps == [1, 2, 3] and reaching.result().steps == 3
        assert client.camera(start.stamp_ns).stamp_ns > start.stamp_ns
        moved = threading.Event()
        reaching = client.reach(on_feedback=lambda feedback: moved.set())
        assert moved.wait(30)
        with pytest.raises(CallError, match='rejected'):
            client.reach()
        reaching.cancel()
        assert reaching.result().end == 'cancelled'

        u, v = goal.pixels[0]
        client.set_goal({goal.names[0]: (u + 1, v)})
        assert client.goal(goal.stamp_ns).pixels[0] == pytest.approx((u + 1, v), abs=0.5)
        with pytest.raises(CallError, match=r'/predict_subgoal refused: .*start_objects'):
            client.predict(start.image, goal.image, start.pixels + 1000, goal.pixels)
        client.record(False)
        client.record()


def test_the_command_prints_places_and_draws_what_the_node_answers(loop, tmp_path, capsys):
    with tap_ros.Client() as client:
        start, goal = client.reset('push2', 3)
    words, out = [], tmp_path / 'answer.png'
    for name, view, option in (('start', start, '--objects'), ('goal', goal, '--goal-objects')):
        cv2.imwrite(str(tmp_path / f'{name}.png'), view.image[..., ::-1])
        words += [f'--{name}', str(tmp_path / f'{name}.png'), option,
                  *(f'{u},{v}' for u, v in view.pixels)]
    assert main(['call', *words, '--out', str(out)]) == 0
    said = capsys.readouterr().out
    wanted, = SubgoalPredictor.load(DEFAULT_PREDICTOR).predict(
        start.image, goal.image, start.pixels, goal.pixels)
    found = np.array(re.findall(r'object_\d at ([\d.-]+),([\d.-]+)', said), float)
    assert found == pytest.approx(wanted.expected_pixels, abs=0.06)
    picture = cv2.imread(str(out))
    assert picture.shape[1] > 1.5 * picture.shape[0] and picture.std() > 20
    for bad, reason in (
            (['--namespace', '/nobody', '--timeout', '0.2'], '/nobody/predict_subgoal'),
            (['--objects', '3,4'], '--objects'), (['--samples', '101'], 'num_samples'),
            (['--out', 'a.txt'], '.png'), (['--start', 'nowhere.png'], 'nowhere.png')):
        assert main(['call', *bad]) == 1
        error = capsys.readouterr().err
        assert reason in error and error.count('\n') == 1


def test_it_names_who_is_silent():
    with tap_ros.Client('/nobody', timeout_s=0.2) as client:
        for ask, silent in (
                (client.predict, '/nobody/predict_subgoal: nobody offers it'),
                (client.reach, 'visual_mpc_node'), (client.record, 'recorder_node'),
                (client.reset, '/nobody/camera/image_raw'), (client.goal, '/nobody/goal/image'),
                (lambda: client.wait_until_ready('sim_node', timeout_s=0.2), 'sim_node')):
            with pytest.raises(CallError, match=silent):
                ask()


IMAGE = np.zeros((8, 8, 3), np.uint8)


@pytest.mark.parametrize('ask', [
    lambda client: client.set_goal({5: (1, 1)}), lambda client: client.set_goal({'a': (1,)}),
    lambda client: client.set_goal({'\ud800': (1, 1)}),
    lambda client: client.set_goal({'a': (1, math.nan)}),
    lambda client: client.reach(goal_pixels={5: (1, 1)}),
    lambda client: client.reach(goal=IMAGE[0]), lambda client: client.reach(timeout_s=math.nan),
    lambda client: client.reach(seed='1'), lambda client: client.select({'a': 'ab'}),
    lambda client: client.select({None: (1, 1)}), lambda client: client.reset('\ud800'),
    lambda client: client.predict(IMAGE / 2), lambda client: client.predict(start_pixels=[1, 2]),
    lambda client: client.predict(timeout_s=0), lambda client: client.predict(num_samples=0.5),
    lambda client: client.camera(timeout_s=-1), lambda client: client.use_weights(5),
    lambda client: client.wait_until_ready('nobody'), lambda client: client.call('nobody'),
    lambda client: client.wait_until_ready(timeout_s=math.inf),
    lambda client: tap_ros.Client(timeout_s='1'), lambda client: tap_ros.Client('a b')])
def test_what_cannot_be_sent_is_said_before_it_is_sent(ask):
    with tap_ros.Client('/nobody', timeout_s=0.2) as client, pytest.raises(ConfigError):
        ask(client)


def test_a_call_ends_in_time_whatever_takes_long():
    with tap_ros.Client('/nobody', timeout_s=0.05) as client:
        large = np.zeros((2000, 2000, 3), np.uint8)
        with pytest.raises(CallError, match='predict: not done within 0.001 s'):
            client.predict(large, large, timeout_s=0.001)
        with pytest.raises(CallError, match='0.05 s'):
            client.reach(timeout_s=1e300)


def test_the_example_of_its_page_runs(loop, capsys):
    page = (Path(__file__).parents[2] / 'docs' / 'python.md').read_text()
    block, = re.findall(r'^```python\n(from tap_ros import Client.*?)^```$', page, re.M | re.S)
    exec(block, {})
    assert re.findall('^[123] (?:sub)?goal', capsys.readouterr().out, re.M)
