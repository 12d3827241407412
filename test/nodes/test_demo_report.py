# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demo with real nodes, at the table and in a world of others; laws of its page and film."""

from dataclasses import replace
import io
import json
from pathlib import Path
import re
import threading

from browsing import chromium, hidden_or_over, needs_browser, opened
from builtin_interfaces.msg import Time
from mcap.reader import make_reader
import numpy as np
from PIL import Image, ImageSequence
from processes import Client, crowd, until
import pytest
from rclpy.duration import Duration
from sim_bridge.tasks.tasks import get_task, sample_scene
from std_msgs.msg import Header
from tap_msgs.msg import ObjectStates
from tap_ros.apps.demo import command
from tap_ros.apps.demo.film import (
    film,
    FRAME_MS,
    GAP,
    GOAL,
    HEAD,
    HOLD_MS,
    Run,
    Scene,
    SIDE,
    START_MS,
)
from tap_ros.apps.demo.report import (
    gains,
    in_words,
    results_table,
    shown,
    summary,
    write_report,
)
from tap_ros.apps.demo.watch import right_order, Watch
from tap_ros.base.contract import CAMERA_SIZE
from tap_ros.base.errors import TapError
from tap_ros.messages.subgoals import Subgoal
from tap_ros.recording.cache import open_recordings
from tap_ros.ros import client
from tap_ros.ros.topics import STREAM

LAYOUT = Path(__file__).parents[2] / 'config' / 'layouts' / 'tap_ros.json'
SEED = 2_000_000
GREYS = {'direct': (0, 60, 120, 180), 'subgoal': (240, 90)}  # one run is shorter
START, GOALS = np.array([[20.0, 40.0], [90.0, 40.0]]), np.array([[20.0, 100.0], [20.0, 40.0]])


def scene(seed=7, direct=0.11, task='order2'):
    """Return a Scene in which the first object has to go first; a run is a few greys long."""
    def run(mode, end, *subgoals):
        count = len(GREYS[mode])
        return Run(
            np.linspace(0.2, end, count)[:, None].repeat(2, 1),
            [np.full((192, 192, 3), grey, np.uint8) for grey in GREYS[mode]],
            np.tile(START, (count, 1, 1)), [0, *[GOAL] * (count - 2)] if subgoals else
            [GOAL] * (count - 1), subgoals, 'ended <early> & well', 500.0)
    first_moved = Subgoal(np.full((32, 32, 3), 200, np.uint8), np.zeros((2, 32, 32), np.float32),
                          (np.array([GOALS[0], START[1]]) + 0.5) / 4 - 0.5, np.ones(2), 0, 1)
    return Scene(task, seed, np.full((128, 128, 3), 30, np.uint8), START, GOALS, (0, 1),
                 {'direct': run('direct', direct), 'subgoal': run('subgoal', 0.03, first_moved)})


def test_what_a_subgoal_decides_is_read_from_where_it_shows_the_objects():
    one = scene()
    told, = one.runs['subgoal'].subgoals
    assert one.numbers == ['1', '2'] and one.decided(told) == '1 first'
    assert replace(one, order=(1, 0)).decided(told) == '2 first'  # numbers are the right order
    last_moved = replace(told, expected_pixels=(np.array([START[0], GOALS[1]]) + 0.5) / 4 - 0.5)
    assert one.decided(last_moved) == '2 first'


def test_the_order_that_works_is_read_from_where_objects_stand_and_shall_stand():
    for task, seeds in (('order2', range(20)), ('order3', range(20)), ('push2', range(20))):
        for seed in seeds:
            drawn = sample_scene(get_task(task), seed)
            starts, goals = (np.insert(poses[:, :2], 2, 0.03, axis=1)
                             for poses in (drawn.start_poses, drawn.goal_poses))
            assert right_order(starts, goals) == (drawn.order if 'order' in task else ())
    assert right_order(starts[:1], starts[:1]) == right_order(starts * np.nan, goals) == ()


def test_all_panels_show_the_same_part_of_the_camera_view():
    def ramp(size):
        share = (np.mgrid[:size, :size] + 0.5).sum(0) / size / 2
        return np.rint(255 * share[..., None].repeat(3, 2)).astype(np.uint8)

    one = scene()
    run = one.runs['subgoal']
    run = replace(run, pictures=[ramp(192)] * 2, subgoals=[replace(
        run.subgoals[0], image=ramp(32))])
    one = replace(one, goal=ramp(128), runs=one.runs | {'subgoal': run})
    left, top, side = one.window
    assert side < 128 and (START > (left, top)).all() and (GOALS < (left + side, top + side)).all()
    goal, subgoal, seen = (picture[-50:].astype(int) for picture in (
        one.headed(GOAL), one.headed(0), one.seen('subgoal', -1)))
    assert np.abs(goal - seen).max() <= 1 and np.abs(goal - subgoal).max() <= 6


def test_rows_are_means_over_scenes_and_say_how_sure_the_gain_is():
    scenes = [scene(seed, direct) for seed, direct in ((7, 0.11), (8, 0.05), (9, 0.03))]
    row, = summary(scenes)
    assert row.cm == pytest.approx((19 / 3, 3)) and row.nearer.value == pytest.approx(10 / 3)
    assert row.reached == (1, 3) and row.more.value == pytest.approx(200 / 3)
    assert row.nearer.low == pytest.approx(0) and row.nearer.high == pytest.approx(8)
    task, together = summary([*scenes, scene(7, 0.03, 'order3')])[::2]
    assert (task.scenes, together.scenes) == (3, 4)
    one, = summary(scenes[:1])
    assert one.texts()[4] == '+8.0' and in_words(one).startswith('One scene, which proves nothing')
    assert results_table(summary(scenes)).splitlines()[2].split()[:4] == [
        'order2', '3', '6.3', '3.0']
    assert [gains(one) for one in scenes] == [True, True, False]
    assert list(shown(scenes[::-1])) == [
        'order2 7: the first scene that succeeds via the subgoal and ends 10 cm off or more '
        'directly']
    assert list(shown(scenes[:0:-1])) == [
        'order2 8: the first scene of this task that succeeds only via the subgoal']


def test_the_page_is_one_file_with_everything_inside(tmp_path):
    path, scenes = tmp_path / 'report.html', [scene(), scene(7, 0.03, '<order3>')]
    films = {caption: film(one) for caption, one in shown(scenes).items()}
    write_report(path, scenes, films, 'made by a test', {'command': 'a <b>'})
    page = path.read_text()
    assert '<dt>command</dt><dd>a &lt;b&gt;</dd>' in page
    assert re.findall('<th scope="row">(.*?)</th>', page) == ['order2', '&lt;order3&gt;',
                                                            'together']
    assert re.findall('<h2>(.*)</h2>', page) == ['order2 7', '&lt;order3&gt; 7']
    assert page.count('src="data:image/') == page.count('<img ') == 2 + 2 * 4
    assert 'http' not in page and page.count('predicted: 1 first') == 2 * 2


@pytest.mark.slow
@needs_browser
def test_the_page_fits_a_desk_and_a_phone(tmp_path):
    path = tmp_path / 'report.html'
    write_report(path, [scene(), scene(7, 0.03, 'order3')], {'one': film(scene())}, 'by a test',
                 {'command': 'python -m tap_ros demo --out ' + 20 * 'a_long_name_'})
    with chromium() as browser:
        for size in ((1280, 800), (375, 812)):
            with opened(browser, path.as_uri(), size) as page:
                assert not hidden_or_over(page, 'h1'), size
                told = page.inner_text('tbody tr')
                assert 'order2' in told and '+8.0' in told


def test_the_film_shows_each_run_to_its_end_and_what_it_heads_for():
    data = film(scene())
    shown, milliseconds = [], []
    for frame in ImageSequence.Iterator(Image.open(io.BytesIO(data))):
        pixels = np.array(frame.convert('L'), int)
        top, bottom = pixels[[2 * (GAP + HEAD) + SIDE - 5, -5]]
        shown.append((top[-4], bottom[-4], top[4], bottom[4]))
        milliseconds.append(frame.info['duration'])
    expected = [(0, 240, 30, 200), (60, 90, 30, 200), (120, 90, 30, 200), (180, 90, 30, 200)]
    assert np.abs(np.subtract(shown, expected)).max() <= 8
    assert milliseconds == [START_MS, FRAME_MS, FRAME_MS, HOLD_MS]


@pytest.mark.parametrize('line, code', [
    ('[INFO] [1.0] [sim_node]: [ERROR]', 0),
    ('[ERROR] [1.0] [sim_node]: service: Traceback (most recent call last):', 1)])
def test_what_was_done_is_kept_what_cannot_be_is_counted_and_logs_are_read(
        line, code, tmp_path, capsys, monkeypatch):
    page = tmp_path / 'demo' / 'report.html'

    def run_scenes(_, folder, __):
        yield scene(7)
        assert '<h2>order2 7</h2>' in page.read_text()
        yield TapError('the reason\nand more')
        (folder / 'logs').mkdir()
        (folder / 'logs' / 'sim_node.log').write_text(line)
        yield scene(9, 0.03)

    monkeypatch.setattr(command, 'run_scenes', run_scenes)
    options = command.Options(scenes=3, tasks=('order2',), seed=7, out=str(page.parent))
    assert command.run(options) == code
    assert (f'2 finished, 1 left out; {code} tracebacks and errors in the logs'
            in capsys.readouterr().out)
    assert 'order2 8: the reason.' in page.read_text()
    rows = json.loads((page.parent / 'scenes.json').read_text())
    assert [row['seed'] for row in rows] == [7, 9]
    assert rows[0]['direct'] == scene(7).runs['direct'].distances.tolist()
    monkeypatch.setattr(command, 'run_scenes', lambda *_: iter([TapError('a reason')]))
    with pytest.raises(TapError, match='no scene could be finished; a reason'):
        command.run(options)


@pytest.mark.ros
def test_no_moment_is_lost_while_the_demo_is_held_up():
    with client.Client('/held_up') as held_up, Client('world', namespace='/held_up') as world:
        watch = Watch(held_up, False, 'camera/image_raw')
        go_on = threading.Event()
        moments = world.create_publisher(ObjectStates, 'objects', STREAM)
        assert until(lambda: moments.get_subscription_count())
        held_up.node.executor.create_task(go_on.wait)
        for sec in range(40):
            moments.publish(ObjectStates(header=Header(stamp=Time(sec=sec))))
            until(lambda: moments.wait_for_all_acked(Duration(seconds=1)))
        go_on.set()
        assert len(watch.since(0, 40, 'objects')) == 40


@pytest.mark.slow
def test_real_nodes_push_tracked_objects_of_two_tasks_with_one_start(tmp_path, capsys):
    assert command.run(command.Options(
        scenes=1, tasks=('push2', 'order2'), step_budget=2, out=str(tmp_path / 'demo'))) == 0
    ends = re.findall(r'(\w+) 2000000 .* in 2 steps, \w+ .* in 2 steps, \w+\n',
                      capsys.readouterr().out)
    assert ends == ['push2', 'order2']
    assert {path.name for path in (tmp_path / 'demo').iterdir()} == {
        'logs', 'recording', 'push2.webp', 'order2.webp', 'report.html', 'scenes.json'}
    with (tmp_path / 'demo' / 'recording' / 'recording_0.mcap').open('rb') as file:
        reader = make_reader(file)
        bag = reader.get_summary()
        sharp = [message.data for _, _, message in reader.iter_messages(['/subgoal/image'])]
    assert sharp and min(map(len, sharp)) > 3 * CAMERA_SIZE ** 2, 'as sharp as the camera'
    recorded = {bag.channels[each].topic for each in bag.statistics.channel_message_counts}
    wanted = set(re.findall(r'": "(/[a-z_/]+)', LAYOUT.read_text()))
    assert len(wanted) > 6 and wanted <= recorded, 'a panel would stay empty'


@pytest.mark.slow
def test_a_scene_ends_the_same_on_a_busy_machine_and_after_a_node_has_ended(tmp_path):
    options = command.Options(scenes=1, tasks=('push2',), step_budget=3)
    nodes = command.NodeSet(options, tmp_path, 'direct', ('push2',))
    try:
        alone = command.run_scene([nodes], 'push2', SEED)
        with crowd(6):
            beside = command.run_scene([nodes], 'push2', SEED)
        assert not isinstance(beside, Exception), beside
        nodes.processes._processes['sim_node'].kill()
        ended = command.run_scene([nodes], 'push2', SEED)
        after = command.run_scene([nodes], 'push2', SEED)
    finally:
        nodes.close()
    assert 'sim_node ended with exit code -9' in str(ended)
    for other in (beside, after):
        assert np.array_equal(other.runs['direct'].distances, alone.runs['direct'].distances)


@pytest.mark.slow
def test_real_nodes_push_in_a_world_of_others_that_says_how_it_ended(tmp_path, capsys):
    pytest.importorskip('metaworld')
    folder = tmp_path / 'demo'
    assert command.run(command.Options(
        scenes=1, tasks=('push-v3',), world='metaworld', robot_mask='arm', step_budget=1,
        out=str(folder))) == 0
    said = capsys.readouterr()
    assert re.search(r'direct .* in 1 steps.*subgoal .* in 1 steps', said.out)
    assert 'the shipped weights know the table alone' in said.err
    assert (folder / 'push-v3.webp').stat().st_size and (folder / 'report.html').stat().st_size
    one = open_recordings([folder / 'recording'])[-1]
    assert (len(one), one.task, one.outcome) == (2, 'push-v3', 'failure')
    moved = one.grippers[1, :3] - one.grippers[0, :3]
    np.testing.assert_allclose(moved, one.actions[0, :3], atol=0.02)
