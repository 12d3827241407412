# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the explorer: real nodes, a real browser, and the page between them."""

from contextlib import contextmanager
from functools import partial
import json
import re
import signal
import time

from action_msgs.msg import GoalStatus, GoalStatusArray
import browsing
from browsing import chromium, needs_browser
from loop import SEED
import numpy as np
from processes import page_address, until
import pytest
from tap_ros.base.contract import SUCCESS_DISTANCE
from tap_ros.ros.topics import STREAM
from websockets.sync.client import connect

pytestmark = pytest.mark.slow


class Explored:
    """All nodes as processes, the explorer among them."""

    def __init__(self, loop):
        self.loop = loop
        loop.start('explorer_node', port=0)
        self.explorer = loop.processes.pop('explorer_node')
        self.url = page_address(self.explorer)

    @contextmanager
    def page(self):
        """Give a function that sends commands, and one that returns the next such state."""
        with connect(self.url.replace('http', 'ws') + 'socket', open_timeout=10) as page:
            def ask(*commands):
                for command in commands:
                    page.send(json.dumps(command))

            def told(accept=lambda state: True):
                deadline = time.monotonic() + 60
                while time.monotonic() < deadline:
                    text = page.recv(30)
                    found = json.loads(text) if isinstance(text, str) else {'kind': 'picture'}
                    assert found['kind'] != 'error', text
                    if found['kind'] == 'state' and accept(found):
                        return found
                raise AssertionError('no such state')

            yield ask, told

    def away(self):
        """Return the greatest distance (m) of an object from its goal."""
        here, goal = self.loop.client.camera(), self.loop.client.goal()
        return np.linalg.norm(here.positions - goal.positions, axis=1).max()


@pytest.fixture(scope='module')
def explored(loop):
    explored = Explored(loop)
    yield explored
    explored.explorer.kill()


@pytest.fixture(scope='module')
def browser():
    with chromium() as browser:
        yield browser


@contextmanager
def opened(browser, url):
    """Open the page; wait for what it shows."""
    with browsing.opened(browser, url) as page:
        page.wait_for_function('state && pictures.camera && pictures.goal')
        yield page


def state(page):
    return json.loads(page.evaluate('JSON.stringify(state)'))


def drag(page, name, u, v):
    """Drag an object of the goal picture to a pixel of it."""
    page.evaluate("look('goal')")
    goal, box = state(page)['goal'], page.locator('#large').bounding_box()
    place = next(each for each in goal['objects'] if each['name'] == name)

    def at(u, v):
        return (box['x'] + (u + 0.5) / goal['width'] * box['width'],
                box['y'] + (v + 0.5) / goal['height'] * box['height'])

    page.mouse.move(*at(place['u'], place['v']))
    page.mouse.down()
    page.mouse.move(*at((place['u'] + u) / 2, (place['v'] + v) / 2))
    page.mouse.move(*at(u, v))
    page.mouse.up()


def reset(page, task='push2', last='scene'):
    page.select_option('#task', task)
    page.fill('#seed', str(SEED))
    before = state(page)['events']
    page.click('#start')
    page.wait_for_function(f'state.events > {before} && events.at(-1).text.startsWith("{last}")')
    page.wait_for_function(
        'state.movable && state.camera.objects.length && !missingGoals().length')


def newest(page):
    return page.evaluate('events.at(-1).text')


@needs_browser
def test_an_object_that_is_dragged_is_brought_there_via_a_subgoal(explored, browser):
    with opened(browser, explored.url) as page:
        reset(page)
        for place, by in zip(state(page)['camera']['objects'], (4.0, 0.0)):  # one is at its goal
            u, v = place['u'] + by, place['v']
            there = f"""state.goal.objects.some(({{name, u, v}}) => (
                name === '{place['name']}' && Math.hypot(u - {u}, v - {v}) < 1.5))"""
            for _ in range(3):  # a busy page can miss one
                drag(page, place['name'], u, v)
                if until(partial(page.evaluate, there), 10):
                    break
            assert page.evaluate(there)
        assert not page.inner_text('#error')
        assert page.evaluate('missingGoals().length') == 0
        assert explored.away() > SUCCESS_DISTANCE
        page.click('#subgoal-run')
        page.wait_for_function('state.run.to_subgoal && state.camera.targets.length === 2'
                               " && /by the subgoal/.test($('hint').textContent)", timeout=120_000)
        page.wait_for_function('pictures.subgoal && pictures.plan', timeout=120_000)
    with opened(browser, explored.url) as page:  # who closes the page stops nothing
        page.wait_for_function('!state.run.running', timeout=240_000)
        if re.search('stood still', newest(page)):  # a busy machine
            page.click('#subgoal-run')
            page.wait_for_function('state.run.running')
            page.wait_for_function('!state.run.running', timeout=240_000)
        assert re.fullmatch(r'via subgoal: .* cm from their goals \(\d+ steps\)',
                            newest(page))
        assert explored.away() < SUCCESS_DISTANCE
        assert 'of an earlier picture' in page.inner_text('#step-predict')
        reset(page)
        page.wait_for_function('!pictures.subgoal && !pictures.plan')
        blank = page.evaluate("""() => ['subgoal', 'plan'].every((kind) => {
            const small = $(`small-${kind}`);
            return small.getContext('2d').getImageData(0, 0, small.width, small.height).data.every(
                (value) => !value);
        })""")
        assert blank, 'nothing of the old scene is shown'
        page.check('#view-plan', force=True)
        assert page.is_hidden('#large') and 'will be here' in page.inner_text('#empty')


@needs_browser
def test_what_cannot_be_done_is_said_moves_nothing_and_is_no_error_of_a_node(explored, browser):
    with opened(browser, explored.url) as page:
        reset(page)
        first, second = state(page)['goal']['objects']
        before = page.locator('#subgoal-run').bounding_box()
        assert page.locator('#step-go button.main').get_attribute('id') == 'subgoal-run'
        for place, why in (
                ((second['u'], second['v']), f'{second["name"]}.* would overlap'),
                ((5, 5), r'out of reach: \d+ cm too far left, \d+ cm too far away; .* 35 cm'),
                ((-9, 90), 'would be outside the picture')):
            problems = state(page)['problem']['count']
            drag(page, first['name'], *place)
            page.wait_for_function(f'state.problem.count > {problems}')
            said = page.inner_text('#error')
            assert re.match(f'the goal was not moved: .*{why}', said) and '/' not in said
            assert page.locator('#subgoal-run').bounding_box() == before, 'nothing moves'
            assert state(page)['goal']['objects'] == [first, second]
            assert page.evaluate('moved') is None
        page.click('#direct')
        page.wait_for_function(r'/step \d+ of at most 80,/.test(state.run.stage)', timeout=120_000)
        page.click('#cancel')
        page.wait_for_function('!state.run.running')
        assert 'cancelled' in newest(page)
        assert page.is_enabled('#cancel') and page.is_enabled('#direct')
        page.wait_for_function("$('direct').matches('.main:enabled')")
        assert page.locator('#step-go button.main').count() == 1, 'what was done last'
        page.click('#cancel')
        page.wait_for_function("/nothing is in progress/.test($('error').textContent)")
        assert not [each for each in state(page)['nodes'] if each['state'] == 'wrong']


@needs_browser
def test_the_weights_follow_the_task(explored, browser):
    with opened(browser, explored.url) as page:
        reset(page, 'grasp', 'the predictor has the weights of grasp')
        assert page.is_disabled('#subgoal-run') and page.is_disabled('#direct')
        assert 'grasp' in page.inner_text('#step-go')
        page.click('#predict')
        page.wait_for_function('events.at(-1).text.startsWith("predicted") && pictures.subgoal')
        page.wait_for_function("events.at(-1).picture.startsWith('data:image/jpeg')")
        reset(page, 'push2', 'the predictor has the weights of push2')
        assert page.is_enabled('#subgoal-run')


@needs_browser
def test_the_page_works_under_its_own_policy(explored, browser):
    page, wrong = browser.new_page(), []
    page.on('console', lambda line: line.type == 'error' and wrong.append(line.text))
    page.goto(explored.url)
    page.get_by_text('the arm stands still', exact=True).wait_for()
    page.click('#nodes summary')
    page.locator('#nodes td', has_text='explorer_node').wait_for()
    assert page.locator('#log').is_visible() and not wrong
    page.close()


def test_a_goal_of_another_client_is_seen_and_can_be_cancelled(explored):
    explored.loop.reset()
    with explored.page() as (ask, told):
        assert not told()['run']['running']
        ask({'do': 'reach', 'mode': 'direct'})  # one of ours before, which is cancelled
        told(lambda now: 'step' in now['run']['stage'])
        ask({'do': 'cancel'})
        told(lambda now: not now['run']['running'])
        reaching = explored.loop.begin(mode='direct', step_budget=1000)
        assert 'another client' in told(lambda now: now['run']['running'])['run']['stage']
        predictor = explored.loop.processes['predictor_node']
        predictor.send(signal.SIGSTOP)
        try:
            count = told()['events']
            ask(*5 * [{'do': 'predict'}], {'do': 'cancel'})  # at once, whatever is waited for
            assert reaching.result().end == 'cancelled'
            assert told()['events'] < count + 5, 'it did not wait for the predictions'
        finally:
            predictor.send(signal.SIGCONT)
        told(lambda now: not now['run']['running'])


def test_a_goal_can_be_cancelled_at_once_and_ends_with_the_explorer(explored):
    statuses = []
    explored.loop.node.create_subscription(
        GoalStatusArray, 'reach_goal/_action/status',
        lambda message: statuses.append(message.status_list[-1].status), STREAM)
    explored.loop.reset()
    reach = {'do': 'reach', 'mode': 'direct'}
    with explored.page() as (ask, told):
        count = told()['events']
        ask(*7 * [{'do': 'predict'}], reach, {'do': 'cancel'})
        told(lambda now: now['events'] >= count + 8 and not now['run']['running'])
        assert GoalStatus.STATUS_SUCCEEDED not in statuses
        ask(reach)
        assert until(lambda: statuses and statuses[-1] == GoalStatus.STATUS_EXECUTING)
        assert explored.explorer.end() == 0
    assert until(lambda: statuses[-1] == GoalStatus.STATUS_CANCELED)
    assert 'internal error' not in explored.explorer.text
