# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of what the explorer tells people: states in words, refusals without topics, events."""

import base64
import json

import cv2
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
from processes import Client
import pytest
from tap_msgs.srv import SelectObjects
from tap_ros.apps.explorer import events, words
from tap_ros.apps.explorer.browser_commands import COMMANDS, REFUSED
from tap_ros.apps.explorer.display import Display, simulated
from tap_ros.apps.explorer.events import Events
from tap_ros.apps.explorer.words import clicks_named, NodeStates, plain, renamed
from tap_ros.base.errors import TrackingError
from tap_ros.tracking.protocols import View
from tap_ros.tracking.rigid_tracker import RigidTracker
from visualization_msgs.msg import ImageMarker

OK, WARN, ERROR, STALE = (getattr(DiagnosticStatus, level)
                          for level in ('OK', 'WARN', 'ERROR', 'STALE'))


def told(states, node, now=0.0, **parts):
    """Tell what a node says: {part: (level, text)}."""
    states.take(DiagnosticArray(status=[
        DiagnosticStatus(name=f'{node}: {part}', level=level, message=text)
        for part, (level, text) in parts.items()]), now)


def lines(states, now=0.0, present=(), clicked=True):
    return {line['name']: (line['state'], line['text'])
            for line in states.lines(now, lambda: present, clicked)}


def test_a_healthy_start_names_what_each_node_waits_for_in_words():
    states, none = NodeStates(), (WARN, 'NotReceived')
    told(states, 'sim_node', service=(OK, 'OK'), **{
        '/arm/delta_twist_cmds': none, '/gripper/command': none})
    told(states, 'left/predictor_node', service=(OK, 'OK'), **{
        '/left/goal/objects': none, '/left/objects': none, '/left/camera/image_raw': (OK, 'OK')})
    told(states, 'tracker_node', service=(
        WARN, 'no objects are selected; call select_objects'))
    told(states, 'visual_mpc_node', service=(OK, 'OK'), **{
        '/camera/image_raw': (STALE, 'Stale'), '/objects': none})
    assert lines(states) == {
        'sim_node': ('works', 'works'),
        'left/predictor_node': ('waits', 'waits for objects: click on them'),
        'tracker_node': ('waits', 'no objects are selected; click on them'),
        'visual_mpc_node': ('waits', 'waits for the camera')}
    assert lines(states, clicked=False)['left/predictor_node'][1] == 'waits for objects'
    told(states, 'visual_mpc_node', service=(ERROR, '/sim/reset refused: too late'))
    assert lines(states)['visual_mpc_node'] == ('wrong', 'too late')


def test_a_node_that_is_busy_works_and_one_that_left_the_graph_has_ended():
    states = NodeStates()
    told(states, 'left/sim_node', 5.0, service=(WARN, 'waits'))
    assert lines(states, 7.9)['left/sim_node'] == ('waits', 'waits')
    assert lines(states, 60.0, {'/left/sim_node'})['left/sim_node'] == ('works', 'busy')
    assert lines(states, 60.0, {'/sim_node'})['left/sim_node'][0] == 'wrong'


def test_whoever_says_too_much_of_itself_fills_no_memory():
    states = NodeStates()
    for i in range(3 * words.MOST_NODES):
        told(states, f'node_{i}', service=(OK, 'x' * 1000))
        told(states, 'node_0', **{f'/topic_{i}': (WARN, 'x' * 1000)})
    assert len(lines(states)) == words.MOST_NODES
    _, parts = states._told['node_0']
    assert len(parts) == words.MOST_PARTS
    assert all(len(text) < 300 for _, text in parts.values())


@pytest.mark.parametrize(('said', 'meant'), [
    ('/sim/set_goal refused: objects: cup not in the scene', 'objects: cup not in the scene'),
    ('service /left/select_objects: no answer within 20 s', 'no answer within 20 s'),
    ('goal: nothing has come on /left/goal/objects, send it', 'goal: nothing has come from goals '
     'of the objects, send it'),
    ('nothing has come on /camera/image_raw (no node publishes it; published are /cam: remap one, '
     '-r /camera/image_raw:=/cam)', 'nothing has come from the camera (no node publishes it; '
     'published are /cam: remap one, -r /camera/image_raw:=/cam)'),
    ('nothing has come on /my/own, no', 'nothing has come from /my/own, no'),
    ('nothing new has come on /camera/image_raw, /objects, /joint_states',
     "nothing new has come from the camera, objects, the arm's joints"),
    ('1/2 px from the goal', '1/2 px from the goal'), ('', '')])
def test_a_refusal_is_told_in_words_and_keeps_its_remedy(said, meant):
    assert plain(said) == meant
    assert REFUSED.keys() == COMMANDS.keys()


def test_the_simulator_calls_objects_otherwise_and_a_refusal_by_their_names_here():
    truth = {'object_0': (10.0, 10.0), 'object_1': (50.0, 40.0), 'object_2': (90.0, 90.0)}
    followed = {'object_1': (10.5, 9.0), 'object_0': (50.0, 41.0), 'far': (70.0, 10.0)}
    their = simulated(followed, truth, 100)
    assert their == {'object_1': 'object_0', 'object_0': 'object_1'}
    assert simulated(truth, truth, 100) == {name: name for name in truth}
    here = {each: name for name, each in their.items()} | {'object_2': 'another'}
    assert renamed('object_0 and object_1 would overlap; object_2, object_10', here) == (
        'object_1 and object_0 would overlap; another, object_10')


def test_events_have_times_and_the_picture_of_soon_after_and_are_few(monkeypatch):
    shown = {'camera': np.full((30, 40, 3), 200, np.uint8)}
    happened = Events(shown.get)

    def newest():
        return json.loads(happened.text)['events'][-1]

    happened.add('scene: push2')
    happened.look()
    assert newest()['text'] == 'scene: push2' and newest()['time'] > 0
    assert not newest()['picture'], 'what it changed has not been seen yet'
    monkeypatch.setattr(events, 'SEEN_S', 0.0)
    shown['camera'][:] = 60
    happened.look()
    kind, data = newest()['picture'].split(',')
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert kind == 'data:image/jpeg;base64' and picture.shape == (108, 144, 3)
    assert np.abs(picture.astype(int) - 60).max() < 5
    happened.add('predicted', 'subgoal')  # of which there is no picture
    happened.add('the goal was not moved', problem=True)
    happened.look()
    assert not newest()['picture'] and happened.problem == {
        'count': 1, 'text': 'the goal was not moved'}
    for _ in range(1000):
        happened.add('x' * 1000)
    happened.look()
    assert happened.count == 1003 and len(json.loads(happened.text)['events']) == events.MOST
    shown['camera'] = np.zeros((4000, 2, 3), np.uint8)
    happened.look()
    assert len(happened.text) < 200_000


def test_a_refused_click_is_called_as_its_object():
    plane = np.random.default_rng(0).integers(90, 94, (256, 256, 3), np.uint8)
    clicks = [{'name': 'cup', 'u': 100, 'v': 40.04}, {'name': 'ring', 'u': 30.5, 'v': 200}]
    with pytest.raises(TrackingError) as refused:
        RigidTracker().select(View(plane), [(one['u'], one['v']) for one in clicks])
    assert clicks_named(str(refused.value), clicks) == (
        'cup is on nothing that differs from the table around it; leave it out (✕), or click '
        'on an object')


def test_outlines_of_earlier_objects_are_not_those_of_new_ones_of_the_same_names():
    with Client('shows') as node:
        shown = Display(node)
        for followed, left in ((False, 1), (True, 0)):
            shown.outlines['object_0'] = ImageMarker()
            shown.select(SelectObjects.Response(), followed)
            assert len(shown.outlines) == left
