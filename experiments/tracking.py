# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure the tracker on simulated scenes and real films, and write docs/results/tracking.md.

    python -m experiments tracking --real FOLDER

The scenes are others than those on which thresholds and confidence were fitted (seeds 9000 to
9006 and from 1005000). What stands in the data file is kept; remove the file to measure anew.
"""

from dataclasses import dataclass
import json
from pathlib import Path

from experiments.clicks import score_covered, score_pale
from experiments.pages import render, share
from experiments.tables import find, number, RESULTS
from experiments.tracks import draw, score_bag, score_films
import numpy as np
import pandas as pd
from sim_bridge.collect import collect, CollectConfig
from tap_ros.base.engines import Engine
from tap_ros.base.files import write_atomically, write_rows
from tap_ros.base.options import Folder
from tap_ros.images.drawing import png_bytes
from tap_ros.tracking import protocols

SEED = 88_000
TASKS = ('push2', 'push3', 'order2')
EPISODES = {'arm': 40, 'hand': 10}  # by look
SIZE, SMALL = 256, 64
OFF = 1.35  # px of 64 that a person's clicks are off
# Look, size (0: SIZE) and clicks of a column of the page.
COLUMNS = {'UR10e, exact': ('arm', 0, 0.0), 'UR10e, clicks off': ('arm', 0, OFF),
           'UR10e, 64 px': ('arm', SMALL, 0.0), 'hand, exact': ('hand', 0, 0.0)}
# Tasks, and factors of red, green and blue from the middle on, of a column of the second table.
HARD = {'lifted (pick_place)': (('pick_place',), None), 'stacked (stack2)': (('stack2',), None),
        'light to 60%': (TASKS, (0.6, 0.6, 0.6)), 'tint': (TASKS, (1.1, 1.0, 0.8))}
HARD_EPISODES, HARD_SEED = {'pick_place': 80, 'stack2': 60}, 66_000
COVERED_TASKS = 'push2', 'order2'
PALE_SCENES = 30
CLICK_LINES = {
    'refused': 'refused', 'selected_within_2px': 'within 2 px',
    'later_within_2px': 'within 2 px at last', 'wrong_sure': 'wrong at last, seen'}
LINES = {
    'refused': 'refused', 'median_px': 'median error, px', 'within_2px': 'within 2 px',
    'wrong_sure': 'wrong, said to be seen', 'goal_right': 'found in the goal',
    'goal_wrong': 'found there, wrong'}
LABELS = 'tracking_labels.json'
METHODS = ('shipped', 'shipped:tracked')  # of pushing
PUSHED = {'push2': 100, 'order2': 60}  # scenes that were asked for, by task
REACHED_CM = 5.0


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param real: folder of the films that docs/results/tracking_labels.json labels;
        without it those measured before stay.
    :param bags: folder of the recordings; what is there is kept.
    :param out: folder of tracking.json, tracking.png and tracking.md.
    """

    real: Folder = ''
    bags: Folder = 'bags/tracking'
    out: Folder = 'runs/results'


def run(args):
    """Record, measure what is not there yet, and write the page."""
    out = Path(args.out)
    file = out / 'tracking.json'
    rows = json.loads(file.read_text()) if file.exists() else []
    wanted = [(look, task, size, click, None) for look, size, click in COLUMNS.values()
              for task in TASKS]
    wanted += [('arm', task, 0, OFF, light) for tasks, light in HARD.values() for task in tasks]
    for look, task, size, click, light in wanted:
        bag = Path(args.bags, f'{task}_{look}_{SIZE}')
        if any((row['recording'], row['size'], row['click_px'], row.get('light', '')) == (
                bag.name, size, click, _said(light)) for row in rows):
            continue
        _collect(bag, task, look)
        found, tracks = score_bag(bag, size, click, light)
        rows += found
        write_rows(file, rows)
        if (look, task, size, click, light) == ('arm', 'push3', 0, OFF, None):
            write_atomically(out / 'tracking.png', png_bytes(draw(tracks[:2])))
    if not any(row['recording'] == 'lightness alone' for row in rows):
        rows += score_covered([Path(args.bags, f'{task}_arm_{SIZE}') for task in COVERED_TASKS])
        rows += score_pale('push2', 'hand', range(SEED, SEED + PALE_SCENES))
        write_rows(file, rows)
    if args.real:
        rows = [row for row in rows if not row['recording'].endswith('.mp4')]
        rows += score_films(RESULTS / LABELS, args.real)
        write_rows(file, rows)
    write_atomically(out / 'tracking.md', page(rows, loop(RESULTS / 'tracking')))


def _collect(bag, task, look):
    """Record the demonstrations of a bag, see TASKS and HARD, if they are not there."""
    collect(bag, CollectConfig(
        task=task, episodes=EPISODES[look] if task in TASKS else HARD_EPISODES[task],
        seed=SEED if task in TASKS else HARD_SEED, image_size=SIZE, look=look,
        episodes_per_file=5), Engine(workers=1))


def _said(light):
    return '' if light is None else str(list(light))


def page(rows, pushed):
    """Return the page of these rows, and of what loop returns."""
    rows = pd.DataFrame(rows)
    rows['light'] = rows.get('light', pd.Series(index=rows.index, dtype=object)).fillna('')
    real = rows.recording.str.endswith('.mp4')
    films, others = rows[real], rows[~real]
    return render('templates/tracking.md.j2', conditions=conditions(rows), clicks=clicks(rows),
                  films=of_films(films), hard_episodes=HARD_EPISODES,
                  places=f'{int(films[films.metric == "within_2px"].n.sum()):,}',
                  cpu=pooled(others, 'cpu_ms'),
                  longest=pooled(others, 'longest_wrong_sure'), lost=pooled(others, 'lost'),
                  film_cpu=f'{films[films.metric == "cpu_ms"].value.max():.0f}',
                  lines=f'{code_lines():,}', real=len(films) > 0, loop=pushed, seed=SEED, off=OFF,
                  episodes=EPISODES)


def code_lines():
    """Return how many lines the tracker's code has."""
    return sum(len(file.read_text().splitlines()) for file in Path(
        protocols.__file__).parent.glob('*.py'))


def pooled(rows, metric):
    """Return the mean of recordings and of their intervals, weighed by their numbers."""
    rows = rows[rows.metric == metric]
    if not len(rows):
        return '-'
    value, low, high = ((rows[name] * rows.n).sum() / rows.n.sum()
                        for name in ('value', 'ci_low', 'ci_high'))
    if metric == 'longest_wrong_sure':
        return f'{rows.value.max():.0f}'
    if metric in ('median_px', 'selected_px', 'cpu_ms', 'confidence_at_once'):
        return f'{value:.2f}'
    if metric in ('wrong_sure', 'lost', 'goal_wrong'):
        return f'{100 * value:.1f}%'
    return share((value, low, high))


def conditions(rows):
    """Return a table of metrics, a line for each of COLUMNS and HARD."""
    asked = {name: (TASKS, *column, None) for name, column in COLUMNS.items()}
    asked |= {name: (tasks, 'arm', 0, OFF, light) for name, (tasks, light) in HARD.items()}
    lines = []
    for name, (tasks, look, size, click, light) in asked.items():
        mine = rows[rows.recording.isin([f'{task}_{look}_{SIZE}' for task in tasks])
                    & (rows['size'] == size) & (rows.click_px == click)
                    & (rows.light == _said(light))]
        lines.append({'': name} | {line: pooled(mine, metric) for metric, line in LINES.items()})
    return pd.DataFrame(lines)


def clicks(rows):
    """Return a table of single clicks."""
    lines = []
    for name in ('half hidden', 'lightness alone'):
        mine = rows[rows.recording == name]
        lines.append({'': name, 'clicks': f'{mine[mine.metric == "refused"].n.sum():g}'} | {
            line: pooled(mine, metric) for metric, line in CLICK_LINES.items()})
    return pd.DataFrame(lines)


def loop(folder):
    """Compare pushing with tracked and with true objects; return what the page says of it."""
    def said(task, metric, method=METHODS[1], **about):
        return find(folder, 'planning.json', task=task, method=method, metric=metric, **about)

    def scenes_of(task, method):
        name = f'{task}-{method.replace(":", "--")}.json'
        return json.loads(Path(folder, 'planning', name).read_text())['scenes']

    lines, tracked, alone = [], {}, {}
    for task in PUSHED:
        gap = said(task, 'success_5cm_difference', compares='tracking')
        true, mine = (number(said(task, 'success_5cm', method), 100) for method in METHODS)
        left = (f"{said(task, 'final_distance_cm', method)['value']:.1f}" for method in METHODS)
        lines.append({'': task, 'true pixels': true, 'tracked': mine, 'scenes': gap.n,
                      'difference': number(gap, 100, 0, ' points', '+'),
                      'distance left, cm: true, tracked': ', '.join(left)})
        tracked[task] = scenes_of(task, METHODS[1])
        ends = np.array([[max(scene['objects_cm']) <= REACHED_CM for scene in scenes]
                         for scenes in (scenes_of(task, METHODS[0]), tracked[task])])
        alone[task] = tuple((ends & ~ends[::-1]).sum(1))
    scenes = [scene for those in tracked.values() for scene in those]
    placed = [scene for scene in scenes if 'placed' in scene]
    return {
        'table': pd.DataFrame(lines), 'alone': alone, 'scenes': len(scenes), 'placed': len(placed),
        'placed_failed': sum(max(scene['objects_cm']) > REACHED_CM for scene in placed),
        'refused': sum('refused' in scene for scene in scenes),
        'command': f'python -m experiments planning --tasks {" ".join(PUSHED)} --methods '
                   f'{" ".join(METHODS)} --scenes {len(min(tracked.values(), key=len))} '
                   '--no-films --out docs/results/tracking'}


def of_films(rows):
    """Return what the page says of films; within: share and number of each, least first."""
    within, wrong, lost = (rows[rows.metric == metric].set_index('recording').value for metric in (
        'within_2px', 'longest_wrong_sure', 'visible_lost'))
    return {'within': [(f'{100 * value:.0f}%', int(film.partition('/')[0]))
                       for film, value in within.sort_values().items()],
            'wrong': f'{wrong.max():.0f}', 'lost': f'{100 * lost.max():.0f}%'}
