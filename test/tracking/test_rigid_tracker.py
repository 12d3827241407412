# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of following clicked objects, on pictures of one drawn table."""

from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.world.looks import LOOKS
from sim_bridge.world.table import lifted
from tap_ros.base.contract import HIDDEN, LOST, SEEN, UNSURE
from tap_ros.base.errors import TrackingError
from tap_ros.base.plugins import load_plugin
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking import proposals
from tap_ros.tracking.plane import check_pose, TOP
from tap_ros.tracking.proposals import propose
from tap_ros.tracking.protocols import View
from tap_ros.tracking.silhouette import silhouette

SIZE = 256
COLOURS = (((200, 60, 60), (60, 90, 200)), ((70, 170, 70), (220, 210, 80)))  # halves of objects
STARTS = ((80.0, 100.0), (170.0, 150.0))


def table(size=SIZE):
    """Return a picture of a wooden table."""
    rng = np.random.default_rng(0)
    grain = cv2.GaussianBlur(rng.normal(0, 30, (SIZE, SIZE)).astype(np.float32), (0, 0), 3)
    picture = (np.array([150, 120, 80]) + grain[..., None]).clip(0, 255).astype(np.uint8)
    return cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA)


def draw(places, angles=(0, 0), size=SIZE, robot=None):
    """Return a View of two bars of two colours; robot: (u0, v0, u1, v1) that it hides."""
    picture, scale = table(size), size / SIZE
    for k, ((u, v), angle) in enumerate(zip(places, angles)):
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]])
        for half, colour in zip((-1, 1), COLOURS[k]):
            corners = [np.array([u, v]) + half * 14 * i * along + 8 * j * across
                       for i, j in ((0, -1), (1, -1), (1, 1), (0, 1))]
            cv2.fillConvexPoly(picture, np.rint((np.array(corners) + 0.5) * scale * 16 - 8).astype(
                np.int32), colour, cv2.LINE_AA, 4)
    mask = np.zeros((size, size), np.uint8)
    if robot is not None:
        u0, v0, u1, v1 = (round(x * scale) for x in robot)
        picture[v0:v1, u0:u1], mask[v0:v1, u0:u1] = 40, 255
    return View(picture, mask)


def demonstrated(task, seed, **options):
    """Return a simulated Episode of 256 px, and a tracker with its camera."""
    simulator = Simulator(task, 256, **options)
    try:
        return simulator.demonstrate(seed).episode, load_plugin('tap_ros.trackers', 'rigid')(
            PinholeCamera(simulator.camera_matrix, (256, 256), simulator.camera_pose))
    finally:
        simulator.close()


@pytest.fixture
def tracker():
    made = load_plugin('tap_ros.trackers', 'rigid')(None)
    made.select(draw(STARTS), STARTS)
    return made


def test_moved_and_turned_objects_are_followed(tracker):
    for step in range(8):
        places = np.array(STARTS) + step * np.array([[4, 2], [-3, 1]])
        found = tracker.update(draw(places, (0.12 * step, -0.1 * step)))
    assert found.states == (SEEN, SEEN) and found.confidence.min() > 0.5
    assert np.abs(found.pixels - places).max() < 1.5


def test_what_is_hidden_is_said_to_be_and_found_where_it_comes_out(tracker):
    robot = (50, 70, 120, 130)
    for _ in range(3):
        found = tracker.update(draw(STARTS, robot=robot))
    assert found.states == (HIDDEN, SEEN)
    assert found.pixels[0] == pytest.approx(STARTS[0], abs=1.5)
    moved = ((95.0, 108.0), STARTS[1])
    for _ in range(3):
        found = tracker.update(draw(moved, (0.4, 0)))
    assert found.states == (SEEN, SEEN) and np.abs(found.pixels - moved).max() < 1.5


@pytest.mark.parametrize('turn', [2.0, 2.4])
def test_what_turned_while_half_of_it_was_hidden_is_found_as_it_is(tracker, turn):
    for step in (1, 2, 3):
        tracker.update(draw(STARTS, (turn * step / 3, 0), robot=(76, 80, 120, 130)))
    found = tracker.update(draw(STARTS, (turn, 0)))
    assert found.states == (SEEN, SEEN) and np.abs(found.pixels - STARTS).max() < 0.7


def test_what_the_hand_pushes_unseen_goes_along_with_it():
    high, middle = 10.0, SIZE / 2  # m above the table, of a camera that shows 160 px a metre; px
    focal = 160 * (high - TOP)
    pose = np.diag([1.0, -1, -1, 1])
    pose[2, 3] = high
    tracker = load_plugin('tap_ros.trackers', 'rigid')(PinholeCamera(np.array(
        [[focal, 0, middle], [0, focal, middle], [0, 0, 1]]), (SIZE, SIZE), pose))
    tracker.select(draw(STARTS), STARTS)
    u, v = STARTS[0]
    for step in range(10):
        hand = u - 40 + 8 * step
        place = max(u, hand + 14 + 3.2)  # halves of the bar and of the fingers, px
        view = draw(((place, v), STARTS[1]), robot=(place - 40, 60, place + 25, 140))
        found = tracker.update(replace(view, gripper=np.array(
            [hand - middle, middle - v, 0.8, 0]) / 160))
    assert found.states == (HIDDEN, SEEN)
    assert found.pixels[0] == pytest.approx((place, v), abs=2)
    view = draw(((place, v), STARTS[1]), robot=(0, 0, 40, 140))
    assert tracker.update(replace(view, gripper=np.array([0, 0, 16, 0]) / 160)).states == (
        SEEN, SEEN)


def test_what_is_gone_is_unsure_and_then_lost(tracker):
    states = [tracker.update(draw(STARTS[:1], (0,))).states for _ in range(4)]
    assert states == [(SEEN, UNSURE)] * 2 + [(SEEN, LOST)] * 2


@pytest.mark.parametrize('click', [(300, 20), (85, 60), (20, 220), (np.nan, 3)])
def test_a_click_on_no_object_is_refused_and_those_before_are_followed(tracker, click):
    with pytest.raises(TrackingError):
        tracker.select(draw(STARTS, robot=(70, 40, 100, 80)), [STARTS[0], click])
    found = tracker.update(draw(STARTS))
    assert found.states == (SEEN, SEEN) and np.abs(found.pixels - STARTS).max() < 1.5


def pale(where, lighter):
    """Return a View of a bar that is only lighter than the table, by levels of 255."""
    picture = table()
    (u, v), bar = where, np.s_[-8:9, -16:17]
    window = picture[int(v) + bar[0].start:int(v) + bar[0].stop,
                     int(u) + bar[1].start:int(u) + bar[1].stop]
    window[:] = (np.array([150, 120, 80]) + lighter).clip(0, 255)
    return View(picture, np.zeros((SIZE, SIZE), np.uint8))


@pytest.mark.parametrize('lighter', [40, 60])
def test_what_is_only_lighter_than_the_table_is_followed(lighter):
    tracker = load_plugin('tap_ros.trackers', 'rigid')(None)
    found = tracker.select(pale((100, 90), lighter), [(103.0, 92.0)])
    assert np.abs(found.pixels - (100, 90)).max() < 2
    for step in range(5):
        found = tracker.update(pale((100 + 4 * step, 90 + 3 * step), lighter))
    assert found.states == (SEEN,) and np.abs(found.pixels - (116, 102)).max() < 2


def test_half_an_object_keeps_near_the_click_until_it_is_seen_whole():
    robot, tracker = (82, 70, 130, 130), load_plugin('tap_ros.trackers', 'rigid')(None)
    found = tracker.select(draw(STARTS, robot=robot), [(79.0, 101.0), STARTS[1]])
    half = (66 + 82) / 2  # the middle of what is seen, px
    assert found.pixels[0, 0] > half + 2 and found.confidence[0] < found.confidence[1]
    found = tracker.update(draw(STARTS))
    assert np.abs(found.pixels - STARTS).max() < 1 and found.confidence.min() > 0.9


@pytest.mark.parametrize('robots', [(79,), (84, 85), (86, 90, 100)])
def test_a_part_is_corrected_when_the_robot_has_left_also_step_by_step(robots):
    """It hides the bar from so many px on, first more than half of it."""
    def seen(u):
        return draw(STARTS, robot=None if u is None else (u, 70, 130, 130))

    tracker = load_plugin('tap_ros.trackers', 'rigid')(None)
    tracker.select(seen(robots[0]), [(77.0, 101.0), STARTS[1]])
    for u in (*robots[1:], *[None] * 5):
        found = tracker.update(seen(u))
    assert np.abs(found.pixels - STARTS).max() < 1 and found.confidence.min() > 0.9


def test_a_part_is_corrected_also_where_another_object_has_its_colours(monkeypatch):
    monkeypatch.setitem(globals(), 'COLOURS', (COLOURS[0], (COLOURS[0][1], COLOURS[1][1])))
    tracker = load_plugin('tap_ros.trackers', 'rigid')(None)
    tracker.select(draw(STARTS, robot=(80, 70, 130, 130)), [(77.0, 101.0), STARTS[1]])
    for _ in range(6):
        found = tracker.update(draw(STARTS))
    assert np.abs(found.pixels - STARTS).max() < 1 and found.confidence.min() > 0.9


@pytest.mark.parametrize('task, seed, clicks', [
    ('push2', 1_210_027, [(196.0, 91.5), (186.7, 148.7)]), ('order2', 1_210_023, None)])
def test_a_part_that_the_hand_is_far_above_is_corrected_and_takes_in_no_other(task, seed, clicks):
    """Also where its side looks like a shadow, or the other one is hidden, too."""
    episode, tracker = demonstrated(task, seed, look='arm')
    views = [View(*seen) for seen in zip(episode.frames, episode.robot_masks, episode.grippers)]
    tracker.select(views[0], episode.object_pixels[0] if clicks is None else clicks)
    for view in views[1:16]:
        found = tracker.update(view)
    assert np.abs(found.pixels - episode.object_pixels[15]).max() < 2


def test_a_robot_as_grey_as_the_table_may_hide_a_part():
    grey = np.full((SIZE, SIZE, 3), 170, np.uint8)
    mask = np.zeros((SIZE, SIZE), np.uint8)
    cv2.rectangle(grey, (66, 92), (93, 107), (200, 60, 60), -1)
    half = grey.copy()
    half[70:130, 80:130], mask[70:130, 80:130] = 120, 255
    tracker = load_plugin('tap_ros.trackers', 'rigid')(None)
    assert tracker.select(View(half, mask), [(78.0, 100.0)]).confidence[0] < 0.9
    found = tracker.update(View(grey, np.zeros_like(mask)))
    assert np.abs(found.pixels - (79.5, 99.5)).max() < 1 and found.confidence[0] > 0.9


def test_of_two_alike_that_touch_one_click_selects_neither_surely():
    picture = table()
    cv2.rectangle(picture, (66, 92), (94, 124), (200, 60, 60), -1)
    found = load_plugin('tap_ros.trackers', 'rigid')(None).select(View(picture), [(80.0, 98.0)])
    assert found.confidence[0] < 0.9


@pytest.mark.parametrize('below, blur', [(116, 0), (130, 0.7)])
def test_what_borders_the_shadow_of_the_robot_is_seen_whole(below, blur):
    view = draw(STARTS)
    for shadow in (np.s_[80:116, 95:130], np.s_[109:below, 60:130]):
        view.image[shadow] = 0.6 * view.image[shadow]
        view.robot_mask[shadow] = 255
    if blur:
        view.image[:] = cv2.GaussianBlur(view.image, (0, 0), blur)
    found = load_plugin('tap_ros.trackers', 'rigid')(None).select(view, [(77.0, 98.0), STARTS[1]])
    assert np.abs(found.pixels - STARTS).max() < 1


def test_what_the_edge_of_the_picture_cuts_is_not_surely_known_and_followed():
    places = ((6.0, 100.0), STARTS[1])
    tracker = load_plugin('tap_ros.trackers', 'rigid')(None)
    found = tracker.select(draw(places), [(9.0, 100.0), STARTS[1]])
    assert found.confidence[0] < 0.9 <= found.confidence[1]
    assert np.abs(found.pixels[0] - places[0]).max() < 4
    (u, v), off = places[0], found.pixels[0, 0] - places[0][0]
    for turn in np.linspace(0, 1.2, 7):
        after = tracker.update(draw(places, (turn, 0)))
        assert after.states == (SEEN, SEEN)
        turned = u + off * np.cos(turn), v + off * np.sin(turn)
        assert np.abs(after.pixels[0] - turned).max() < 2


def test_what_is_as_dark_as_the_floor_is_selected():
    """A large towel, near the edges of a light table."""
    picture = np.full((SIZE, SIZE, 3), 40, np.uint8)
    picture[40:200, 60:200] = 190
    towel = np.array([(80, 120), (140, 70), (180, 110), (120, 160)])
    cv2.fillConvexPoly(picture, towel, (45,) * 3)
    picture = cv2.GaussianBlur(picture, (0, 0), 1)
    found = load_plugin('tap_ros.trackers', 'rigid')(None).select(View(picture), [(126, 118)])
    assert np.abs(found.pixels - (130, 115)).max() < 2
    assert np.ptp(found.outlines[0], axis=0) == pytest.approx((100, 90), abs=6)


@pytest.mark.parametrize('appearance', ['usual', 'random'])
def test_two_of_one_colour_that_touch_are_told_apart_by_where_they_are_clicked(appearance):
    episode, tracker = demonstrated('order2', 1_210_024, look='arm', appearance=appearance)
    places = episode.object_pixels[0]
    found = tracker.select(View(episode.frames[0], episode.robot_masks[0]),
                           places + ((2.2, -1.5), (2.6, 6.4)))
    assert np.linalg.norm(found.pixels - places, axis=1).max() < 5


@pytest.mark.parametrize('light', [(0.6, 0.6, 0.6), (1.1, 1.0, 0.8)])
def test_other_light_changes_nothing(tracker, light):
    moved = np.array(STARTS) + 4
    view = draw(moved)
    other = replace(view, image=(view.image * np.float32(light)).clip(0, 255).astype(np.uint8))
    found = tracker.update(other)
    assert found.states == (SEEN, SEEN) and np.abs(found.pixels - moved).max() < 1.5


def test_a_neighbour_of_other_colours_is_left_out():
    view = draw(STARTS)
    view.image[85:115, 94:130] = 60, 60, 160  # it touches the first one
    found = load_plugin('tap_ros.trackers', 'rigid')(None).select(view, STARTS)
    assert np.abs(found.pixels - STARTS).max() < 2


def test_what_looks_otherwise_is_not_said_to_be_seen(tracker):
    view = draw(STARTS)
    view.image[90:110, 60:100] = 90, 160, 90  # another one lies there now
    for _ in range(4):
        assert tracker.update(view).states[0] != SEEN


def test_what_is_drawn_is_taken_as_it_is():
    box = np.array([(60, 85), (100, 85), (100, 115), (60, 115)], float)
    tracker = load_plugin('tap_ros.trackers', 'rigid')(None)
    found = tracker.select(draw(STARTS), STARTS, [box, np.empty((0, 2))])
    assert np.ptp(found.outlines[0], axis=0) == pytest.approx((40, 30), abs=1)
    assert np.abs(found.pixels - STARTS).max() < 1.5
    assert np.ptp(found.outlines[1], axis=0)[0] < 36


@pytest.mark.parametrize('size', [64, 480])
def test_pictures_of_any_size_are_followed_and_left_as_they_are(size):
    tracker, scale = load_plugin('tap_ros.trackers', 'rigid')(None), size / SIZE
    view = draw(STARTS, size=size)
    before = view.image.copy()
    tracker.select(view, (np.array(STARTS) + 0.5) * scale - 0.5)
    view.image.flags.writeable = False
    moved = np.array(STARTS) + 5
    found = tracker.update(draw(moved, size=size))
    assert np.abs((found.pixels + 0.5) / scale - 0.5 - moved).max() < 2
    assert (view.image == before).all()


def test_objects_are_found_in_a_goal_picture_or_refused(tracker):
    goal = ((60.0, 200.0), (200.0, 60.0))
    found = tracker.find(draw(goal, (2.0, -1.0)))
    assert found.states == (SEEN, SEEN) and np.abs(found.pixels - goal).max() < 2
    found = tracker.find(draw(goal[:1]))
    assert found.states == (SEEN, LOST) and np.isnan(found.pixels[1]).all()
    # the objects are followed on as before
    assert np.abs(tracker.update(draw(STARTS)).pixels - STARTS).max() < 1.5


@pytest.mark.parametrize('beside, turned', [((80, 116), 0), ((102, 100), np.pi / 2),
                                            ((102, 108), np.pi / 2)])
def test_objects_that_touch_when_they_are_clicked_are_told_apart(beside, turned):
    places = np.array([(80.0, 100.0), beside])
    for off in np.random.default_rng(0).uniform(-3, 3, (4, 2, 2)):
        found = load_plugin('tap_ros.trackers', 'rigid')(None).select(
            draw(places, (0, turned)), places + off)
        assert np.linalg.norm(found.pixels - places, axis=1).max() < 2, off


def test_what_moved_from_one_picture_to_another_is_proposed():
    found = propose(draw(STARTS, robot=(0, 0, 40, 60)), draw((STARTS[0], (120.0, 220.0))))
    assert len(found) == 1 and np.abs(found - STARTS[1:]).max() < 2
    assert propose(draw(STARTS), draw(STARTS)).shape == (0, 2)


def test_cuts_that_miss_their_change_are_not_tried_for_ever(monkeypatch):
    tries = []

    def beside(picture, at):
        tries.append(at)
        cut = silhouette(picture, at)
        return replace(cut, mask=np.roll(cut.mask, len(cut.mask) // 2, 0), contrast=0.0)
    monkeypatch.setattr(proposals, 'silhouette', beside)
    propose(draw(STARTS), draw((STARTS[0], (120.0, 220.0))))
    assert 0 < len(tries) <= proposals.MOST_TRIED


@pytest.mark.parametrize('goal', [((60.0, 200.0), (200.0, 60.0)), ((80.0, 100.0), (200.0, 60.0)),
                                  ((150.0, 60.0), (80.0, 104.0))])
def test_objects_that_touch_are_proposed_apart_where_they_move_apart(goal):
    """Both move; one stays; one comes to where the other one was."""
    starts = np.array(((80.0, 100.0), (80.0, 116.0)))
    found = propose(draw(starts), draw(goal, (1.0, -1.0) if goal[0] != (80.0, 100.0) else (0, 1)))
    moved = starts[np.linalg.norm(starts - goal, axis=1) > 0]
    assert len(found) == len(moved)
    assert np.linalg.norm(found[:, None] - moved, axis=-1).min(1).max() < 4


@pytest.mark.parametrize('noise', [0, 2, 8, 16, 30])
def test_noise_is_no_object(noise):
    picture = (150, 140, 130) + np.random.default_rng(0).normal(0, noise, (128, 128, 3))
    view = View(picture.clip(0, 255).astype(np.uint8))
    for click in np.random.default_rng(1).uniform(0, 127, (10, 2)):
        with pytest.raises(TrackingError, match='on nothing that differs'):
            load_plugin('tap_ros.trackers', 'rigid')(None).select(view, [click])


def test_the_table_beside_an_object_is_no_object():
    picture = table()
    picture[116:140, 116:140] = 200, 60, 60
    with pytest.raises(TrackingError, match='on nothing that differs'):
        load_plugin('tap_ros.trackers', 'rigid')(None).select(View(picture), [(90.0, 128.0)])


@pytest.mark.parametrize('look', LOOKS)
def test_what_a_click_selects_has_an_object_under_it(look):
    """Wherever one clicks: table, its rim, its shadows, what is behind it."""
    simulator, selected = Simulator('push2', 128, look=look, appearance='random'), 0
    try:
        for seed in range(2):
            seen = simulator.reset(seed)
            view = View(seen.image, seen.robot_mask)
            camera = PinholeCamera(
                simulator.camera_matrix, seen.image.shape[:2], simulator.camera_pose)
            true = seen.object_pixels
            tracker = load_plugin('tap_ros.trackers', 'rigid')(camera)
            beside = np.repeat(true, 4, 0) + 9 * np.array([(0, 1), (1, 0), (0, -1), (-1, 0)] * 2)
            for click in (*np.random.default_rng(seed).uniform(0, 127, (30, 2)), *beside, *true):
                with suppress(TrackingError):
                    found, = tracker.select(view, [click]).pixels
                    assert np.linalg.norm(true - found, axis=1).min() < 8, click
                    selected += 1
    finally:
        simulator.close()
    assert selected > 4


def test_what_comes_to_a_plank_of_its_own_colour_is_not_unsure():
    simulator = Simulator('order2', 256, look='hand')
    try:
        seen, scene = simulator.reset(1_000_008), simulator.scene
        tracker = load_plugin('tap_ros.trackers', 'rigid')(PinholeCamera(
            simulator.camera_matrix, seen.image.shape[:2], simulator.camera_pose))
        tracker.select(View(seen.image, seen.robot_mask), seen.object_pixels)
        way = np.array([[1.0], [0.0]]) * (scene.goal_poses - scene.start_poses)
        for share in np.linspace(0, 1, 9)[1:]:
            simulator.load(scene.shapes, lifted(scene.start_poses + share * way),
                           scene.gripper_start, 0)
            seen = simulator.observe()
            found = tracker.update(View(seen.image, seen.robot_mask))
            assert found.states == (SEEN, SEEN)
            assert np.abs(found.pixels - seen.object_pixels).max() < 5
    finally:
        simulator.close()


@pytest.mark.parametrize('task, seed, look', [
    ('pick_place', 88_006, 'hand'), ('stack2', 88_003, 'hand'), ('pick_place', 1_200_058, 'arm')])
def test_what_the_hand_carries_is_followed_through_the_air(task, seed, look):
    episode, tracker = demonstrated(task, seed, look=look)
    views = [View(*seen) for seen in zip(episode.frames, episode.robot_masks, episode.grippers)]
    tracker.select(views[0], episode.object_pixels[0])
    found = [tracker.update(view) for view in views[1:]]
    off = np.linalg.norm([one.pixels for one in found] - episode.object_pixels[1:], axis=-1)
    assert (episode.object_poses[..., 2] > 0.12).sum() > 2 and off.max() < 8
    assert all(one.states[-1] == SEEN for one in found)


def test_what_lies_under_another_object_is_found_in_a_goal_picture_by_its_sides():
    episode, tracker = demonstrated('stack2', 70_005)
    tracker.select(View(episode.frames[0], episode.robot_masks[0]), episode.object_pixels[0])
    found = tracker.find(View(episode.goal_frame, episode.goal_mask))
    assert found.states == (SEEN, SEEN)
    assert np.abs(found.pixels - episode.goal_pixels).max() < 4


@pytest.mark.parametrize('place, along', [
    ((0, -1, TOP), (0, 1, 0)), ((0, 0, 1), (0, 0, 1)), ((0, -1, 0.1), (0, 1, 0)),
    ((0, 0, -1), (0, 0, 1)), ((90, 0, 1), (0, 0, -1))])
def test_a_camera_that_does_not_look_down_on_the_table_is_refused(place, along):
    pose = np.eye(4)
    pose[:3, 2], pose[:3, 3] = along, place
    with pytest.raises(TrackingError, match='does not look down'):
        check_pose(pose)
    pose[:3, 2:] = np.array([(0, 0.8, -0.6), (0, -1.1, 1.3)]).T
    check_pose(pose)
