# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pictures of predictions in the paper's format (Figs. 5, 6 and 9), headings drawn in.

The episodes are the first held-out ones, whatever they look like. Only runs whose weights are at
hand can be shown.
"""

from pathlib import Path

from experiments.paper.figures import COLOURS, family, file_name, INK
from experiments.paper.names import method_order, variant_of
from experiments.paper.published import TITLES
from experiments.paper.runs import OURS
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
from tap_ros.training.split import split_episodes, TEST_FRACTION
import torch

EPISODES = 3
MATCHED = ('genmin-wo-gan+skips', 'genmin', 'genmin4-wo-gan+skips', 'genmin4')
_DPI = 100


def write_grids(folder, runs, weights, recordings='bags'):
    """
    Write a picture of every task of Table 1 and mode, of networks with new pixels.

    A picture that is there stays where weights of a method that it should show are not at hand.
    Of several seeds the first one at hand is shown.

    :param folder: to write PNG files to.
    :param runs: dicts as results.load_runs returns them, of one scale.
    :param weights: folder with <run>/predictor.safetensors.
    :param recordings: folder with the recordings of each task, where those that a run was trained
        on are no longer.
    """
    runs = [run for run in runs if run['task'] in TITLES and run['new_pixels']
            and variant_of(run['method']) in ('', OURS) and run.get('recursion', 1) == 1]
    for task, mode in sorted({(run['task'], run['mode']) for run in runs}):
        same = sorted((run for run in runs if (run['task'], run['mode']) == (task, mode)),
                      key=lambda run: (method_order(run['method']), run['seed']))
        paths = {}
        for run in same:
            path = Path(weights) / run['name'] / 'predictor.safetensors'
            if path.exists():
                paths.setdefault(run['method'], path)
        target = Path(folder) / file_name(f'{task}-{mode}', same[0]['scale'])
        episodes = paths and _held_out(same, recordings)
        if episodes and (not target.exists() or paths.keys() >= {run['method'] for run in same}):
            headings, rows = _panels(mode, {
                method: load_network(path)[0] for method, path in paths.items()}, *episodes)
            write_atomically(target, png_bytes(draw(f'{TITLES[task]}, {mode}', headings, rows)))


def _held_out(runs, recordings):
    """Return (store, indices of the first held-out episodes, goal picture), or None."""
    run = runs[0]
    own = run['config'].get('recordings', ())
    paths = [path for path in own if Path(path).exists()]
    paths = paths or [Path(recordings) / run['task']]
    if not Path(paths[0]).exists():
        return None
    store = open_recordings(paths)
    _, held_out = split_episodes(store, run['config'].get('test_fraction', TEST_FRACTION))
    # Of other recordings the pictures would not be those that the scores are of.
    if not len(held_out) or store.data_hash not in {run['data']['hash'] for run in runs}:
        return None
    return store, held_out[:EPISODES], run['evaluation'].get('goal_picture', 'last')


@torch.inference_mode()
def _panels(mode, networks, store, episodes, goal_picture):
    """Show inputs, the output of each method, and the match of genmin; return headings, rows."""
    batch = make_batch(store, episodes, Sampling(
        goal_picture=goal_picture, forward=mode == 'forward'))
    context = batch.context.numpy()
    headings = [(text, INK) for text in ('start', 'goal')[:context.shape[1]]]
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
