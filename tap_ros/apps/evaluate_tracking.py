# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the command `python -m tap_ros evaluate tracking` does: follow, compare, print, write."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tap_ros.apps.evaluate import Tracking
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically, write_rows
from tap_ros.base.plugins import load_plugin
from tap_ros.evaluation.intervals import bootstrap, share_interval
from tap_ros.evaluation.tracks import (
    fit_camera,
    follow,
    longest_wrong,
    read_films,
    recoveries,
    RIGHT,
    scaled,
    Track,
    WRONG,
)
from tap_ros.images.drawing import film_strip, grid, OBJECT_COLOURS, png_bytes
from tap_ros.recording.bags import reading_like
from tap_ros.recording.cache import open_recordings
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.protocols import LOST, SEEN, Tracked, Tracker
from tap_ros.tracking.rigid_tracker import RigidTracker

FILE, PICTURE = 'tracking.json', 'tracking.png'
STRIPS, PANEL = 6, 256  # episodes that are drawn, px a side of a panel
BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.0)  # of confidence
MEANING = {
    'median_px': 'median error, px of a picture 64 px wide',
    'within_2px': 'share of pictures in which an object is right',
    'lost': 'share of objects that are lost in the last picture',
    'wrong_sure': 'share of pictures in which an object is wrong by 3 px and said to be seen',
    'longest_wrong_sure': 'most pictures one after the other in which that is so',
    'recovered': 'share of occlusions after which it is right within three pictures',
    'cpu_ms': 'CPU time of a picture, ms',
    'selected_px': 'median error of where a click is taken to',
    'refused': 'share of objects whose click was refused, or which never came into view',
    'goal_right': 'share of objects found right in the goal picture',
    'goal_wrong': 'found, and wrong there', 'goal_refused': 'not found there',
    'goal_visible_right': 'found right, of those whose middle the robot does not cover',
    'confidence': 'share right, of pictures whose confidence is between step and the next'}


def run(args: Tracking) -> None:
    """
    Follow, print a table, and write what --out asks for.

    :raises ConfigError: if there is nothing to score.
    """
    rows, shown = score(args)
    print_table(rows)
    if args.out:
        write_rows(Path(args.out, FILE), rows)
        write_atomically(Path(args.out, PICTURE), png_bytes(draw(shown)))


def score(args: Tracking) -> tuple[list[dict[str, Any]], list[Track]]:
    """
    Follow the objects of all recordings or films.

    :return: rows of summarise, and the tracks, some with pictures.
    :raises ConfigError: if there is nothing to score.
    """
    rows: list[dict[str, Any]] = []
    shown: list[Track] = []
    if args.labels:
        films = read_films(args.labels, args.recordings)
        tracks = [follow(_maker(args, None), scaled(film, args.size), film.task, args.click,
                         keep=True) for film in films]
        shown = tracks
        for track in tracks:
            rows += summarise([track], track.name)
    else:
        for recording in args.recordings:
            reading = reading_like({}, [recording], args.image_topic)
            store = open_recordings(recording, reading=reading)
            camera = fit_camera(store)
            few = max(1, STRIPS // len(args.recordings))
            tracks = [follow(_maker(args, camera), scaled(episode, args.size),
                             Path(recording).name, args.click, keep=i < few)
                      for i, episode in enumerate(store)
                      if np.isfinite(episode.object_pixels).all(-1).any()]
            if not tracks:
                raise ConfigError(f'{recording}: no episode of it says where objects are; give '
                                  '--labels')
            rows += summarise(tracks, Path(recording).name)
            shown += tracks
    for row in rows:
        row |= {'tracker': args.tracker, 'click_px': args.click, 'size': args.size}
    return rows, shown


def _maker(args: Tracking, camera: PinholeCamera | None) -> Callable[[], Tracker]:
    """Return what makes the tracker."""
    make = load_plugin('tap_ros.trackers', args.tracker)
    if make is RigidTracker and not args.click:
        return partial(RigidTracker, camera, snap=False)  # the click is the truth
    return partial(make, camera)


def summarise(tracks: Sequence[Track], name: str) -> list[dict[str, Any]]:
    """
    Score tracks.

    :param name: of their recording.
    :return: list of dicts: recording, metric, step (of confidence), value, ci_low, ci_high, n.
    """
    rows: list[dict[str, Any]] = []

    def add(metric: str, found: Iterable[float], n: int, step: float = 0) -> None:
        value, low, high = (round(float(x), 4) for x in found)
        rows.append({'recording': name, 'metric': metric, 'step': step, 'value': value,
                     'ci_low': low, 'ci_high': high, 'n': n})

    objects = [(track.errors[:, k], track.states[:, k]) for track in tracks
               for k in range(track.errors.shape[1])]
    known = [np.isfinite(errors) for errors, _ in objects]
    errors = [one[0][good] for one, good in zip(objects, known)]
    seen = [one[1][good] == SEEN for one, good in zip(objects, known)]
    count = sum(map(len, errors))
    if not count:
        return rows
    add('median_px', _over_objects(np.median, errors), count)
    add('within_2px', _over_objects(np.mean, [one <= RIGHT for one in errors]), count)
    wrong = [(one > WRONG) & sure for one, sure in zip(errors, seen)]
    add('wrong_sure', _over_objects(np.mean, wrong), count)
    add('longest_wrong_sure', [max(map(longest_wrong, wrong))] * 3, len(objects))
    add('lost', share_interval([states[-1] == LOST for _, states in objects]), len(objects))
    again = [one for track in tracks for one in recoveries(track)]
    if again:
        add('recovered', share_interval(again), len(again))
    ms = [track.ms for track in tracks if len(track.ms)]
    add('cpu_ms', _over_objects(np.mean, ms), sum(map(len, ms)))
    clicks = np.concatenate([track.selected for track in tracks])
    add('selected_px', bootstrap(lambda x: np.median(x, -1), clicks), len(clicks))
    refused = sum(track.refused for track in tracks)
    add('refused', share_interval([1] * refused + [0] * len(clicks)), refused + len(clicks))
    _goals(tracks, add)
    confidence = np.concatenate([track.confidence.ravel() for track in tracks])
    error = np.concatenate([track.errors.ravel() for track in tracks])
    for low, high in zip(BINS, BINS[1:]):
        inside = (confidence >= low) & (confidence < high + (high == 1)) & np.isfinite(error)
        if inside.any():
            add('confidence', share_interval(error[inside] <= RIGHT), int(inside.sum()), low)
    return rows


def _goals(tracks: Sequence[Track], add: Callable[..., None]) -> None:
    """Score what was found in goal pictures."""
    error = np.concatenate([track.goal_errors for track in tracks])
    found = np.array([state == SEEN for track in tracks for state in track.goal_states])
    asked = np.array([np.isfinite(track.goal_errors).any() for track in tracks for _ in
                      track.goal_states])
    visible = asked & ~np.concatenate([track.goal_covered for track in tracks])
    if not asked.any():
        return
    right = found & (error <= RIGHT)
    for name, what, among in (
            ('right', right, asked), ('wrong', found & ~right, asked),
            ('refused', ~found, asked), ('visible_right', right, visible)):
        add(f'goal_{name}', share_interval(what[among]), int(among.sum()))


def _over_objects(statistic: Callable[[np.ndarray], Any],
                  parts: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """Return a statistic of all parts together, and its interval over the parts."""
    rng, parts = np.random.default_rng(0), [np.asarray(part, float) for part in parts]
    drawn = [statistic(np.concatenate([parts[i] for i in rng.integers(len(parts), size=len(
        parts))])) for _ in range(500)]
    low, high = np.percentile(drawn, (2.5, 97.5))
    return float(statistic(np.concatenate(parts))), float(low), float(high)


def print_table(rows: Sequence[dict[str, Any]]) -> None:
    """Print the meaning of metrics, then a line a row."""
    for metric in dict.fromkeys(row['metric'] for row in rows):
        print(f'{metric}: {MEANING[metric]}')
    print('in brackets 95% intervals over objects, then of how many')
    for row in rows:
        step = f'{row["step"]:g}' if row['metric'] == 'confidence' else ''
        print(f'{row["recording"]:20s}{row["metric"]:19s}{step:5s}{row["value"]:8.3f} '
              f'({row["ci_low"]:.3f}, {row["ci_high"]:.3f}), {row["n"]}')


def draw(tracks: Sequence[Track]) -> np.ndarray:
    """Draw strips, a row a track, with the outlines of what is seen."""
    return grid([[_outlined(*one) for one in film_strip_of(track)]
                 for track in [track for track in tracks if track.shown][:STRIPS]])


def film_strip_of(track: Track, count: int = 8) -> list[tuple[np.ndarray, Tracked]]:
    """Choose evenly spaced pictures of a track."""
    return [track.shown[int(i)] for i in film_strip(np.arange(len(track.shown)), count)]


def _outlined(frame: np.ndarray, tracked: Tracked) -> np.ndarray:
    """Draw outlines into a square panel; dots where objects are not seen."""
    scale = PANEL / max(frame.shape[:2])
    panel = np.full((PANEL, PANEL, 3), 255, np.uint8)
    small = np.asarray(cv2.resize(frame, None, fx=scale, fy=scale, interpolation=(
        cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)))[:PANEL, :PANEL]
    panel[:small.shape[0], :small.shape[1]] = small
    for k, (pixel, state, line) in enumerate(zip(
            tracked.pixels, tracked.states, tracked.outlines)):
        colour = OBJECT_COLOURS[k % len(OBJECT_COLOURS)]
        if state == SEEN and len(line):
            cv2.polylines(panel, [np.rint((line + 0.5) * scale - 0.5).astype(np.int32)], True,
                          colour, 1, cv2.LINE_AA)
        elif np.isfinite(pixel).all():
            u, v = np.rint((pixel + 0.5) * scale - 0.5).astype(int).tolist()
            cv2.drawMarker(panel, (u, v), colour, cv2.MARKER_TILTED_CROSS, 8, 1, cv2.LINE_AA)
    return panel
