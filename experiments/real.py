# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m experiments real`: predictors from a few marks of real demonstrations."""

from dataclasses import dataclass, replace
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tap_ros.apps.label_command import frames_of
from tap_ros.apps.train import train
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically
from tap_ros.base.options import File, Folder, Topic
from tap_ros.evaluation.hits import seconds_off
from tap_ros.evaluation.intervals import bootstrap, share_interval
from tap_ros.evaluation.prediction import evaluate
from tap_ros.images.drawing import grid
from tap_ros.prediction.nearest_keyframe import NearestKeyframe
from tap_ros.prediction.predictor import load_network, SubgoalPredictor
from tap_ros.prediction.protocol import Request
from tap_ros.recording.bags import reading_like
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.marks import write_marks
from tap_ros.recording.reading import Reading
from tap_ros.training.labels import film_of, label, SIZE

WITHIN_S = 0.5, 1.0
ROWS = 6  # demonstrations that are drawn
COPYING: dict[str, Any] = {'keyframes': True, 'new_pixels': False}
# A folder: the name in the table, and settings beside those of `foreign`.
WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    'two': ('two pictures, new pixels', {}),
    'keyframes': ('keyframes, copying', COPYING),
    # 2.25 times the pixels: as many steps less.
    'keyframes_96px': ('keyframes, 96 px, equal time', COPYING | {'size': 96, 'steps': 355})}
DRAWN = 'two', 'keyframes'  # of them, in pictures
QUALITY = 65  # of these, as JPEG
COLUMNS = 5  # pairs of an answer and the true frame, in the picture of all


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    It prints, for predictors and for the keyframes of the most alike demonstrations, the error at
    the moment over copying there, and how often the moment is right, in the held-out ones of all
    draws.

    :param recordings: one bag folder with all demonstrations.
    :param truth: JSON file {episode: {"grasp_s": 2.6, ...}}, s from the start of each episode.
    :param name: the moment.
    :param image_topic: the camera's topic; needed where several topics of pictures are in them.
    :param marks: demonstrations that are marked in each draw.
    :param held_out: demonstrations that are scored in each draw.
    :param trained_on: demonstrations, the marked among them; 0: all others.
    :param draws: how many, each with others held out and marked; draw k has the seed k.
    :param out: folder of the trainings; those that are done are kept.
    """

    recordings: Folder
    truth: File
    name: str = 'grasp'
    image_topic: Topic = ''
    marks: int = 10
    held_out: int = 10
    trained_on: int = 0
    draws: int = 4
    out: Folder = 'runs/real'


def run(options: Options) -> None:
    """Train and score what is not there yet, and print the table."""
    truth = json.loads(Path(options.truth).read_text())
    rows: dict[str, list[np.ndarray]] = {}
    for draw in range(options.draws):
        path = Path(options.out, f'{options.name}_{draw}', 'scores.json')
        if not path.exists():
            found = score(options, truth, draw, path.parent)
            write_atomically(path, json.dumps(found) + '\n')
        for way, values in json.loads(path.read_text()).items():
            rows.setdefault(way, []).append(np.array(values))
    write_atomically(Path(options.out, f'{options.name}.json'), '{' + ',\n'.join(
        f'"{way}": {json.dumps([part.round(5).tolist() for part in parts])}'
        for way, parts in rows.items()) + '}\n')
    within = ' | '.join(f'within {s:g} s' for s in WITHIN_S)
    six, every = sheets(options, truth)
    for name, image in ((options.name, six), (f'{options.name}_all', every)):
        cv2.imwrite(str(Path(options.out, f'{name}.jpg')), image[..., ::-1],
                    [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    print(f'| {options.name}, {options.marks} marks, {options.draws} draws | error at the moment '
          f'/ copying | {within} |\n|---|---|---|---|')
    for way, parts in rows.items():
        error, copying, off = np.concatenate(parts, 1)
        ratio = bootstrap(lambda a, b: a.mean(-1) / b.mean(-1), error, copying)
        shares = [share_interval(off <= s + 1e-3) for s in WITHIN_S]
        print(f'| {way} | {ratio.value:.2f} ({ratio.low:.2f} to {ratio.high:.2f}) | ' + ' | '.join(
            f'{one.value:.0%} ({one.low:.0%} to {one.high:.0%})' for one in shares) + ' |')


def sheets(options: Options, truth: dict[str, dict[str, float]]) -> tuple[np.ndarray, np.ndarray]:
    """
    Draw held-out demonstrations at the camera's resolution.

    :return: of the first draw rows of start, goal, what each predictor shows, and the frame of the
        moment; of all draws, side by side, what that with keyframes shows, and that frame.
    """
    first, pairs = list[list[np.ndarray]](), list[np.ndarray]()
    for draw in range(options.draws):
        folder = Path(options.out, f'{options.name}_{draw}')
        predictors = [SubgoalPredictor(*load_network(folder / way / 'predictor.safetensors'))
                      for way in DRAWN]
        store = open_recordings(options.recordings, reading=replace(reading_like(
            predictors[0].training, [options.recordings]), size=0))
        for i in sorted(order_of(len(store), options, draw)[:options.held_out]):
            frames = store.frames(i)
            (at, _), = frames_of(store, i, np.array([truth[str(i)][f'{options.name}_s']]))
            request = Request(frames[0], frames[-1])
            answers = [one.predict_together([request])[0][0].image for one in predictors]
            pairs += [answers[-1], frames[at]]
            if len(first) < ROWS:
                first.append([frames[0], frames[-1], *answers, frames[at]])
    width = 2 * COLUMNS
    pairs += [np.full_like(pairs[0], 255)] * (-len(pairs) % width)
    return grid(first), grid([pairs[k:k + width] for k in range(0, len(pairs), width)])


def order_of(count: int, options: Options, draw: int) -> list[int]:
    """Return the demonstrations in the order of a draw: those held out first, the marked last."""
    if options.draws * options.held_out > count:
        raise ConfigError(f'{options.draws} draws that hold out {options.held_out} need '
                          f'{options.draws * options.held_out} demonstrations; there are {count}')
    most = count - options.held_out
    if not options.marks <= (options.trained_on or most) <= most:
        raise ConfigError(f'trained_on {options.trained_on}: expected {options.marks}, those that '
                          f'are marked, to {most}, those that are not held out')
    return np.roll(np.random.default_rng(0).permutation(count),
                   -draw * options.held_out).tolist()


def score(options: Options, truth: dict[str, dict[str, float]], draw: int,
          folder: Path) -> dict[str, list[list[float]]]:
    """Return of each way the errors at the moment, those of copying there, and how many s off."""
    whole = open_recordings(options.recordings, reading=Reading(
        image_topic=options.image_topic, crop='whole', size=SIZE))
    moments = [np.array([truth[str(i)][f'{options.name}_s']]) for i in range(len(whole))]
    order = order_of(len(whole), options, draw)
    held_out, marked = sorted(order[:options.held_out]), order[-options.marks:]
    left_out = sorted(order[:-options.trained_on] if options.trained_on else held_out)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / 'marks.json'
    write_marks(file, whole, [options.recordings], {
        i: frames_of(whole, i, moments[i]) for i in marked})
    marks = {i: frames_of(whole, i, moments[i]) for i in held_out}
    found = {}

    def add(name: str, predictor: Any, store: EpisodeStore) -> None:
        scores = evaluate(predictor, store, held_out, 'last', marks=marks)['prediction']
        found[name] = [scores.at_mark.tolist(), scores.copying_at_mark.tolist(), seconds_off(
            [marks[i] for i in held_out], [store[i].stamps for i in held_out],
            scores.match_step).tolist()]

    for way, (name, settings) in WAYS.items():
        weights = train(
            options.recordings, folder / way, **{
                'recipe': 'foreign', 'marks': str(file), 'crop': 'centre', 'size': SIZE,
                'image_topic': tuple(filter(None, [options.image_topic])), 'threads': 1,
                'seed': draw, 'held_out': (
                    f'{options.recordings}:{",".join(map(str, left_out))}',), **settings})
        network, training = load_network(weights)
        add(name, network, open_recordings(options.recordings, reading=reading_like(
            training, [options.recordings])))
    store = open_recordings(options.recordings, reading=Reading(
        image_topic=options.image_topic, crop='centre', size=SIZE))
    labels = label([film_of(whole, i) for i in range(len(whole))], {
        i: moments[i] for i in marked}, [options.name]).moments
    add('most alike keyframes', NearestKeyframe(store, {
        i: frames_of(store, i, labels[i]) for i in range(len(store)) if i not in left_out}), store)
    return found
