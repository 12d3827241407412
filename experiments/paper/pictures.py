# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A picture of predictions in the paper's format (Figs. 5, 6 and 9), headings drawn in.

The episodes are the first held-out ones, whatever they look like.
"""

from pathlib import Path

from experiments.paper.figures import COLOURS, family, INK
from experiments.paper.names import method_order, variant_of
from experiments.paper.runs import OURS, SCALE
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from tap_ros.evaluation.samples import draw_latents
from tap_ros.files import write_atomically
from tap_ros.images.drawing import GAP, grid, png_bytes
from tap_ros.images.pixels import to_float, to_uint8
from tap_ros.prediction.batches import make_batch, Sampling
from tap_ros.prediction.losses import l1_errors, match_step
from tap_ros.prediction.predictor import load_network
from tap_ros.recording.cache import open_recordings
from tap_ros.training.split import split_episodes
import torch

TASK, MODE, TITLE = 'pick_place', 'bidirectional', 'Pick-and-place, bidirectional'
EPISODES = 3
MATCHED = ('genmin-wo-gan+skips', 'genmin')
_DPI = 100


def write_picture(places, runs):
    """
    Write the picture of pick-and-place: what each method predicts, with new pixels.

    One that is there stays where weights of a method, or the recording that they were scored on,
    are not at hand.

    :param places: sweep.Places.
    :param runs: dicts as results.load_runs returns them.
    """
    weights = {}
    for run in sorted(runs, key=lambda run: (method_order(run['method']), run['seed'])):
        if (run['task'], run['mode']) == (TASK, MODE) and variant_of(run['method']) in (
                '', OURS) and run.get('recursion', 1) == 1:
            weights.setdefault(run['method'], (
                Path(places.runs, SCALE, run['name'], 'predictor.safetensors'), run))
    if not weights or not all(path.exists() for path, _ in weights.values()):
        return
    run = next(iter(weights.values()))[1]
    store = open_recordings([places.recording(TASK)])
    _, held_out = split_episodes(store, run['config']['test_fraction'])
    if len(held_out) and store.data_hash == run['data']['hash']:
        headings, rows = _panels({method: load_network(path)[0]
                                  for method, (path, _) in weights.items()},
                                 store, held_out[:EPISODES])
        write_atomically(Path(places.results, f'{TASK}-{MODE}.png'),
                         png_bytes(draw(TITLE, headings, rows)))


@torch.inference_mode()
def _panels(networks, store, episodes):
    """Show inputs, the output of each method, and the match of genmin; return headings, rows."""
    batch = make_batch(store, episodes, Sampling(goal_picture='last'))
    context = batch.context.numpy()
    headings = [(text, INK) for text in ('start', 'goal')]
    rows, matched = [list(pictures) for pictures in context], None
    for method, network in networks.items():
        size = network.config.latent_size  # z: the sample that the scores count as the first
        z = draw_latents(episodes, 1, size)[:, 0] if size else None
        image = network(to_float(batch.context), z).image
        headings.append((heading(method), COLOURS[family(method)]))
        for row, panel in zip(rows, to_uint8(image)):
            row.append(panel)
        if method in MATCHED and matched is None:
            errors = l1_errors(image[:, None], batch.targets.movedim(-1, 2))[:, 0]
            match = match_step(errors, batch.valid)
            matched = method, batch.targets.numpy()[np.arange(len(match)), match]
    if matched is not None:
        headings.append((f'match of\n{heading(matched[0])}', INK))
        for row, frame in zip(rows, matched[1]):
            row.append(frame)
    return headings, rows


def draw(title, headings, rows, scale=2):
    """
    Draw a sheet of panels with a title and headings above the columns.

    :param title: one line of text.
    :param headings: list of (text, colour), one a column.
    :param rows: list of lists of uint8 (H, W, 3).
    :param scale: whole number of times to enlarge each pixel.
    :return: uint8 (height, width, 3).
    """
    sheet = grid(rows, scale)
    pitch = rows[0][0].shape[1] * scale + GAP
    band = 32 + 16 * max(text.count('\n') + 1 for text, _ in headings)
    figure = Figure(figsize=(sheet.shape[1] / _DPI, band / _DPI), dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    figure.text(1 / sheet.shape[1], 1 - 3 / band, title, va='top', fontsize=10.5, color=INK,
                weight='bold')
    for column, (text, colour) in enumerate(headings):
        figure.text((column * pitch + (pitch - GAP) / 2) / sheet.shape[1], 4 / band, text,
                    ha='center', va='bottom', multialignment='center', fontsize=9.5,
                    linespacing=1.1, color=colour)
    canvas.draw()
    head = np.asarray(canvas.buffer_rgba())[:band, :sheet.shape[1], :3]
    return np.vstack([head, sheet])


def heading(method):
    """Break a method's name into lines that fit above a panel."""
    stem, plus, suffix = method.partition('+')
    stem = stem.replace('-wo-gan', '\nw/o gan').replace('-vae-gan', '\nvae + gan').replace(
        '-vae', '\nvae')
    return stem + (f'\n+ {suffix}' if plus else '')
