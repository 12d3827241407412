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
import pandas as pd
from sim_bridge.collect import collect, CollectConfig
from tap_ros.base.engines import Engine
from tap_ros.base.files import write_atomically, write_rows
from tap_ros.base.options import Folder
from tap_ros.images.drawing import png_bytes

SEED = 88_000
TASKS = ('push2', 'push3', 'order2')
EPISODES = {'arm': 10, 'hand': 4}  # by look
SIZE, SMALL = 256, 64
OFF = 1.35  # px of 64 that a person's clicks are off
# Look, size (0: SIZE) and clicks of a column of the page.
COLUMNS = {'UR10e, exact': ('arm', 0, 0.0), 'UR10e, clicks off': ('arm', 0, OFF),
           'UR10e, 64 px': ('arm', SMALL, 0.0), 'hand, exact': ('hand', 0, 0.0)}
# Task, and factors of red, green and blue from the middle on, of a column of the second table.
HARD = {'lifted (pick_place)': ('pick_place', None), 'stacked (stack2)': ('stack2', None),
        'light to 60%': ('push2', (0.6, 0.6, 0.6)), 'tint': ('push2', (1.1, 1.0, 0.8))}
HARD_EPISODES = 8
HARD_LINES = ('median_px', 'within_2px', 'wrong_sure', 'longest_wrong_sure', 'lost', 'goal_right',
              'goal_wrong')
COVERED_TASKS = 'push2', 'order2'
PALE_SCENES = 30
CLICK_LINES = {
    'refused': 'clicks refused', 'selected_px': 'click to the middle of the object, px',
    'selected_within_2px': 'within 2 px at once', 'later_within_2px': 'within 2 px at last',
    'wrong_sure': 'wrong by 3 px at last, and said to be seen',
    'confidence_at_once': 'confidence at once'}
LINES = {
    'median_px': 'median error, px', 'within_2px': 'right: within 2 px',
    'wrong_sure': 'wrong by 3 px and said to be seen',
    'longest_wrong_sure': 'the same, most pictures in a row', 'lost': 'objects lost at the end',
    'recovered': 'right within three pictures after an occlusion',
    'selected_px': 'click to the middle of the object, px', 'refused': 'clicks refused',
    'cpu_ms': 'CPU a picture of two objects, ms', 'goal_right': 'found in goal pictures, right',
    'goal_visible_right': 'found where its middle is in sight', 'goal_wrong': 'found, and wrong',
    'goal_refused': 'said to be not found'}
LABELS = 'tracking_labels.json'
METHODS = ('shipped', 'shipped:tracked')  # of pushing
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
    wanted += [('arm', task, 0, OFF, light) for task, light in HARD.values()]
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
        task=task, episodes=EPISODES[look] if task in TASKS else HARD_EPISODES, seed=SEED,
        image_size=SIZE, look=look, episodes_per_file=5), Engine(workers=1))


def _said(light):
    return '' if light is None else str(list(light))


def page(rows, pushed):
    """Return the page of these rows, and of what loop returns."""
    rows = pd.DataFrame(rows)
    rows['light'] = rows.get('light', pd.Series(index=rows.index, dtype=object)).fillna('')
    films = rows[rows.recording.str.endswith('.mp4')]
    return render('templates/tracking.md.j2', columns=table(rows), films=film_table(films),
                  hard=hard(rows), clicks=clicks(rows), hard_episodes=HARD_EPISODES,
                  places=f'{int(films[films.metric == "within_2px"].n.sum()):,}',
                  confidence=confidence(rows.drop(films.index)), real=len(films) > 0,
                  loop=pushed, seed=SEED, off=OFF, episodes=EPISODES,
                  longest=round(rows[(rows.metric == 'longest_wrong_sure')
                                     & (rows.click_px == OFF)].value.max()))


def pooled(rows, metric):
    """Return the mean of recordings, weighed by their numbers, with the widest of their ends."""
    rows = rows[rows.metric == metric]
    if not len(rows):
        return '-'
    value, low, high = ((rows[name] * rows.n).sum() / rows.n.sum()
                        for name in ('value', 'ci_low', 'ci_high'))
    if metric == 'longest_wrong_sure':
        return f'{rows.value.max():.0f}'
    if metric in ('median_px', 'selected_px', 'cpu_ms', 'confidence_at_once'):
        return f'{value:.2f} ({low:.2f} to {high:.2f})'
    return share((value, low, high))


def of(rows, column):
    """Return the rows of a column."""
    look, size, click = COLUMNS[column]
    return rows[rows.recording.isin([f'{task}_{look}_{SIZE}' for task in TASKS])
                & (rows['size'] == size) & (rows.click_px == click) & (rows.light == '')]


def table(rows):
    """Return a table of metrics by column; times are of two objects."""
    two = rows[(rows.metric != 'cpu_ms') | ~rows.recording.str.startswith('push3')]
    return pd.DataFrame([{'': line} | {name: pooled(of(two, name), metric) for name in COLUMNS}
                         for metric, line in LINES.items()])


def hard(rows):
    """Return a table of metrics by column of HARD."""
    columns = {name: rows[(rows.recording == f'{task}_arm_{SIZE}') & (rows.light == _said(light))
                          & (rows.click_px == OFF)] for name, (task, light) in HARD.items()}
    return pd.DataFrame([{'': LINES[metric]} | {
        name: pooled(mine, metric) for name, mine in columns.items()} for metric in HARD_LINES])


def clicks(rows):
    """Return a table of single clicks."""
    names = 'half hidden', 'lightness alone'
    lines = [{'': line} | {name: pooled(rows[rows.recording == name], metric) for name in names}
             for metric, line in CLICK_LINES.items()]
    count = {name: f'{rows[(rows.recording == name) & (rows.metric == "refused")].n.sum():g}'
             for name in names}
    return pd.DataFrame([*lines, {'': 'clicks'} | count])


def confidence(rows):
    """Return a table of what is right by confidence."""
    rows = rows[rows.metric == 'confidence']
    lines = []
    for low, mine in rows.groupby('step'):
        right = (mine.value * mine.n).sum() / mine.n.sum()
        lines.append({'confidence from': f'{low:g}', 'right': f'{100 * right:.1f}%',
                      'pictures': f'{mine.n.sum():,}'})
    return pd.DataFrame(lines)


def loop(folder):
    """Compare pushing with tracked and with true objects; return what the page says of it."""
    scenes = [{scene['seed']: scene for scene in json.loads(
        Path(folder, 'planning', f'push2-{name.replace(":", "--")}.json').read_text())['scenes']}
        for name in METHODS]
    true, tracked = ([max(mine[seed]['objects_cm']) <= REACHED_CM for seed in scenes[0]]
                     for mine in scenes)
    placed = ['placed' in scenes[1][seed] for seed in scenes[0]]

    def said(metric, method, **about):
        row = find(folder, 'planning.json', task='push2', method=method, metric=metric, **about)
        if metric.startswith('final'):
            return number(row, 1, 1, ' cm', '+' if about else '')
        return number(row, 100, 0, ' points' if about else '%', '+' if about else '')

    lines = [{'': title, 'true pixels': said(metric, METHODS[0]),
              'tracked': said(metric, METHODS[1]), 'difference': said(
                  f'{difference}_difference{unit}', METHODS[1], compares='tracking')}
             for title, metric, difference, unit in (
                 ('success: all within 5 cm', 'success_5cm', 'success_5cm', ''),
                 ('final distance', 'final_distance_cm', 'final_distance', '_cm'))]
    beside = [pair for pair, clicked in zip(zip(true, tracked), placed) if not clicked]
    return {
        'table': pd.DataFrame(lines), 'scenes': len(true), 'points': lines[0]['difference'],
        'placed': sum(placed), 'placed_failed': sum(
            clicked and not ok for clicked, ok in zip(placed, tracked)),
        'blocked': sum(scene['blocked'] > 0 for mine in scenes for scene in mine.values()),
        'repeated': sum(scene['blocked'] > 2 for mine in scenes for scene in mine.values()),
        'only_tracked': beside.count((True, False)), 'only_true': beside.count((False, True)),
        'command': 'python -m experiments planning --tasks push2 --methods '
                   f'{" ".join(METHODS)} --scenes {len(true)} --no-films '
                   '--out docs/results/tracking'}


def film_table(rows):
    """Return a table of films."""
    some = ('median_px', 'within_2px', 'wrong_sure', 'longest_wrong_sure', 'visible_lost',
            'cpu_ms')
    return pd.DataFrame([{'film': film} | {metric.replace('_', ' '): round(float(
        mine[mine.metric == metric].value.iloc[0]), 2) for metric in some}
        for film, mine in rows.groupby('recording')])
