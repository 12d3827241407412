# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the command `python -m tap_ros evaluate forward` does: how well it is told what comes."""

from collections.abc import Mapping
from pathlib import Path
import shlex
from typing import Any

import numpy as np
from tap_ros.apps.evaluate import Forward
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_rows
from tap_ros.evaluation.intervals import against_copying, mean_interval
from tap_ros.images.robot_mask import fill_from_past
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.recording.bags import find_bags, reading_like
from tap_ros.recording.cache import open_recordings
from tap_ros.training.forward_scores import measure_maps, measure_pictures, MOVED_PIXELS
from tap_ros.training.inpainted import FilledStore, with_masks
from tap_ros.training.split import split_episodes, TEST_FRACTION
from tap_ros.weights import FORWARD_MODEL
from tap_ros.weights.weights import load_weights

# Of a measurement its metric and its method.
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


def run(args: Forward) -> None:
    """
    Print a table, and write what --out asks for.

    :raises ConfigError: if there is nothing to score, or the pictures have another size.
    """
    model = LearnedForwardModel.load(args.weights, args.device)
    _, _, training = load_weights(args.weights, 'forward_model')
    rows = []
    for recording in args.recordings:
        bags = find_bags(recording)
        store = open_recordings(bags, reading=reading_like(
            training, bags, args.image_topic, model.camera_crop))
        if store.image_size != (model.config.image_size,) * 2:
            raise ConfigError(f'{args.weights}: made for {model.config.image_size} pixels a side, '
                              f'{recording} has {store.image_size}; use matching ones')
        fraction, robot_mask = min(args.test_fraction, 1), model.config.robot_mask
        everything = np.arange(len(store))
        parts = (everything, everything) if fraction == 1 else split_episodes(
            store, fraction, held_out=training.get('settings', {}).get('held_out', ()))
        held_out = with_masks(store, parts, robot_mask)[1]
        filled = store if robot_mask == 'none' else FilledStore(
            store, robot_mask, filling=fill_from_past)
        measured = measure_maps(model, filled, held_out)
        if not measured:
            measured = measure_pictures(model, filled, held_out)
        if not measured:
            raise ConfigError(f'{recording}: no held-out episode of two frames or more; give more '
                              'of them, or --test-fraction 1')
        words = ['python', '-m', 'tap_ros', 'evaluate', 'forward', '--recordings', recording]
        for option, value, usual in (('--weights', args.weights, str(FORWARD_MODEL)),
                                     ('--test-fraction', args.test_fraction, TEST_FRACTION)):
            words += [option, str(value)] if value != usual else []
        command = shlex.join(words)
        rows += make_rows(Path(recording).name, measured, store.data_hash, command)
    for metric in dict.fromkeys(row['metric'] for row in rows):
        print(f'{metric}: {MEANING[metric]}')
    print('in brackets 95% intervals, then of how many objects or episodes')
    for row in rows:
        print(f'{row["task"]:12s} step {row["step"]:2d}  {row["metric"]:13s}{row["method"]:15s}'
              f'{row["value"]:8.4f} ({row["ci_low"]:.4f}, {row["ci_high"]:.4f}), {row["n"]}'
              f'  {row.get("verdict", "")}')
    if args.out:
        write_rows(Path(args.out, FILE), rows)


def make_rows(task: str, measured: Mapping[int, Mapping[str, np.ndarray]], data_hash: str,
              command: str) -> list[dict[str, Any]]:
    """
    Turn measurements into rows.

    :param task: name of the recording; data_hash: of the recording.
    :param measured: of measure_maps or measure_pictures.
    :return: list of dicts: task, method, metric, step, value, ci_low, ci_high, n, data_hash,
        command; of predicted pictures verdict, which compares them with copying.
    """
    rows = []
    for step, parts in measured.items():
        for name, values in parts.items():
            metric, method = METHODS[name]
            known = values[np.isfinite(values)]
            if not len(known):
                continue
            value, low, high = (round(x, 4) for x in mean_interval(known))
            rows.append({'task': task, 'method': method, 'metric': metric, 'step': step,
                         'value': value, 'ci_low': low, 'ci_high': high, 'n': len(known),
                         'data_hash': data_hash, 'command': command})
            if name in COPYING:
                copied = parts[COPYING[name]][np.isfinite(values)]
                rows[-1]['verdict'] = against_copying(known, copied)[0]
    return rows
