# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the explorer's page beside a camera, in a real browser, at a desk and on a phone."""

from browsing import chromium, hidden_or_over, needs_browser, opened
from geometry_msgs.msg import Point, Point32, Polygon
import numpy as np
from processes import Client, LocalNode, until
import pytest
from sensor_msgs.msg import Image
from tap_msgs.msg import Episode, ObjectStates
from tap_msgs.msg import Subgoal as SubgoalMessage
from tap_msgs.srv import ResetScene, SelectObjects
from tap_ros.apps.explorer.node import ExplorerNode
from tap_ros.base.contract import CAMERA_FRAME
from tap_ros.messages.subgoals import Subgoal
from tap_ros.ros.topics import (
    encode_image,
    encode_objects,
    encode_subgoal,
    LATCHED,
    STREAM,
    to_stamp,
)
from visualization_msgs.msg import ImageMarker

pytestmark = [pytest.mark.slow, needs_browser]
WIDE, HIGH = 320, 240
DESK, PHONE = (1280, 800), (390, 844)
CUP, RING = (60.0, 80.0), (250.0, 190.0)
OUTLINE, TURNED = ((-9.0, -9.0), (9.0, -9.0), (0.0, 9.0)), ((9.0, -9.0), (9.0, 9.0), (-9.0, 0.0))
LIVE = """() => [...document.querySelectorAll('button:enabled')].filter(
    (one) => one.offsetParent && !one.closest('h2')).map((one) => one.id)"""

WHOLE = """(selector) => [...document.querySelectorAll(selector)].every((one) =>
    one.scrollHeight <= one.clientHeight && one.scrollWidth <= one.clientWidth)"""


class Camera:
    """A camera, and a tracker of another make."""

    def __init__(self, node):
        self._pictures = node.create_publisher(Image, 'camera/image_raw', STREAM)
        self._objects = node.create_publisher(ObjectStates, 'objects', STREAM)
        self._outlines = node.create_publisher(ImageMarker, 'objects/outlines', STREAM)
        self.turned = False
        self._image = np.full((HIGH, WIDE, 3), 90, np.uint8)
        self._stamp, self.selected = 10**9, None
        node.create_timer(0.1, self._send)
        self.service = node.create_service(SelectObjects, 'select_objects', self._select)

    def _send(self):
        self._stamp += 10**8
        self._pictures.publish(encode_image(self._image, to_stamp(self._stamp), CAMERA_FRAME))
        if self.selected is not None:
            message = self._encode()
            message.states = ['seen', 'hidden'][:len(message.objects)]
            message.confidence = [0.9] * len(message.objects)
            for one in message.objects if self.turned else ():
                self._outlines.publish(ImageMarker(header=message.header, ns=one.name, points=[
                    Point(x=one.u + du, y=one.v + dv) for du, dv in TURNED]))
            self._objects.publish(message)

    def _encode(self):
        asked = self.selected
        return encode_objects(asked.names, np.column_stack([asked.u, asked.v]), None,
                              to_stamp(self._stamp), CAMERA_FRAME, ObjectStates.SOURCE_TRACKED)

    def _select(self, request, response):
        if 'thumb' in request.names:
            response.message = 'thumb is on nothing; click on an object'
            return response
        self.selected, response.success = request, True
        response.objects = self._encode().objects
        response.outlines = [Polygon(points=[
            Point32(x=u + du, y=v + dv) for du, dv in OUTLINE])
            for u, v in zip(request.u, request.v)]
        return response


@pytest.fixture(scope='module')
def browser():
    with chromium() as browser:
        yield browser


@pytest.fixture
def explorer():
    explorer = LocalNode(ExplorerNode, port=0)
    yield explorer
    assert explorer.end() == 0


def at(page, u, v):
    """Return where a pixel of the large picture is on the page."""
    box = page.locator('#large').bounding_box()
    return (box['x'] + (u + 0.5) / WIDE * box['width'],
            box['y'] + (v + 0.5) / HIGH * box['height'])


def says(page, step):
    return page.inner_text(f'#step-{step} > span')


@pytest.mark.parametrize(('size', 'scheme'), [(DESK, 'light'), (PHONE, 'dark')])
def test_each_step_is_in_sight_says_what_it_waits_for_and_offers_nothing_too_early(
        explorer, browser, size, scheme):
    with opened(browser, explorer.node.url, size, color_scheme=scheme) as page:
        page.wait_for_function('state')
        assert says(page, 'scene') == 'waits for the camera' and page.evaluate(LIVE) == ['cancel']
        assert 'will be here' in page.inner_text('#empty') and page.is_hidden('#large')
        for kind in ('goal', 'subgoal', 'plan'):
            page.check(f'#view-{kind}', force=True)
            assert 'will be here' in page.inner_text('#empty')
        page.check('#view-camera', force=True)
        assert not hidden_or_over(page, 'header', '#stage', '#said', '#views', '#steps')
        assert 'what to reach: step 3' in page.inner_text('#views')
        assert page.evaluate(WHOLE, '#views label, #views small')
        with Client('camera') as node:
            camera = Camera(node)
            page.wait_for_function('pictures.camera && state.tracker && state.camera.width')
            assert page.evaluate('[pictures.camera.width, pictures.camera.height]') == [WIDE, HIGH]
            page.wait_for_selector('#step-objects[aria-current=step]')
            assert says(page, 'objects') == 'waits for objects: click on them'
            assert says(page, 'go') == 'needs objects: step 2'
            assert 'follow' not in page.evaluate(LIVE)
            assert not hidden_or_over(page, '#stage', '#said', '#views', '#follow', '#cancel')
            for place in (CUP, RING):
                page.mouse.click(*at(page, *place))
            assert not hidden_or_over(
                page, '#stage', '#said', '#views', '#clicks', '#follow', '#cancel')
            before = page.locator('#follow').bounding_box()
            page.fill('#clicks li:last-child input', 'thumb')
            page.click('#follow')
            page.wait_for_selector('#error:not(:empty)')
            assert page.inner_text('#error') == (
                'not taken: thumb is on nothing; leave it out (✕), or click on an object')
            assert page.locator('#follow').bounding_box() == before, 'nothing moves'
            page.fill('#clicks li:last-child input', 'ring')
            page.click('#follow')
            assert until(lambda: camera.selected is not None)
            assert list(camera.selected.names) == ['object_0', 'ring']
            clicked = np.column_stack([camera.selected.u, camera.selected.v])
            assert np.abs(clicked - (CUP, RING)).max() < 1, 'pixels of the camera'
            page.wait_for_selector('#step-goal[aria-current=step]')
            assert says(page, 'objects') == '2 objects known' and not page.inner_text('#error')
            assert 'ring: hidden, 90%' in page.inner_text('#clicks')
            assert not hidden_or_over(page, '#stage', '#said', '#views', '#photograph', '#cancel')
            page.click('#photograph')
            page.wait_for_function('pictures.goal && state.goal.pictured')
            page.wait_for_function('events.length && events.at(-1).picture')
            assert says(page, 'predict') == 'needs the goal of object_0, ring: step 3'
            assert not {'predict', 'direct', 'subgoal-run'} & {*page.evaluate(LIVE)}
            page.reload()
            page.wait_for_function(
                "$('hint').textContent.startsWith('No goal known yet for: object_0, ring.')")
            assert says(page, 'goal') == 'drag object_0, ring to their goals'
        page.wait_for_function("/silent/.test($('step-scene').textContent)")
        assert 'photograph' not in page.evaluate(LIVE)


def turned(page, name):
    """Return the outline of an object as the page draws it, relative to the object."""
    return page.evaluate(f'outlines.{name}')


def test_outlines_turn_with_objects_and_a_goal_that_is_moved_is_not_gone_on_to(explorer, browser):
    with opened(browser, explorer.node.url) as page, Client('camera') as node:
        camera = Camera(node)
        page.wait_for_function('pictures.camera && state.tracker && state.camera.width')
        page.mouse.click(*at(page, *CUP))
        assert page.inner_text('#follow') == 'use this object'
        page.click('#follow')
        page.wait_for_function('outlines.object_0 && state.camera.objects.length')
        assert np.abs(np.subtract(turned(page, 'object_0'), OUTLINE)).max() < 0.11
        camera.turned = True
        page.wait_for_function('outlines.object_0[0][0] > 0')
        assert np.abs(np.subtract(turned(page, 'object_0'), TURNED)).max() < 0.11
        page.click('#photograph')
        for go_on, place in ((False, RING), (True, CUP)):
            page.wait_for_function("pictures.goal && state.movable === 'goal'")
            page.evaluate("look('goal')")
            if go_on:
                explorer.node._calls.forget_end('via subgoal: stopped', spent=True)
                page.wait_for_function("/^go on/.test($('direct').textContent)")
            begin = page.evaluate('goalPlaces()[0]')
            page.mouse.move(*at(page, begin['u'], begin['v']))
            page.mouse.down()
            page.mouse.move(*at(page, *place))
            page.mouse.up()
            page.wait_for_function(
                f'state.goal.objects.some(({{u}}) => Math.abs(u - {place[0]}) < 2)')
        page.wait_for_function("/^go directly/.test($('direct').textContent)")
        assert says(page, 'go') == 'needs the planner, which does not run'
        assert says(page, 'predict') == 'needs the predictor, which does not run'
        page.set_viewport_size(dict(zip(('width', 'height'), PHONE)))
        page.evaluate("showRun('step 3 of at most 80, to the subgoal', 'busy')")
        assert page.evaluate("$('run').scrollWidth <= $('run').clientWidth")
        assert not hidden_or_over(page, '#run', '#cancel', '#stage')


def test_a_subgoal_says_what_it_is_undecided_about_and_goes_when_others_are_followed(
        explorer, browser):
    maps = np.zeros((1, 64, 64), np.float32)
    maps[0, 10, 10] = maps[0, 50, 50] = 0.5
    predicted = Subgoal(np.full((HIGH, WIDE, 3), 60, np.uint8), maps,
                        np.float32([[30, 30]]), np.ones(1, np.float32), 0, 1)
    with opened(browser, explorer.node.url) as page, Client('camera') as node:
        Camera(node)
        publisher = node.create_publisher(SubgoalMessage, 'subgoal', LATCHED)
        page.wait_for_function('pictures.camera && state.tracker && state.camera.width')
        for again in (False, True):
            if again:
                page.click('#again')
            page.mouse.click(*at(page, *CUP))
            page.click('#follow')
            page.wait_for_function('!selecting() && state.camera.objects.length')
            page.wait_for_function('!pictures.subgoal')
            if not again:
                publisher.publish(encode_subgoal(
                    predicted, ['object_0'], to_stamp(2 * 10**9), CAMERA_FRAME))
                page.wait_for_function('pictures.subgoal && state.subgoal')
                assert says(page, 'predict') == 'undecided about object_0'
                page.evaluate("look('camera')")
                calls = explorer.node._calls
                calls._asked = calls.to_subgoal = True  # as a goal does that is under way
                page.wait_for_function('state.camera.targets.length')
                target, = page.evaluate('state.camera.targets')
                assert target == {'name': 'object_0', 'u': 30.0, 'v': 30.0}
                assert 'Crosses: where they go first, by the subgoal.' in page.inner_text('#hint')
                calls.to_subgoal = False
                page.wait_for_function('!state.run.to_subgoal && !state.camera.targets.length')
                assert 'subgoal' not in page.inner_text('#hint')
                calls._asked = False
                page.wait_for_function('!state.run.running')


@pytest.mark.parametrize('size', [DESK, PHONE])
def test_what_happened_and_what_went_wrong_can_be_read_whole(explorer, browser, size):
    with opened(browser, explorer.node.url, size) as page:
        page.wait_for_function('state')
        for k in range(9):
            explorer.node._display.events.add(f'{k}: {60 * "words "}', problem=True)
        page.wait_for_function("events.length === 9 && $('error').textContent.startsWith('8: ')")
        assert page.evaluate(WHOLE, '#said, #log p') and page.locator('#log p').count() == 9
        page.locator('#log p').last.scroll_into_view_if_needed()
        assert page.locator('#log p').last.bounding_box()['y'] < size[1]
        assert not hidden_or_over(page, '#log')


def test_beside_a_camera_alone_the_page_says_what_to_start(explorer, browser):
    with opened(browser, explorer.node.url) as page, Client('camera') as node:
        camera = Camera(node)
        node.destroy_service(camera.service)
        page.wait_for_function('pictures.camera && !state.tracker && state.camera.width')
        page.wait_for_function("$('hint').textContent")
        assert says(page, 'objects') == 'waits for objects: start tracker_node'
        assert page.inner_text('#hint') == 'Start tracker_node to click on objects here.'


def test_a_scene_that_began_before_is_not_known_until_it_is_told(explorer, browser):
    with opened(browser, explorer.node.url) as page, Client('sim_node') as node:
        camera = Camera(node)
        node.create_service(ResetScene, 'sim/reset', lambda _, answer: answer)
        episodes = node.create_publisher(Episode, 'episode', STREAM)
        page.wait_for_function('pictures.camera && state.simulator && state.camera.width')
        page.wait_for_selector('#step-objects[aria-current=step]')
        assert camera and not says(page, 'scene') and page.is_disabled('#start')
        assert page.locator('#step-scene.done').count() == 0
        assert [page.input_value(one) for one in ('#task', '#seed')] == ['', '']
        page.select_option('#task', 'stack2')
        page.fill('#seed', '3')
        assert page.is_enabled('#start')
        assert until(episodes.get_subscription_count)
        episodes.publish(Episode(event=Episode.START, task='push2', seed=5))
        page.wait_for_selector('#step-scene.done')
        assert says(page, 'scene') == 'push2, seed 5'
        assert [page.input_value(one) for one in ('#task', '#seed')] == ['push2', '5']


def test_keys_and_a_screen_reader_reach_all_that_a_pointer_does(explorer, browser):
    with opened(browser, explorer.node.url) as page, Client('camera') as node:
        camera = Camera(node)
        page.wait_for_function('pictures.camera && state.tracker && state.camera.width')
        page.focus('#large')
        for key, times in (('Shift+ArrowLeft', 3), ('ArrowUp', 2), ('Enter', 1)):
            for _ in range(times):
                page.keyboard.press(key)
        for _ in range(40):
            if page.evaluate('document.activeElement.id') == 'follow':
                break
            page.keyboard.press('Tab')
        page.keyboard.press('Enter')
        assert until(lambda: camera.selected is not None)
        assert np.allclose([camera.selected.u[0], camera.selected.v[0]],
                           [WIDE / 2 - 0.15 * WIDE, HIGH / 2 - 0.01 * WIDE], atol=1)
        page.wait_for_selector('#step-goal[aria-current=step]')
        told = page.locator('body').aria_snapshot()
        for name in ('application "now', 'radio "subgoal"', 'button "cancel"', 'status "',
                     'list "objects"', 'list "What happened"', 'button "photograph the goal"'):
            assert name in told, told
        unnamed = page.evaluate("""() => [...document.querySelectorAll('button, input, select')]
            .filter((one) => one.offsetParent && !(one.textContent || one.ariaLabel
                || one.labels?.length)).map((one) => one.outerHTML)""")
        assert not unnamed
