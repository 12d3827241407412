# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a tracker makes of episodes and films, and how far that is from the truth.

Labels of films lie in a small JSON file; null where an object is not seen:

    {"films": [
    {"film": "0003/0.mp4", "objects": ["cup", "plate"], "first": 0, "last": 120, "step": 2,
     "labels": {"0": [[101, 60], [150, 90]], "10": [[104, 61], null]}}
    ]}

A film is a path from a folder that is given with them. Pixels are (u, v) of the film's own size;
every step-th frame from the first to the last is looked at; those of the first label are clicked.
"""

from dataclasses import dataclass, field, replace
from functools import partial
import json
from pathlib import Path
import time

import cv2
import numpy as np
from tap_ros.base.contract import LOST, SEEN
from tap_ros.base.errors import TrackingError
from tap_ros.evaluation.intervals import bootstrap, share_interval
from tap_ros.images.drawing import film_strip, grid, OBJECT_COLOURS
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats.pictures import make_episode, video_frames
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.protocols import Tracked, View
from tap_ros.tracking.rigid_tracker import RigidTracker

SIDE = 64  # errors are in pixels of a picture so many pixels wide
RIGHT, WRONG = 2.0, 3.0  # px: within is right; beyond is wrong
SOON = 3  # pictures after an occlusion in which an object should be found
BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.0)  # of confidence
STIRS = 8.0  # px of a film, between two labels, up to which places in between are interpolated
STRIPS, PANEL = 6, 256  # episodes that are drawn, px a side of a panel
# Whose sheet a camera is fitted to: objects at one height to within this.
LEVEL = 0.002  # m
FLAGS = (cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT
         | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
         | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3)


@dataclass(frozen=True)
class Track:
    """K objects through T pictures, the one in which they are clicked not among them."""

    errors: np.ndarray  # (T, K) px of SIDE; NaN where the truth is not known
    states: np.ndarray  # (T, K) str
    confidence: np.ndarray  # (T, K)
    covered: np.ndarray  # (T, K) bool, the robot is before the object's middle
    ms: np.ndarray  # (T,) of CPU
    selected: np.ndarray  # (K,) px from the truth to where a click was taken to
    refused: int  # clicks
    goal_errors: np.ndarray  # (K,) NaN where the truth is not known
    goal_states: tuple[str, ...]  # (K,)
    goal_covered: np.ndarray  # (K,)
    shown: list[tuple[np.ndarray, Tracked]] = field(default_factory=list, repr=False)


def score_bag(bag, size, click, light=None):
    """
    Follow the objects of a bag; the camera is fitted to their true places.

    :param size: px of the longer side that pictures are scaled down to; 0: as they are.
    :param click: px of SIDE that clicks are off; 0: exact, and taken as they are.
    :param light: factors of red, green and blue from the middle of an episode on, or None.
    :return: rows of summarise, and the tracks, some with pictures.
    """
    store = open_recordings(bag)
    make = partial(RigidTracker, fit_camera(store), snap=bool(click))
    tracks = [follow(make, relit(scaled(episode, size), light), click, keep=i < STRIPS)
              for i, episode in enumerate(store)]
    about = {'tracker': 'rigid', 'click_px': click, 'size': size,
             'light': '' if light is None else str(list(light))}
    return [row | about for row in summarise(tracks, Path(bag).name)], tracks


def score_films(labels, folder):
    """Follow the objects of labelled films; return rows of summarise."""
    about = {'tracker': 'rigid', 'click_px': 0.0, 'size': 0}
    make = partial(RigidTracker, None, snap=False)
    return [row | about for told in json.loads(Path(labels).read_text())['films']
            for row in summarise([follow(make, read_film(told, folder))], told['film'])]


def follow(make, episode, click=0.0, keep=False):
    """
    Click the objects of an episode, follow them, and find them in its goal picture.

    They are clicked in the first picture in which the robot is before none of them, else in that
    in which it is before the fewest; those are not followed then, and count as refused.

    :param make: makes a Tracker.
    :param click: px of SIDE that clicks are off, on average.
    :param keep: keep pictures for people.
    """
    pixels, masks = episode.object_pixels.astype(float), episode.robot_masks
    covered = np.array([[is_covered(pixel, mask) for pixel in row] for row, mask in zip(
        pixels, [None] * len(pixels) if masks is None else masks)])
    clear = ~covered & np.isfinite(pixels).all(-1)
    first = int(clear.sum(1).argmax())
    scale = SIDE / max(episode.frames.shape[1:3])
    # the mean length of a normal vector in the plane is 1.25 times its deviation
    off = np.random.default_rng([episode.seed, 5]).normal(0, 1, pixels[first].shape)
    clicks = pixels[first] + click / 1.2533 / scale * off

    def view(t):
        gripper = episode.grippers[t]
        return View(episode.frames[t], None if masks is None else masks[t],
                    gripper if np.isfinite(gripper).all() else None)

    def accepted(k):
        try:
            tracker.select(view(first), clicks[k][None])
        except TrackingError:
            return False
        return True

    def errors(tracked, wanted):
        return np.linalg.norm(tracked.pixels - wanted, axis=-1) * scale

    tracker = make()
    chosen = np.array([k for k in np.flatnonzero(clear[first]) if accepted(k)], int)
    selected = tracker.select(view(first), clicks[chosen])
    found, ms = [], []
    for t in range(first + 1, len(pixels)):
        seen, begin = view(t), time.process_time()
        found.append(tracker.update(seen))
        ms.append(1000 * (time.process_time() - begin))
    truth, later, count = pixels[:, chosen], slice(first + 1, None), len(chosen)
    goal_errors, goal_states, goal_covered = (
        np.full(count, np.nan), (LOST,) * count, np.zeros(count, bool))
    if episode.goal_frame is not None and count:
        goal = tracker.find(View(episode.goal_frame, episode.goal_mask))
        goal_errors, goal_states = errors(goal, episode.goal_pixels[chosen]), goal.states
        goal_covered = np.array([is_covered(pixel, episode.goal_mask)
                                 for pixel in episode.goal_pixels[chosen]])
    shape = (len(found), count)
    return Track(
        np.array([errors(*one) for one in zip(found, truth[later])]).reshape(shape),
        np.array([one.states for one in found], str).reshape(shape),
        np.array([one.confidence for one in found]).reshape(shape), covered[later][:, chosen],
        np.array(ms), errors(selected, truth[first]), pixels.shape[1] - count,
        goal_errors, goal_states, goal_covered,
        list(zip(episode.frames[first:], [selected, *found])) if keep else [])


def scaled(episode, size):
    """Return an episode whose pictures have a longer side of so many pixels, 0: as they are."""
    H, W = episode.frames.shape[1:3]
    share = np.float32(size / max(H, W) if size else 1.0)
    if share == 1:
        return episode

    def pictures(images, how=cv2.INTER_AREA):
        return None if images is None else np.stack([
            cv2.resize(image, (round(W * share), round(H * share)), interpolation=how)
            for image in images])

    def picture(image, *how):
        return None if image is None else pictures([image], *how)[0]

    half = np.float32(0.5)
    return replace(
        episode, frames=pictures(episode.frames), goal_frame=picture(episode.goal_frame),
        robot_masks=pictures(episode.robot_masks, cv2.INTER_NEAREST),
        goal_mask=picture(episode.goal_mask, cv2.INTER_NEAREST),
        object_pixels=(episode.object_pixels + half) * share - half,
        goal_pixels=(episode.goal_pixels + half) * share - half)


def relit(episode, light):
    """Return an episode in another light from its middle on, see score_bag."""
    if light is None:
        return episode
    frames = np.array(episode.frames)
    later = frames[len(frames) // 2:]
    later[:] = (later * np.float32(light)).clip(0, 255).astype(np.uint8)
    return replace(episode, frames=frames)


def is_covered(pixel, mask):
    """Return whether a robot mask (H, W) covers a pixel (u, v)."""
    if mask is None or not np.isfinite(pixel).all():
        return False
    u, v = np.rint(pixel).astype(int)
    return bool(0 <= v < mask.shape[0] and 0 <= u < mask.shape[1] and mask[v, u])


def recoveries(track):
    """Return for each end of an occlusion whether the object was right again soon."""
    found = []
    for t, k in zip(*np.nonzero(track.covered[:-1] & ~track.covered[1:])):
        soon = slice(t + 1, t + 1 + SOON)
        good = (track.errors[soon, k] <= RIGHT) & (track.states[soon, k] == SEEN)
        if good.any() or len(good) == SOON:
            found.append(bool(good.any()))
    return found


def longest(wrong):
    """Return in how many pictures one after the other something was wrong, bool (T,)."""
    starts = np.flatnonzero(np.diff(np.concatenate([[0], wrong, [0]])))
    return int(np.diff(starts)[::2].max(initial=0))


def summarise(tracks, name):
    """
    Score tracks.

    :param name: of their recording.
    :return: list of dicts: recording, metric, step (of confidence), value, ci_low, ci_high, n.
    """
    rows = []

    def add(metric, found, n, step=0):
        value, low, high = (round(float(x), 4) for x in found)
        rows.append({'recording': name, 'metric': metric, 'step': step, 'value': value,
                     'ci_low': low, 'ci_high': high, 'n': n})

    def joined(name):
        return np.concatenate([np.ravel(getattr(track, name)) for track in tracks])

    objects = [(track.errors[:, k], track.states[:, k]) for track in tracks
               for k in range(track.errors.shape[1])]
    known = [np.isfinite(errors) for errors, _ in objects]
    errors = [one[good] for (one, _), good in zip(objects, known)]
    count = sum(map(len, errors))
    if not count:
        return rows
    add('median_px', _over_objects(np.median, errors), count)
    add('within_2px', _over_objects(np.mean, [one <= RIGHT for one in errors]), count)
    wrong = [(one > WRONG) & (states[good] == SEEN)
             for one, (_, states), good in zip(errors, objects, known)]
    add('wrong_sure', _over_objects(np.mean, wrong), count)
    add('longest_wrong_sure', [max(map(longest, wrong))] * 3, len(objects))
    visible = [states[good] == LOST for (_, states), good in zip(objects, known)]
    add('visible_lost', _over_objects(np.mean, visible), count)
    add('lost', share_interval([states[-1] == LOST for _, states in objects]), len(objects))
    again = [one for track in tracks for one in recoveries(track)]
    if again:
        add('recovered', share_interval(again), len(again))
    ms = [track.ms for track in tracks if len(track.ms)]
    add('cpu_ms', _over_objects(np.mean, ms), sum(map(len, ms)))
    clicks = joined('selected')
    add('selected_px', bootstrap(lambda x: np.median(x, -1), clicks), len(clicks))
    refused = sum(track.refused for track in tracks)
    add('refused', share_interval([1] * refused + [0] * len(clicks)), refused + len(clicks))
    goal, found = joined('goal_errors'), joined('goal_states') == SEEN
    asked = np.concatenate([np.full(len(track.goal_states), np.isfinite(track.goal_errors).any())
                            for track in tracks])
    if asked.any():
        right = found & (goal <= RIGHT)
        for kind, what, among in (
                ('right', right, asked), ('wrong', found & ~right, asked),
                ('refused', ~found, asked),
                ('visible_right', right, asked & ~joined('goal_covered'))):
            add(f'goal_{kind}', share_interval(what[among]), int(among.sum()))
    confidence, error = joined('confidence'), joined('errors')
    for low, high in zip(BINS, BINS[1:]):
        inside = (confidence >= low) & (confidence < high + (high == 1)) & np.isfinite(error)
        if inside.any():
            add('confidence', share_interval(error[inside] <= RIGHT), int(inside.sum()), low)
    return rows


def _over_objects(statistic, parts):
    """Return a statistic of all parts together, and its interval over the parts."""
    rng, parts = np.random.default_rng(0), [np.asarray(part, float) for part in parts]
    drawn = [statistic(np.concatenate([parts[i] for i in rng.integers(len(parts), size=len(
        parts))])) for _ in range(500)]
    return (statistic(np.concatenate(parts)), *np.percentile(drawn, (2.5, 97.5)))


def fit_camera(episodes):
    """
    Fit a pinhole camera to the true places of objects that lie at one height.

    Square pixels, and the axis through the middle of the picture.
    """
    points, pixels = [], []
    for episode in episodes:
        points.append(episode.object_poses[..., :3].reshape(-1, 3))
        pixels.append(episode.object_pixels.reshape(-1, 2))
        size = episode.frames.shape[1:3]
    both = np.column_stack([np.concatenate(points), np.concatenate(pixels)])
    both = both[np.isfinite(both).all(1)]
    height = float(np.median(both[:, 2]))
    level = np.abs(both[:, 2] - height) < LEVEL
    flat = np.unique(both[level].round(6), axis=0)[:, [0, 1, 3, 4]]
    flat = flat[::-(-len(flat) // 400)]
    sheet = np.column_stack([flat[:, :2], np.zeros(len(flat))]).astype(np.float32)
    guess = np.diag([float(max(size))] * 2 + [1.0])
    guess[:2, 2] = (size[1] - 1) / 2, (size[0] - 1) / 2
    _, K, _, turns, moves = cv2.calibrateCamera(
        [sheet], [flat[:, 2:].astype(np.float32)], size[::-1], guess, np.zeros(5), flags=FLAGS)
    to_camera = np.eye(4)
    to_camera[:3, :3] = cv2.Rodrigues(turns[0])[0]
    to_camera[:3, 3] = moves[0].ravel() - to_camera[:3, 2] * height
    return PinholeCamera(K, size, np.linalg.inv(to_camera))


def read_film(told, folder):
    """Read a film of the file of labels as an Episode."""
    wanted = range(told.get('first', 0), told['last'] + 1, told.get('step', 1))
    frames = [show() for i, (_, show) in enumerate(video_frames(Path(folder, told['film'])))
              if i in wanted]
    pixels = np.full((len(frames), len(told['objects']), 2), np.nan, np.float32)
    labelled = sorted(map(int, told['labels']))
    for number in labelled:
        pixels[wanted.index(number)] = [
            place or (np.nan, np.nan) for place in told['labels'][str(number)]]
    for begin, end in zip(*[[wanted.index(number) for number in labelled][i:] for i in (0, 1)]):
        first, last = pixels[begin], pixels[end]
        rests = np.linalg.norm(last - first, axis=1) < STIRS
        for t in range(begin + 1, end):
            share = (t - begin) / (end - begin)
            pixels[t, rests] = ((1 - share) * first + share * last)[rests]
    return make_episode(frames, np.arange(len(frames)) / 10, tuple(told['objects']),
                        object_pixels=pixels, object_source='by hand', task=told['film'])


def draw(tracks):
    """Draw strips, a row a track, with the outlines of what is seen."""
    return grid([[_outlined(*track.shown[int(i)])
                  for i in film_strip(np.arange(len(track.shown)), 8)] for track in tracks])


def _outlined(frame, tracked):
    """Draw outlines into a square panel; crosses where objects are not seen."""
    scale = PANEL / max(frame.shape[:2])
    panel = np.full((PANEL, PANEL, 3), 255, np.uint8)
    small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=(
        cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST))[:PANEL, :PANEL]
    panel[:small.shape[0], :small.shape[1]] = small
    for k, (pixel, state, line) in enumerate(zip(
            tracked.pixels, tracked.states, tracked.outlines)):
        colour = OBJECT_COLOURS[k % len(OBJECT_COLOURS)]
        if state == SEEN and len(line):
            cv2.polylines(panel, [np.rint((line + 0.5) * scale - 0.5).astype(np.int32)], True,
                          colour, 1, cv2.LINE_AA)
        elif np.isfinite(pixel).all():
            place = np.rint((pixel + 0.5) * scale - 0.5).astype(int).tolist()
            cv2.drawMarker(panel, place, colour, cv2.MARKER_TILTED_CROSS, 8, 1, cv2.LINE_AA)
    return panel
