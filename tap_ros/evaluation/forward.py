# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros evaluate forward`: how well object maps are carried."""

from collections.abc import Mapping
from pathlib import Path
import shlex
from typing import Any

import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.evaluation.command import Forward
from tap_ros.evaluation.intervals import mean_interval
from tap_ros.files import write_rows
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.forward_scores import measure_maps, MOVED_PIXELS
from tap_ros.recording.bags import reading_like
from tap_ros.recording.cache import open_recordings
from tap_ros.training.inpainted import FilledStore, with_masks
from tap_ros.training.robot_mask import fill_from_past
from tap_ros.training.split import split_episodes, TEST_FRACTION
from tap_ros.training.weights import load_weights
from tap_ros.weights import FORWARD_MODEL

METHODS = {'map_error': 'forward_model', 'nothing_moves': 'nothing',
           'true_simulator': 'true_simulator'}
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
        store = open_recordings(
            [recording], reading=reading_like(training, [recording], args.image_topic))
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
            raise ConfigError(f'{recording}: no held-out episode of 16 frames or more has object '
                              'pixels that move; give more of them, or --test-fraction 1')
        words = ['python', '-m', 'tap_ros', 'evaluate', 'forward', '--recordings', recording]
        for option, value, usual in (('--weights', args.weights, str(FORWARD_MODEL)),
                                     ('--test-fraction', args.test_fraction, TEST_FRACTION)):
            words += [option, str(value)] if value != usual else []
        command = shlex.join(words)
        rows += make_rows(Path(recording).name, measured, store.data_hash, command)
    print(f'error of the expected pixel, px, for objects that moved more than {MOVED_PIXELS:.0f} '
          'px; maps begin at the true pixels; in brackets 95% intervals over the objects')
    for row in rows:
        print(f'{row["task"]:12s} step {row["step"]:2d}  {row["method"]:16s}{row["value"]:6.2f} '
              f'({row["ci_low"]:.2f}, {row["ci_high"]:.2f}), {row["n"]} objects')
    if args.out:
        write_rows(Path(args.out, FILE), rows)


def make_rows(task: str, measured: Mapping[int, Mapping[str, np.ndarray]], data_hash: str,
              command: str) -> list[dict[str, Any]]:
    """
    Turn measurements into rows.

    :param task: name of the recording; measured: of measure_maps; data_hash: of the recording.
    :return: list of dicts: task, method, metric, step, value, ci_low, ci_high (px), n, data_hash,
        command.
    """
    rows = []
    for step, parts in measured.items():
        for name, method in METHODS.items():
            value, low, high = (round(x, 4) for x in mean_interval(parts[name]))
            rows.append({'task': task, 'method': method, 'metric': 'map_error_px', 'step': step,
                         'value': value, 'ci_low': low, 'ci_high': high, 'n': len(parts[name]),
                         'data_hash': data_hash, 'command': command})
    return rows
