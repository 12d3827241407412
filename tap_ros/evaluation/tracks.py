# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a tracker makes of one episode or film, and how far that is from the truth.

Labels of films lie in a small JSON file; null where an object is not seen:

    {"films": [
    {"film": "0003/0.mp4", "objects": ["cup", "plate"], "first": 0, "last": 120, "step": 2,
     "labels": {"0": [[101, 60], [150, 90]], "10": [[104, 61], null]}}
    ]}

A film is a path from a folder that is given with them. Pixels are (u, v) of the film's own size;
every step-th frame from the first to the last is looked at; those of the first label are clicked.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
import json
from pathlib import Path
import time
from typing import Any

import cv2
import numpy as np
from tap_ros.base.errors import ConfigError, TrackingError
from tap_ros.base.text import escaped
from tap_ros.recording.episode import Episode
from tap_ros.recording.formats.pictures import make_episode, video_frames
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.protocols import LOST, SEEN, Tracked, Tracker, View

SIDE = 64  # errors are in pixels of a picture so many pixels wide
RIGHT, WRONG = 2.0, 3.0  # px: within is right; beyond is wrong
SOON = 3  # pictures after an occlusion in which an object should be found
# Whose sheet a camera is fitted to: objects at one height to within this.
LEVEL = 0.002  # m
FLAGS = (cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
         | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3)


@dataclass(frozen=True)
class Track:
    """K objects through T pictures, the one in which they are clicked not among them."""

    name: str
    task: str
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


def follow(make: Callable[[], Tracker], episode: Episode, name: str, click: float = 0.0,
           keep: bool = False) -> Track:
    """
    Click the objects of an episode, follow them, and find them in its goal picture.

    They are clicked in the first picture in which the robot is before none of them, else in that
    in which it is before the fewest; those are not followed then, and count as refused.

    :param make: makes a Tracker.
    :param click: px of SIDE that clicks are off, on average.
    :param keep: keep pictures for people.
    """
    pixels = episode.object_pixels.astype(float)
    covered = np.array([[is_covered(pixel, mask) for pixel in row] for row, mask in zip(
        pixels, [None] * len(pixels) if episode.robot_masks is None else episode.robot_masks)])
    clear = (~covered & np.isfinite(pixels).all(-1)).sum(1)
    first = int(clear.argmax())
    chosen = np.flatnonzero(~covered[first] & np.isfinite(pixels[first]).all(-1))
    scale = SIDE / max(episode.frames.shape[1:3])
    # the mean length of a normal vector in the plane is 1.25 times its deviation
    off = np.random.default_rng([episode.seed, 5]).normal(0, 1, pixels[first].shape)
    clicks = pixels[first] + click / 1.2533 / scale * off

    def view(t: int) -> View:
        masks = episode.robot_masks
        gripper = episode.grippers[t]
        return View(episode.frames[t], None if masks is None else masks[t],
                    gripper if np.isfinite(gripper).all() else None)

    tracker = make()
    chosen = np.array([k for k in chosen if _accepts(tracker, view(first), clicks[k])], int)
    selected = tracker.select(view(first), clicks[chosen])
    found: list[Tracked] = []
    ms = []
    for t in range(first + 1, len(pixels)):
        seen, begin = view(t), time.process_time()
        found.append(tracker.update(seen))
        ms.append(1000 * (time.process_time() - begin))
    truth, later = pixels[:, chosen], slice(first + 1, None)
    count = len(chosen)
    goal, goal_covered = None, np.zeros(count, bool)
    if episode.goal_frame is not None and count:
        goal = tracker.find(View(episode.goal_frame, episode.goal_mask))
        goal_covered = np.array([is_covered(pixel, episode.goal_mask)
                                 for pixel in episode.goal_pixels[chosen]])

    def errors(tracked: Tracked, wanted: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(tracked.pixels - wanted, axis=-1) * scale)

    shape = (len(found), count)
    return Track(
        name, episode.task,
        np.array([errors(one, truth[first + 1 + t]) for t, one in enumerate(found)]).reshape(
            shape),
        np.array([one.states for one in found], str).reshape(shape),
        np.array([one.confidence for one in found]).reshape(shape), covered[later][:, chosen],
        np.array(ms), errors(selected, truth[first]), pixels.shape[1] - count,
        np.full(count, np.nan) if goal is None else errors(goal, episode.goal_pixels[chosen]),
        (LOST,) * count if goal is None else goal.states, goal_covered,
        [(episode.frames[first + i], one) for i, one in enumerate([selected, *found])]
        if keep else [])


def scaled(episode: Episode, size: int) -> Episode:
    """Return an episode whose pictures have a longer side of so many pixels, 0: as they are."""
    H, W = episode.frames.shape[1:3]
    share = size / max(H, W) if size else 1.0
    if share == 1:
        return episode
    shape = round(W * share), round(H * share)

    def picture(image: np.ndarray, how: int = cv2.INTER_AREA) -> np.ndarray:
        return np.asarray(cv2.resize(image, shape, interpolation=how))

    masks, goal, goal_mask = episode.robot_masks, episode.goal_frame, episode.goal_mask
    return replace(
        episode, frames=np.stack([picture(frame) for frame in episode.frames]),
        robot_masks=None if masks is None else np.stack([
            picture(mask, cv2.INTER_NEAREST) for mask in masks]),
        goal_frame=None if goal is None else picture(goal),
        goal_mask=None if goal_mask is None else picture(goal_mask, cv2.INTER_NEAREST),
        object_pixels=(episode.object_pixels + np.float32(0.5)) * np.float32(share) - np.float32(
            0.5),
        goal_pixels=(episode.goal_pixels + np.float32(0.5)) * np.float32(share) - np.float32(0.5))


def _accepts(tracker: Tracker, view: View, click: np.ndarray) -> bool:
    """Return whether a tracker accepts a click."""
    try:
        tracker.select(view, click[None])
    except TrackingError:
        return False
    return True


def is_covered(pixel: np.ndarray, mask: np.ndarray | None) -> bool:
    """Return whether a robot mask (H, W) covers a pixel (u, v)."""
    if mask is None or not np.isfinite(pixel).all():
        return False
    u, v = np.rint(pixel).astype(int)
    return bool(0 <= v < mask.shape[0] and 0 <= u < mask.shape[1] and mask[v, u])


def recoveries(track: Track) -> list[bool]:
    """Return for each end of an occlusion whether the object was right again soon."""
    found = []
    for k in range(track.covered.shape[1]):
        ends = np.flatnonzero(track.covered[:-1, k] & ~track.covered[1:, k]) + 1
        for t in ends:
            good = (track.errors[t:t + SOON, k] <= RIGHT) & (track.states[t:t + SOON, k] == SEEN)
            if good.any() or len(good) == SOON:
                found.append(bool(good.any()))
    return found


def longest_wrong(wrong: Sequence[bool] | np.ndarray) -> int:
    """Return in how many pictures one after the other something was wrong."""
    best = run = 0
    for one in wrong:
        run = run + 1 if one else 0
        best = max(best, run)
    return best


def fit_camera(episodes: Iterable[Episode]) -> PinholeCamera | None:
    """
    Fit a pinhole camera to the true places of objects that lie at one height.

    Square pixels, and the axis through the middle of the picture.

    :return: None where there are no places, or too few.
    """
    points, pixels, size = [], [], (0, 0)
    for episode in episodes:
        known = np.isfinite(episode.object_poses[..., :3]).all(-1) & np.isfinite(
            episode.object_pixels).all(-1)
        points.append(episode.object_poses[known][:, :3])
        pixels.append(episode.object_pixels[known])
        size = episode.frames.shape[1:3]
    xyz, uv = np.concatenate([*points, np.zeros((0, 3))]), np.concatenate([*pixels, np.zeros(
        (0, 2))])
    if not len(xyz):
        return None
    height = float(np.median(xyz[:, 2]))
    level = np.abs(xyz[:, 2] - height) < LEVEL
    flat = np.unique(np.column_stack([xyz[level], uv[level]]).round(6), axis=0)[:, [0, 1, 3, 4]]
    flat = flat[::-(-len(flat) // 400)]
    if len(flat) < 8:
        return None
    sheet = np.column_stack([flat[:, :2], np.zeros(len(flat))]).astype(np.float32)
    guess = np.diag([float(max(size))] * 2 + [1.0])
    guess[:2, 2] = (size[1] - 1) / 2, (size[0] - 1) / 2
    _, K, _, turns, moves = cv2.calibrateCamera(
        [sheet], [flat[:, 2:].astype(np.float32)], size[::-1], guess, np.zeros(5),
        flags=FLAGS | cv2.CALIB_USE_INTRINSIC_GUESS)
    to_camera = np.eye(4)
    to_camera[:3, :3] = cv2.Rodrigues(turns[0])[0]
    to_camera[:3, 3] = moves[0].ravel() - to_camera[:3, 2] * height
    return PinholeCamera(np.asarray(K), (size[0], size[1]), np.linalg.inv(to_camera))


def read_films(labels: str | Path, folders: Sequence[str | Path]) -> list[Episode]:
    """
    Read films and their labels.

    :param folders: where the films are looked for.
    :raises ConfigError: for a file that is none of labels, or without films.
    :raises RecordingError: for a film that cannot be read.
    """
    try:
        told = json.loads(Path(labels).read_text())['films']
        return [_film(one, folders) for one in told]
    except (ValueError, LookupError, TypeError) as error:
        raise ConfigError(f'{labels}: expected films with labels, see evaluation/tracks.py; '
                          f'{escaped(error)}') from error


def _film(told: dict[str, Any], folders: Sequence[str | Path]) -> Episode:
    """Read one film."""
    found = [path for folder in folders if (path := Path(folder, told['film'])).is_file()]
    if not found:
        raise ConfigError(f'{escaped(told["film"])} is in none of the folders of --recordings')
    wanted = range(told.get('first', 0), told['last'] + 1, told.get('step', 1))
    frames = [frame for i, (_, frame) in enumerate(video_frames(found[0])) if i in wanted]
    T, K = len(frames), len(told['objects'])
    pixels = np.full((T, K, 2), np.nan, np.float32)
    for number, places in told['labels'].items():
        for k, place in enumerate(places):
            if place is not None:
                pixels[wanted.index(int(number)), k] = place
    return make_episode(frames, np.arange(T) / 10, tuple(told['objects']), object_pixels=pixels,
                        object_source='by hand', task=told['film'])
