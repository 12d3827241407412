# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros evaluate forward`: how well it is told what comes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_rows
from tap_ros.base.options import Bags, Folder, ShippedFile, Topic
from tap_ros.evaluation.intervals import against_copying, mean_interval
from tap_ros.images.robot_mask import fill_from_past
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.recording.bags import find_bags, reading_like
from tap_ros.recording.cache import open_recordings
from tap_ros.training.forward_scores import measure_maps, measure_pictures, MOVED_PIXELS
from tap_ros.training.frames import FilledStore
from tap_ros.training.split import split_as_trained, TEST_FRACTION, with_masks
from tap_ros.weights import find_forward_model, FORWARD_MODEL
from tap_ros.weights.weights import load_weights

# Of a measurement its metric and its method; of predicted pictures what they are compared with.
METHODS = {'map_error': ('map_error_px', 'forward_model'),
           'nothing_moves': ('map_error_px', 'nothing'),
           'true_simulator': ('map_error_px', 'true_simulator'),
           'picture': ('picture_l1', 'forward_model'), 'copying': ('picture_l1', 'copying'),
           'changed_picture': ('changed_l1', 'forward_model'),
           'changed_copying': ('changed_l1', 'copying')}
COPYING = {'picture': 'copying', 'changed_picture': 'changed_copying'}
MEANING = {
    'map_error_px': f'px from the expected pixel, of objects that moved more than '
                    f'{MOVED_PIXELS:.0f} px; maps begin at the true pixels',
    'picture_l1': 'error of the predicted picture on [0, 1], and of the picture begun with; no '
                  'object pixels tell of motion',
    'changed_l1': 'the same over the pixels that changed since then'}
FILE = 'forward_model.json'


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    Pictures are filled behind the robot as the weights' training was.

    :param recordings: bag folders; each is scored on its own: by object pixels, else by pictures.
    :param image_topic: the camera's topic; needed where several topics of pictures are in them.
    :param weights: of a forward model: a file, or 'push', the shipped one.
    :param test_fraction: 1: all episodes, not only those that training held out; else the share
        of these, of weights that do not tell which they are.
    :param device: cpu or cuda.
    :param out: write forward_model.json there.
    """

    recordings: Bags
    image_topic: Topic = ''
    weights: ShippedFile = str(FORWARD_MODEL)
    test_fraction: float = TEST_FRACTION
    device: str = 'cpu'
    out: Folder = ''


def run(args: Options) -> None:
    """
    Print a table, and write what --out asks for.

    :raises ConfigError: if there is nothing to score, or the pictures have another size.
    """
    weights = find_forward_model(args.weights)
    model = LearnedForwardModel.load(weights, args.device)
    _, _, training = load_weights(weights, 'forward_model')
    rows = []
    for recording in args.recordings:
        bags = find_bags(recording)
        store = open_recordings(bags, reading=reading_like(
            training, bags, args.image_topic, model.camera_crop))
        if store.image_size != (model.config.image_size,) * 2:
            raise ConfigError(f'{args.weights}: made for {model.config.image_size} pixels a side, '
                              f'{recording} has {store.image_size}; use matching ones')
        robot_mask, everything = model.config.robot_mask, np.arange(len(store))
        held_out = with_masks(store, (everything, everything) if args.test_fraction >= 1 else (
            split_as_trained(store, training, args.test_fraction)), robot_mask)[1]
        filled = store if robot_mask == 'none' else FilledStore(
            store, robot_mask, filling=fill_from_past)
        measured = measure_maps(model, filled, held_out) or measure_pictures(
            model, filled, held_out)
        if not measured:
            raise ConfigError(f'{recording}: no held-out episode of two frames or more; give more '
                              'of them, or --test-fraction 1')
        rows += make_rows(Path(recording).name, measured, store.data_hash)
    for metric in dict.fromkeys(row['metric'] for row in rows):
        print(f'{metric}: {MEANING[metric]}')
    print('in brackets 95% intervals, then of how many objects or episodes')
    for row in rows:
        print(f'{row["task"]:12s} step {row["step"]:2d}  {row["metric"]:13s}{row["method"]:15s}'
              f'{row["value"]:8.4f} ({row["ci_low"]:.4f}, {row["ci_high"]:.4f}), {row["n"]}'
              f'  {row.get("verdict", "")}')
    if args.out:
        write_rows(Path(args.out, FILE), rows)


def make_rows(task: str, measured: Mapping[int, Mapping[str, np.ndarray]],
              data_hash: str) -> list[dict[str, Any]]:
    """
    Turn measurements into rows.

    :param task: name of the recording; data_hash: of the recording.
    :param measured: of measure_maps or measure_pictures.
    :return: list of dicts: task, method, metric, step, value, ci_low, ci_high, n, data_hash; of
        predicted pictures verdict, which compares them with copying.
    """
    rows: list[dict[str, Any]] = []
    for step, parts in measured.items():
        for name, values in parts.items():
            (metric, method), known = METHODS[name], np.isfinite(values)
            if known.any():
                value, low, high = (round(x, 4) for x in mean_interval(values[known]))
                rows.append({'task': task, 'method': method, 'metric': metric, 'step': step,
                             'value': value, 'ci_low': low, 'ci_high': high,
                             'n': int(known.sum()), 'data_hash': data_hash})
                if name in COPYING:
                    rows[-1]['verdict'] = against_copying(
                        values[known], parts[COPYING[name]][known])[0]
    return rows
