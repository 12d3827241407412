# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pictures of predictions in the paper's format (Figs. 5 to 7 and 10), headings drawn in.

The episodes are the first held-out ones, whatever they look like. Only runs whose weights are at
hand can be shown.
"""

from dataclasses import dataclass
from pathlib import Path
import re

from experiments.paper.figures import COLOURS, family, file_name
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
SAMPLES = 6
_DPI = 100
_INK = '#333333'


@dataclass(frozen=True)
class Shown:
    """
    A trained network to show predictions of.

    :param method: its name.
    :param network: Predictor in eval mode.
    """

    method: str
    network: torch.nn.Module


def write_grids(folder, runs, weights, recordings='bags'):
    """
    Write the grids of every task of Table 1 and mode of one scale, of networks with new pixels.

    A picture that is there stays where weights of a method that it should show are not at hand.
    Of several seeds the first one at hand is shown.

    :param folder: to write PNG files to.
    :param runs: dicts as results.load_runs returns them, of one scale.
    :param weights: folder with <run>/predictor.safetensors.
    :param recordings: folder with the recordings of each task, where those that a run was trained
        on are no longer.
    """
    runs = [run for run in runs if run['task'] in TITLES and run['new_pixels']]
    for task, mode in sorted({(run['task'], run['mode']) for run in runs}):
        same = sorted((run for run in runs if (run['task'], run['mode']) == (task, mode)),
                      key=lambda run: (method_order(run['method']), run['seed']))
        paths = {}
        for run in same:
            path = Path(weights) / run['name'] / 'predictor.safetensors'
            if path.exists():
                paths.setdefault(run['method'], path)
        episodes = paths and _held_out(same, recordings)
        if not paths or episodes is None:
            continue
        title = f'{TITLES[task]}, {mode}'
        for name, (choose, make) in GRIDS.items():
            path = Path(folder) / file_name(f'{task}-{mode}{name}', same[0]['scale'])
            chosen = choose(same)
            if not paths.keys() >= set(chosen):
                chosen = [] if path.exists() else choose(
                    [run for run in same if run['method'] in paths])
            sheet = chosen and make(
                mode, [Shown(method, load_network(paths[method])[0]) for method in chosen],
                *episodes)
            if sheet:
                write_atomically(path, png_bytes(draw(title, *sheet)))


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


def draw(title, headings, rows, scale=2):
    """
    Draw a sheet of panels with a title and headings above the columns.

    :param title: one line of text.
    :param headings: list of levels, the upper one first; each a list of (text, colour or None, how
        many columns it is above).
    :param rows: list of lists of uint8 (H, W, 3).
    :param scale: whole number of times to enlarge each pixel.
    :return: uint8 (height, width, 3).
    """
    sheet = grid(rows, scale)
    pitch = rows[0][0].shape[1] * scale + GAP
    depths = [max(text.count('\n') + 1 for text, *_ in level) for level in headings]
    band = 32 + 16 * sum(depths)
    figure = Figure(figsize=(sheet.shape[1] / _DPI, band / _DPI), dpi=_DPI)
    canvas = FigureCanvasAgg(figure)

    def write(x, y, text, **options):
        figure.text(x / sheet.shape[1], 1 - y / band, text, linespacing=1.1,
                    **{'fontsize': 9.5, 'color': _INK, **options})
    write(1, 3, title, va='top', fontsize=10.5, weight='bold')
    for n, level in enumerate(headings):
        column = 0
        for text, colour, span in level:
            write(column * pitch + (span * pitch - GAP) / 2, 28 + 16 * sum(depths[:n + 1]), text,
                  color=colour or _INK, ha='center', va='bottom', multialignment='center')
            column += span
    canvas.draw()
    head = np.asarray(canvas.buffer_rgba())[:band, :sheet.shape[1], :3]
    return np.vstack([head, sheet])


def heading(method):
    """
    Break a method's name into lines that fit above a panel.

    :return: text with line breaks.
    """
    stem, plus, suffix = method.partition('+')
    stem = re.sub(r'-r(\d+)$', r'\n(trained r = \1)', stem)
    stem = stem.replace('-wo-gan', '\nw/o gan').replace('-vae-gan', '\nvae + gan').replace(
        '-vae', '\nvae')
    return stem + (f'\n+ {suffix}' if plus else '')


def _coloured(method, text=None, span=1):
    return heading(method) if text is None else text, COLOURS[family(method)], span


def _inputs(batch):
    """Return the headings and, for each episode, the panels of the context pictures."""
    context = batch.context.numpy()
    return ([(text, None, 1) for text in ('start', 'goal')[:context.shape[1]]],
            [list(pictures) for pictures in context])


def _gather(store, episodes, mode, goal_picture):
    batch = make_batch(store, episodes, Sampling(
        goal_picture=goal_picture, forward=mode == 'forward'))
    return batch, to_float(batch.context)


def _predict(one, episodes, context, sample=0):
    """Predict; with z, from that sample which the scores count as the first, or a later one."""
    size = one.network.config.latent_size
    return one.network(context, draw_latents(episodes, sample + 1, size)[:, sample] if size
                       else None)


def _append(rows, images):
    for row, image in zip(rows, images):
        row.append(image)


@torch.inference_mode()
def _methods(mode, shown, store, episodes, goal_picture):
    """Show inputs, the output of each method, and matches of genmin and ours (Figs. 5, 6)."""
    batch, context = _gather(store, episodes, mode, goal_picture)
    headings, rows = _inputs(batch)
    chosen = _contrast([one.method for one in shown])
    matched = next((method for method in chosen if family(method) == 'genmin'), None)
    ours = next((method for method in chosen if family(method) == 'ours'), None)
    matches = []
    for one in shown:
        image = _predict(one, episodes, context).image
        _append(rows, to_uint8(image))
        headings.append(_coloured(one.method))
        if one.method in (matched, ours):
            errors = l1_errors(image[:, None], batch.targets.movedim(-1, 2))[:, 0]
            match = match_step(errors, batch.valid)
            matches.append((one, batch.targets.numpy()[np.arange(len(match)), match]))
    for one, frames in matches:
        _append(rows, frames)
        headings.append((f'match of\n{heading(one.method)}', _INK, 1))
    return [headings], rows


def _main_methods(methods):
    """Leave out variants and what was trained for recursion, which are too many to see."""
    return [method for method in methods
            if variant_of(method) in ('', OURS) and not re.search(r'-r\d+$', method)]


def _preferred(methods, names):
    """Return the first of the names that is among the methods, else None."""
    return next((name for name in names if name in methods), None)


def _contrast(methods):
    """Choose fix, genmin and a form of ours that finds bottlenecks, those that there are."""
    ends = ('-wo-gan+skips', '+skips', '-wo-gan', '')
    found = [_preferred(methods, [f'{stem}{end}' for end in ends for stem in stems])
             for stems in (('fix', 'fix0.50'), ('genmin', 'genmin4'))]
    found.append(_preferred(methods, ('genmin-wo-gan+progress+skips', 'genmin-wo-gan+progress')))
    return [method for method in found if method is not None]


def _recursive(methods):
    """Choose those that were trained for recursion; without any, those of _contrast."""
    return [method for method in methods
            if re.search(r'-r\d+$|\+pieces$', method)] or _contrast(methods)


def _sampling(runs):
    """Choose the method with z whose best of 100 samples has the lowest error."""
    def error(run):
        return np.mean(run['evaluation'].get('best_of_100', {}).get('min_l1', np.inf))

    drawn = [run for run in runs if '-vae' in run['method']]
    return [min(drawn, key=error)['method']] if drawn else []


def _by_name(choose):
    """Make what chooses among names of methods choose among runs."""
    return lambda runs: choose(list(dict.fromkeys(run['method'] for run in runs)))


@torch.inference_mode()
def _recursion(mode, shown, store, episodes, goal_picture):
    """Show predictions with the prediction before as the goal (Fig. 7)."""
    if mode != 'bidirectional':
        return None
    batch, context = _gather(store, episodes, mode, goal_picture)
    headings, rows = _inputs(batch)
    above = [('', None, len(headings))]
    for one in shown:
        first = _predict(one, episodes, context).image
        following = torch.stack([context[:, 0], first.clamp(-1, 1)], 1)
        second = _predict(one, episodes, following).image
        for r, image in ((1, first), (2, second)):  # the higher the level, the earlier the time
            _append(rows, to_uint8(image))
            headings.append(_coloured(one.method, f'r = {r}'))
        above.append(_coloured(one.method, heading(one.method), 2))
    return [above, headings], rows


@torch.inference_mode()
def _samples(mode, shown, store, episodes, goal_picture):
    """Show samples of the VAE for one start and goal (Figs. 9, 16)."""
    chosen, = shown
    batch, context = _gather(store, episodes, mode, goal_picture)
    headings, rows = _inputs(batch)
    for n in range(SAMPLES):
        _append(rows, to_uint8(_predict(chosen, episodes, context, n).image))
        headings.append((f'sample {n + 1}', None, 1))
    above = [('', None, len(headings) - SAMPLES), _coloured(chosen.method, chosen.method, SAMPLES)]
    return [above, headings], rows


GRIDS = {  # end of the file name -> (which methods of which runs, how they are shown)
    '': (_by_name(_main_methods), _methods),
    '-recursion': (_by_name(_recursive), _recursion), '-samples': (_sampling, _samples)}
