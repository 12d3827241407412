# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the explorer: real nodes, a real browser, and the page between them."""

from contextlib import contextmanager
import json
import os
from pathlib import Path
import re
import shutil
import time

from action_msgs.msg import GoalStatus, GoalStatusArray
import numpy as np
from processes import Client, NodeProcess, page_address
import pytest
from tap_msgs.msg import ObjectStates, Subgoal
from tap_ros.contract import SUCCESS_DISTANCE
from tap_ros.images.drawing import overlay
from tap_ros.messages.subgoals import decode_subgoal
from tap_ros.nodes.clients import Newest
from tap_ros.nodes.topics import LATCHED, STREAM
from websockets.sync.client import connect

BROWSER = next(filter(None, map(shutil.which, (
    'chromium', 'chromium-browser', 'google-chrome'))), None)
SEED = 1_000_003
OPENINGS = 50
needs_browser = pytest.mark.skipif(BROWSER is None, reason='no Chromium is installed')


class Explored:
    """All nodes as processes, and what they publish."""

    def __init__(self, node, folder):
        self.node, self.folder, self.processes = node, folder, {}
        self.started = []
        self.start('sim_node', lock_step='true', task='push2', seed=SEED)
        self.start('predictor_node')
        self.start('visual_mpc_node')
        self.start('explorer_node', port=0)
        self.objects = Newest(node, ObjectStates, 'objects', STREAM)
        self.goals = Newest(node, ObjectStates, 'goal/objects', LATCHED)
        self.subgoal = Newest(node, Subgoal, 'subgoal', LATCHED)
        for process in self.processes.values():
            process.wait_for('ready')
        self.url = page_address(self.processes['explorer_node'])

    def start(self, name, **parameters):
        self.processes[name] = NodeProcess(name, self.folder / f'{name}.log', parameters)
        self.started.append(self.processes[name])

    def statuses(self):
        """Return a list that gets the newest status of the newest goal, again and again."""
        found = []
        self.node.create_subscription(
            GoalStatusArray, 'reach_goal/_action/status',
            lambda message: found.append(message.status_list[-1].status), STREAM)
        return found

    def away(self):
        """Return the distances (m) of the objects from their goals, by name."""
        places, goals = (
            {each.name: each.pose.position for each in topic.wait(10).objects}
            for topic in (self.objects, self.goals))
        return {name: float(np.linalg.norm(
            [getattr(place, axis) - getattr(goals[name], axis) for axis in 'xyz']))
            for name, place in places.items()}


@pytest.fixture(scope='module')
def explored(tmp_path_factory):
    with Client('explorer_test') as node:
        explored = Explored(node, tmp_path_factory.mktemp('explored'))
        try:
            yield explored
        finally:
            for process in explored.started:
                process.kill()


@pytest.fixture(scope='module')
def browser():
    playwright = pytest.importorskip('playwright.sync_api')
    with playwright.sync_playwright() as chromium:
        browser = chromium.chromium.launch(executable_path=BROWSER, args=['--no-sandbox'])
        yield browser
        browser.close()


@contextmanager
def opened(browser, url):
    """Open the page; fail for what its script complains about."""
    # Waiting for an expression evaluates text, which the page's policy forbids.
    page, wrong = browser.new_page(
        viewport={'width': 1280, 'height': 900}, bypass_csp=True), []
    page.on('pageerror', lambda error: wrong.append(str(error)))
    page.on('console', lambda line: line.type == 'error' and wrong.append(line.text))
    page.goto(url)
    page.wait_for_function('state && pictures.camera && pictures.goal')
    yield page
    page.close()
    assert not wrong


def state(page):
    return json.loads(page.evaluate('JSON.stringify(state)'))


def drag(page, name, u, v):
    """Drag an object of the goal picture to a pixel of it."""
    goal, box = state(page)['goal'], page.locator('#goal').bounding_box()
    place = next(each for each in goal['objects'] if each['name'] == name)

    def at(u, v):
        return (box['x'] + (u + 0.5) / goal['width'] * box['width'],
                box['y'] + (v + 0.5) / goal['height'] * box['height'])

    page.mouse.move(*at(place['u'], place['v']))
    page.mouse.down()
    page.mouse.move(*at((place['u'] + u) / 2, (place['v'] + v) / 2))
    page.mouse.move(*at(u, v))
    page.mouse.up()


def reset(page, seed=SEED):
    page.fill('#seed', str(seed))
    before = state(page)['log_count']
    page.click('#scene button')
    page.wait_for_function(f'state.log_count > {before} && state.log.at(-1).startsWith("reset")')
    page.wait_for_function('state.movable')


def wait_until_idle(page, seconds=240):
    page.wait_for_function('state.run.running')
    page.wait_for_function('!state.run.running', timeout=1000 * seconds)


def wait_until(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@needs_browser
def test_an_object_that_is_dragged_is_brought_there_via_a_subgoal(explored, browser):
    with opened(browser, explored.url) as page:
        reset(page)
        place, other = state(page)['goal']['objects']
        u, v = place['u'] + 3.0, place['v'] - 3.0
        drag(page, place['name'], u, v)
        page.wait_for_function(f'Math.abs(state.goal.objects[0].u - {u}) < 1.5')
        moved = state(page)['goal']['objects']
        assert moved[0]['v'] == pytest.approx(v, abs=1.5) and moved[1] == other
        assert not page.is_visible('#error')
        page.click('#subgoal-run')
        page.wait_for_function('pictures.subgoal && pictures.plan', timeout=120_000)
        wait_until_idle(page)
        assert max(explored.away().values()) < SUCCESS_DISTANCE
        shown = page.inner_text('#legend')
        assert len(re.findall(r'\d cm', shown)) == 2
        assert any(line.startswith('via subgoal: ') and 'steps' in line
                   for line in state(page)['log'])


@needs_browser
def test_a_second_browser_sees_the_same(explored, browser):
    with opened(browser, explored.url) as page, opened(browser, explored.url) as other:
        reset(page)
        page.click('#predict')
        page.wait_for_function('state.log.at(-1).startsWith("predicted")')
        count = state(page)['log_count']
        other.wait_for_function(f'state.log_count >= {count} && pictures.subgoal')
        page.wait_for_function('pictures.subgoal')
        first, second = ({**state(each), 'diagnostics': None} for each in (page, other))
        assert first == second
        for kind in ('camera', 'goal', 'subgoal'):
            seen = [each.evaluate(f'document.getElementById("{kind}").toDataURL()')
                    for each in (page, other)]
            assert seen[0] == seen[1] and len(seen[0]) > 1000


@needs_browser
def test_the_subgoal_shown_is_the_predicted_picture_with_its_maps(explored, browser):
    with opened(browser, explored.url) as page:
        reset(page)
        stamp = explored.objects.wait(10).header.stamp
        page.click('#predict')
        message = explored.subgoal.wait(60, lambda message: message.header.stamp == stamp)
        one = decode_subgoal(message, message.object_names, (64, 64))
        expected = overlay(one.image, one.object_maps)
        assert np.abs(expected.astype(int) - one.image).max() > 50, 'the maps are seen'

        page.wait_for_function('pictures.subgoal')

        def shown():
            values = page.evaluate("""() => {
                const context = new OffscreenCanvas(64, 64).getContext('2d');
                context.drawImage(pictures.subgoal, 0, 0);
                return Array.from(context.getImageData(0, 0, 64, 64).data);
            }""")
            return np.reshape(values, (64, 64, 4))[..., :3]
        wait_until(lambda: np.array_equal(shown(), expected))


@needs_browser
def test_samples_and_recursion_are_asked_for(explored, browser):
    with opened(browser, explored.url) as page:
        page.locator('#levels').fill('3')
        assert page.inner_text('output[for=levels]') == '3'
        page.click('#predict')
        page.wait_for_function('state.subgoal_note === "3 subgoals"')
        wide, high = page.evaluate('[pictures.subgoal.width, pictures.subgoal.height]')
        assert wide > 2.5 * high, 'all three side by side'


@needs_browser
def test_what_cannot_be_done_is_said_and_changes_nothing(explored, browser):
    with opened(browser, explored.url) as page:
        reset(page)
        first, second = state(page)['goal']['objects']
        drag(page, first['name'], second['u'], second['v'])
        page.wait_for_selector('#error:visible')
        assert 'sim/set_goal' in page.inner_text('#error')
        assert state(page)['goal']['objects'] == [first, second]
        assert page.evaluate('moved') is None


@needs_browser
def test_closing_the_browser_stops_nothing_and_cancel_does(explored, browser):
    with opened(browser, explored.url) as page:
        reset(page)
        page.click('#direct')
        page.wait_for_function('state.run.running && /step [2-9]/.test(state.run.stage)',
                               timeout=120_000)
        step = int(re.search(r'step (\d+)', state(page)['run']['stage'])[1])
    with opened(browser, explored.url) as page:
        page.wait_for_function(
            f'Number((state.run.stage.match(/step (\\d+)/) ?? [0, 0])[1]) > {step}')
        page.click('#cancel')
        page.wait_for_function('!state.run.running')
        assert 'cancelled' in state(page)['log'][-1]
        assert page.is_disabled('#cancel') and page.is_enabled('#direct')


@needs_browser
def test_the_page_works_under_its_own_policy(explored, browser):
    page, wrong = browser.new_page(), []
    page.on('console', lambda line: line.type == 'error' and wrong.append(line.text))
    page.goto(explored.url)
    page.get_by_text('connected', exact=True).wait_for()
    page.locator('#legend li').first.wait_for()
    page.locator('#diagnostics td', has_text='explorer_node').wait_for()
    assert page.locator('#log').is_visible() and not wrong
    page.close()


@needs_browser
def test_many_openings_leave_nothing_behind(explored, browser):
    pid = explored.processes['explorer_node'].process.pid

    def held():
        threads = int(re.search(r'Threads:\s+(\d+)', Path(
            f'/proc/{pid}/status').read_text())[1])
        memory = int(re.search(r'VmRSS:\s+(\d+)', Path(f'/proc/{pid}/status').read_text())[1])
        return threads, len(os.listdir(f'/proc/{pid}/fd')), memory

    def settle(count):
        """Wait until browsers are gone and what was held for them is let go."""
        deadline = time.monotonic() + 20
        while held()[1] > count and time.monotonic() < deadline:
            time.sleep(0.1)
        return held()

    for _ in range(3):  # what is loaded at the first openings stays
        with opened(browser, explored.url):
            pass
    time.sleep(2)  # until the last one is let go
    threads, files, memory = held()
    for _ in range(OPENINGS):
        with opened(browser, explored.url):
            pass
    after = settle(files)
    assert after[0] <= threads + 1 and after[1] <= files + 1
    assert after[2] <= memory + 20_000, 'kB'


def test_a_goal_that_was_begun_ends_with_the_explorer(explored):
    explored.start('explorer_node', port=0)  # another one; it ends here
    explorer = explored.processes['explorer_node'].wait_for('ready')
    statuses = explored.statuses()
    url = page_address(explorer).replace('http', 'ws') + 'socket'
    with connect(url, open_timeout=10) as page:
        page.send('{"do": "reach", "mode": "direct", "samples": 1, "levels": 1, "seed": 0}')
        wait_until(lambda: GoalStatus.STATUS_EXECUTING in statuses)
        assert explorer.end() == 0
    wait_until(lambda: statuses[-1] == GoalStatus.STATUS_CANCELED)
    assert 'internal error' not in explorer.text


def test_a_goal_can_be_cancelled_at_once_and_while_others_wait(explored):
    explored.start('explorer_node', port=0)
    explorer = explored.processes['explorer_node'].wait_for('ready')
    statuses = explored.statuses()
    url = page_address(explorer).replace('http', 'ws') + 'socket'
    with connect(url, open_timeout=10) as page:
        for _ in range(7):
            page.send('{"do": "predict", "samples": 1, "levels": 4, "seed": 0}')
        page.send('{"do": "reach", "mode": "direct", "samples": 1, "levels": 1, "seed": 0}')
        page.send('{"do": "cancel"}')
        log = []
        while not any(line.startswith('direct: cancelled') for line in log):
            text = page.recv(30)
            assert not (isinstance(text, str) and json.loads(text)['kind'] == 'error'), text
            if isinstance(text, str):
                log = json.loads(text).get('log', log)
    assert GoalStatus.STATUS_SUCCEEDED not in statuses
    assert explorer.end() == 0
