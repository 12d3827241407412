# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A picture of predictions in the paper's format (Figs. 5, 6 and 9).

The episodes are the first held-out ones, whatever they look like.
"""

from pathlib import Path

from experiments.paper.figures import INK, new_figure, to_png
from experiments.paper.runs import OURS, PaperRun, SCALE
import numpy as np
from tap_ros.base.files import write_atomically
from tap_ros.evaluation.prediction import draw_latents
from tap_ros.images.pixels import to_float, to_uint8
from tap_ros.prediction.losses import l1_errors, match_step
from tap_ros.prediction.predictor import load_network
from tap_ros.recording.cache import open_recordings
from tap_ros.training.batches import make_batch, Sampling
from tap_ros.training.split import split_episodes
import torch

TASK, MODE = 'pick_place', 'bidirectional'
EPISODES = 3
# What is shown: the paper's network, then ours; beside one of them the frames that it matches.
METHODS = [('fix', ''), ('min', ''), ('genmin', ''), ('genmin-vae-gan', ''), ('fix-wo-gan', OURS),
           ('min-wo-gan', OURS), ('genmin-wo-gan', OURS), ('genmin-vae', OURS)]
MATCHED = ('genmin-wo-gan', OURS)


def write_picture(places, runs):
    """
    Write the picture of pick-and-place: what each method predicts, with new pixels.

    One that is there stays where weights of a method, or the recording that they were scored on,
    are not at hand.
    """
    by_name = {run['name']: run for run in runs}
    shown = {method: PaperRun(TASK, MODE, method[0], variant=method[1]).name for method in METHODS}
    weights = {method: Path(places.runs, SCALE, name, 'predictor.safetensors')
               for method, name in shown.items()}
    if not set(shown.values()) <= set(by_name) or not all(
            path.exists() for path in weights.values()):
        return
    run, store = by_name[shown[MATCHED]], open_recordings([places.recording(TASK)])
    _, held_out = split_episodes(store, run['config']['test_fraction'], split='crc32')
    if len(held_out) and store.data_hash == run['data']['hash']:
        columns = panels({method: load_network(path)[0] for method, path in weights.items()},
                         store, held_out[:EPISODES])
        write_atomically(Path(places.results, f'{TASK}-{MODE}.png'), draw(columns))


@torch.inference_mode()
def panels(networks, store, episodes):
    """Return by their headings columns of pictures: inputs, predictions, matched frames."""
    batch = make_batch(store, episodes, Sampling(goal_picture='last'))
    columns = dict(zip(('start', 'goal'), batch.context.numpy().swapaxes(0, 1)))
    for (method, variant), network in networks.items():
        size = network.config.latent_size  # z: the sample that the scores count as the first
        z = draw_latents(episodes, 1, size)[:, 0] if size else None
        image = network(to_float(batch.context), z).image
        columns[method + variant] = to_uint8(image)
        if (method, variant) == MATCHED:
            errors = l1_errors(image[:, None], batch.targets.movedim(-1, 2))[:, 0]
            match = match_step(errors, batch.valid)
            matched = batch.targets.numpy()[np.arange(len(match)), match]
    return {**columns, f'match of {"".join(MATCHED)}': matched}


def draw(columns):
    """Draw columns of pictures uint8 (N, H, W, 3) below their headings; return bytes of a PNG."""
    rows = len(next(iter(columns.values())))
    figure, axes = new_figure(1 + 0.9 * rows, len(columns), rows)
    for line, (heading, pictures) in zip(axes.T, columns.items()):
        line[0].set_title(heading.replace('-', '\n-').replace('+', '\n+').replace(' of ', ' of\n'),
                          fontsize=8, color=INK, va='bottom')
        for axis, picture in zip(line, pictures):
            axis.imshow(picture, interpolation='nearest')
            axis.set_axis_off()
    return to_png(figure)
