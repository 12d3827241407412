# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The public client with real nodes: what it does, and who it says is silent."""

from pathlib import Path
import re
import threading

import numpy as np
import pytest
import tap_ros
from tap_ros.nodes.calls import CallError
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.weights import DEFAULT_PREDICTOR

pytestmark = pytest.mark.slow


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


def test_it_names_who_is_silent():
    with tap_ros.Client('/nobody', timeout_s=0.5) as client:
        for ask, silent in (
                (client.predict, '/nobody/predict_subgoal: nobody offers it'),
                (client.reach, 'visual_mpc_node'), (client.record, 'recorder_node'),
                (client.reset, '/nobody/camera/image_raw'), (client.goal, '/nobody/goal/image'),
                (lambda: client.wait_until_ready('sim_node', timeout_s=0.2), 'sim_node')):
            with pytest.raises(CallError, match=silent):
                ask()


def test_the_example_of_its_page_runs(loop, capsys):
    page = (Path(__file__).parents[2] / 'docs' / 'python.md').read_text()
    block, = re.findall(r'^```python\n(from tap_ros import Client.*?)^```$', page, re.M | re.S)
    exec(block, {})
    assert re.findall('^[123] (?:sub)?goal', capsys.readouterr().out, re.M)
