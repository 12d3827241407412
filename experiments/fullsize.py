# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command `python -m experiments fullsize`: how sharp subgoals are at the camera's resolution.

Shipped weights of 64 px answer in new scenes of a camera of 256 px; the truth is what the camera
would see, where that is known, else the nearest frame of a new demonstration.
"""

from collections.abc import Iterator
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Any

import cv2
from experiments.pages import markdown, render
from experiments.tables import said
import numpy as np
from pandas import DataFrame
from PIL import Image
from sim_bridge.simulator import Simulator
from tap_ros.base.contract import CAMERA_SIZE
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically
from tap_ros.base.options import Folder
from tap_ros.base.progress import Progress
from tap_ros.evaluation.intervals import mean_interval
from tap_ros.evaluation.strips import write_lines
from tap_ros.images.drawing import grid
from tap_ros.images.pixels import resize_image, to_float
from tap_ros.prediction.networks import PredictorNetwork
from tap_ros.prediction.predictor import load_network, SubgoalPredictor
from tap_ros.prediction.warp import expected_pixels, one_hot_maps, warp_object_maps
import torch
from torch.nn import functional

FIRST_SCENE = 910_000  # seeds from here on are in no recording that anything is trained on
ROWS = ('push2', 'order2', 'order2 demonstrated', 'stack2', 'grasp', 'pick_place')
# Mean absolute errors of 255 to be reached, in the same order; none of the second.
AIMS = dict(zip(ROWS, (0.1, None, 1.1, 0.75, 1.15, 1.5)))
WAYS = {'enlarged': '64 px enlarged', 'full': 'flow at full size', 'copied': 'copying',
        'small': 'small, at 64 px'}
SHOWN = 1  # scenes of each row in the picture
COLUMNS, TITLE = ('start', 'goal', 'enlarged', 'full size', 'truth'), 20  # of it; px


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param weights: files instead of shipped weights, such as
        grasp=runs/grasp/predictor.safetensors; then only their rows are scored.
    :param scenes: of each row of the table.
    :param first_scene: its seed; what is chosen by scenes is chosen by others than the table's.
    :param out: folder for fullsize.json, fullsize.jpg and fullsize.md.
    """

    weights: tuple[str, ...] = ()
    scenes: int = 50
    first_scene: int = FIRST_SCENE
    out: Folder = 'runs/results'


@dataclass(frozen=True)
class Case:
    """
    What is asked, and what would be right.

    :param start, goal: uint8 (H, W, 3); start_pixels, goal_pixels: (K, 2) of the objects.
    :param truths: uint8 (N, H, W, 3), each of which is right.
    :param places: (N, K, 2), the objects in these.
    """

    start: np.ndarray
    goal: np.ndarray
    start_pixels: np.ndarray
    goal_pixels: np.ndarray
    truths: np.ndarray
    places: np.ndarray


def run(args: Options) -> None:
    """Score, print the table, and write the results."""
    torch.set_num_threads(1)
    found, sheet = dict[str, list[dict[str, float]]](), list[list[np.ndarray]]()
    for row, weights in scored(args.weights).items():
        task, _, demonstrated = row.partition(' ')
        network, training = load_network(weights)
        predictor = SubgoalPredictor(network, training)
        camera = Simulator(task)
        scores = found[row] = []
        try:
            seeds = range(args.first_scene, args.first_scene + args.scenes)
            for case in Progress(cases(camera, seeds, bool(demonstrated)), row, args.scenes,
                                 delay=1):
                score, pictures = compare(network, predictor, case)
                scores.append(score)
                if len(scores) <= SHOWN:
                    sheet.append(pictures)
        finally:
            camera.close()
    folder = Path(args.out)
    write_atomically(folder / 'fullsize.json', '{' + ',\n'.join(
        f'"{row}": {json.dumps(scores)}' for row, scores in found.items()) + '}\n')
    write_atomically(folder / 'fullsize.md', page(found, args.first_scene))
    write_sheet(folder / 'fullsize.jpg', sheet)
    print(table(found))
    print(folder / 'fullsize.md')


def scored(weights: tuple[str, ...]) -> dict[str, str]:
    """Return the weights of each row of the table, by its name; see Options."""
    if not weights:
        return {row: row.partition(' ')[0] for row in ROWS}
    given = dict(one.partition('=')[::2] for one in weights)
    for name, file in given.items():
        if not file or not any(row.partition(' ')[0] == name for row in ROWS):
            raise ConfigError(f'weights: expected a row and a file, such as grasp=FILE; rows: '
                              f'{", ".join(ROWS)}; got {name}')
    return {row: given[name] for row in ROWS if (name := row.partition(' ')[0]) in given}


def cases(camera: Simulator, seeds: range, demonstrated: bool) -> Iterator[Case]:
    """Yield a Case of each seed: of the objects pushed in turn, or of a demonstration."""
    for seed in seeds:
        if demonstrated or camera.task.kind != 'push':
            episode = camera.demonstrate(seed).episode
            yield Case(episode.frames[0], episode.frames[-1], episode.object_pixels[0],
                       episode.object_pixels[-1], episode.frames[1:-1],
                       episode.object_pixels[1:-1])
            continue
        start, goal = camera.reset(seed), camera.goal()
        truths = []
        for k in camera.scene.order[:1] if camera.task.ordered else range(len(start.object_poses)):
            poses = np.array(start.object_poses)
            poses[k] = goal.object_poses[k]
            truths.append(camera.photograph(poses, start.gripper, hide_arm=True))
        yield Case(start.image, goal.image, start.object_pixels, goal.object_pixels,
                   np.stack([one.image for one in truths]),
                   np.stack([one.object_pixels for one in truths]))


def compare(network: PredictorNetwork, predictor: SubgoalPredictor,
            case: Case) -> tuple[dict[str, float], list[np.ndarray]]:
    """
    Predict small and at full size.

    All errors are to the truth that is nearest to the small prediction enlarged.

    :return: mean absolute errors of 255 by WAYS, and how far the objects are from their places, in
        pixels of the network, by its maps and by maps of the full size; start, goal, both
        predictions and the truth.
    """
    size, small = case.start.shape[:2], predictor.image_size
    full, = predictor.predict(case.start, case.goal, case.start_pixels, case.goal_pixels)
    answer, = predictor.predict(resize_image(case.start, small), resize_image(case.goal, small))
    enlarged = cv2.resize(answer.image, size[::-1], interpolation=cv2.INTER_CUBIC)

    def errors(picture: np.ndarray) -> np.ndarray:
        return np.array([cv2.absdiff(picture, truth).mean() for truth in case.truths])

    coarse = errors(enlarged)
    at = int(coarse.argmin())
    scale = size[0] / small[0]
    score = {'enlarged': coarse[at], 'full': errors(full.image)[at],
             'copied': min(errors(case.start)[at], errors(case.goal)[at]),
             'small': cv2.absdiff(answer.image, resize_image(case.truths[at], small)).mean()}
    for name, found in (('objects_px', full.expected_pixels),
                        ('objects_full_px', places_at_full_size(network, case))):
        score[name] = np.linalg.norm(found - case.places[at], axis=1).mean() / scale
    return ({name: round(float(value), 4) for name, value in score.items()},
            [case.start, case.goal, enlarged, full.image, case.truths[at]])


def places_at_full_size(network: PredictorNetwork, case: Case) -> np.ndarray:
    """Return where maps of the full size put the objects, (K, 2), by flow and masks enlarged."""
    size, small = case.start.shape[:2], (network.config.image_size,) * 2
    pictures = np.stack([resize_image(one, small) for one in (case.start, case.goal)])
    places = torch.from_numpy(np.stack([case.start_pixels, case.goal_pixels]))
    with torch.inference_mode():
        prediction = network(to_float(pictures)[None])
        flow, masks = (functional.interpolate(values[0], size, mode='bilinear')[None]
                       for values in (prediction.flow, prediction.masks))
        maps = warp_object_maps(one_hot_maps(places, size)[None], flow * size[0] / small[0], masks)
        return expected_pixels(maps.maps)[0].numpy()


def table(found: dict[str, list[dict[str, float]]]) -> str:
    """Return the table of mean absolute errors of 255."""
    lines = []
    for row, scores in found.items():
        each = {way: np.array([score[way] for score in scores]) for way in WAYS}
        ours, aim = mean_interval(each['full']), AIMS[row]
        line: dict[str, Any] = {'weights': row.replace(' ', ', ')}
        for way, name in WAYS.items():
            line[name] = f'{each[way].mean():.2f}'
        line[WAYS['full']] = '{:.2f} ({:.2f} to {:.2f})'.format(*ours)
        line['aim'] = '' if aim is None else said(f'{aim:g}', ours.value <= aim)
        lines.append(line)
    return markdown(DataFrame(lines))


def truth_is_known(row: str) -> bool:
    """Return whether a row of the table has true pictures."""
    return row in ('push2', 'order2')


def page(found: dict[str, list[dict[str, float]]], first_scene: int = FIRST_SCENE) -> str:
    """Write the page of the results."""
    known = [row for row in found if truth_is_known(row)] or found
    small, full = (np.mean([score[name] for row in known for score in found[row]])
                   for name in ('objects_px', 'objects_full_px'))
    better = [score['full'] < score['enlarged'] for scores in found.values() for score in scores]
    return render('templates/fullsize.md.j2', table=table(found), size=CAMERA_SIZE,
                  better=f'{np.mean(better):.0%}', scenes=len(next(iter(found.values()))),
                  seed=first_scene, small_px=f'{small:.2f}', full_px=f'{full:.2f}')


def write_sheet(path: Path, rows: list[list[np.ndarray]]) -> None:
    """Write pictures side by side as JPEG, with titles."""
    head = grid([[write_lines([title], (TITLE, CAMERA_SIZE)) for title in COLUMNS]])
    Image.fromarray(np.concatenate([head, grid(rows)])).save(path, quality=88)
