# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the results page shows, from rows and runs; its sentences stand in templates/results.md.j2.

Sentences that judge depend on the numbers; what a person has to say stands in findings.md.
"""

from experiments.pages import render
from experiments.paper.claims import claims_table
from experiments.paper.figures import file_name
from experiments.paper.names import method_order
from experiments.paper.published import ORDER_TITLES, TIMED_TITLES, TITLES
from experiments.paper.recordings import RECORDINGS
from experiments.paper.rows import BESIDE, find, PICK, PLACE
from experiments.paper.runs import paper_runs
from experiments.paper.tables import (
    best_table,
    bottleneck_table,
    EQUAL,
    forward_table,
    gain_of_best,
    gains_table,
    lowest_best,
    lowest_deterministic,
    parts_table,
    recursion_table,
    scores_table,
    shift_table,
    timing_table,
)
import pandas as pd
from sim_bridge.tasks.timing import MORE_FRAMES
from tap_ros.contract import EPISODE_FRAMES
from tap_ros.evaluation.bottleneck import MIN_MOTION
from tap_ros.evaluation.samples import NEAR
from tap_ros.evaluation.shown import SHOWN
from tap_ros.prediction.losses import CHANGED
from tap_ros.prediction.training_config import DEFAULTS

# May differ between the methods of a scale, see runs.py.
SETTINGS = ('decoder', 'skips', 'margin', 'progress_margin', 'match_temperature', 'colour',
            'brightness', 'goal_picture', 'start_crop', 'min_crop', 'initial_weights',
            'gan_weight', 'kl_weight', 'free_nats', 'kl_warmup', 'posterior_std', 'posterior',
            'num_targets', 'changed_weight', 'recursion',
            'detach_recursion', 'pretrain_steps')
GRIDS = {  # what follows <task>-<mode>[-warp] in the name of a picture
    '': 'inputs, each method, and the true frame that matches best',
    '-masks': 'what the output is blended from: warped inputs under their masks, and new pixels',
    '-recursion': 'recursion: with the prediction r = 1 as the goal, r = 2',
    '-samples': 'samples of the VAE, from the same inputs'}
PLOTS = ('gains', 'match_steps', 'forward_scatter', 'bottleneck_curve', 'timing')


def make_page(rows, runs, left_out, scales, pictures, findings=''):
    """
    Write the page.

    :param rows: of rows.as_frame.
    :param runs: dicts of the runs that the rows are from.
    :param left_out: dicts of finished runs that were scored on other episodes.
    :param scales: in the order wanted.
    :param pictures: file names beside the page.
    :param findings: Markdown that a person wrote.
    :return: Markdown.
    """
    parts = [_of_scale(scale, rows[rows['scale'] == scale],
                       [run for run in runs if run['scale'] == scale], pictures, scales)
             for scale in scales]
    return render('paper/templates/results.md.j2', scales=parts, left_out=left_out,
                  findings=findings.strip(), equal=EQUAL, min_motion=MIN_MOTION,
                  changed=CHANGED, near=NEAR, beside=BESIDE,
                  place=PLACE, pick=PICK, shown=SHOWN)


def _of_scale(scale, rows, runs, pictures, scales):
    """Return what the template shows of a scale."""
    plots = {name: file_name(name, scale) for name in PLOTS}
    copied = {metric: find(rows, task='push2', mode='bidirectional', method='copy-start',
                           metric=metric) for metric in ('bottleneck_frequency_2px', 'min_l1')}
    return {
        'name': scale, 'runs': runs, 'wanted': len(paper_runs(scale)),
        'missing': missing_runs(runs, scale),
        'claims': claims_table(rows), 'timing': timing_table(rows), 'shifts': shift_table(rows),
        'recursion': recursion_table(rows), 'parts': parts_table(rows),
        'settings': _settings(runs), 'differences': _differences(runs),
        'machines': sorted({run['training']['machine'] for run in runs}),
        'collected': sorted({
            command for run in runs for command in run['data']['command'].split('; ')}),
        'scores': [(TITLES[task], new_pixels, scores_table(
            rows, task, 'bidirectional', new_pixels)) for task, new_pixels in _table_1_settings(
                rows, scale)],
        'gains': [(new_pixels, gains_table(rows, new_pixels)) for new_pixels in (True, False)],
        'forward': forward_table(rows),
        'forward_gains': rows[(rows['metric'] == 'gain_over_fix_at_match_step')
                              & (rows['mode'] == 'forward')],
        'counted': copied['bottleneck_frequency_2px'], 'all': copied['min_l1'],
        'bottlenecks': [(title, bottleneck_table(rows, task))
                        for task, title in (TITLES | ORDER_TITLES).items()
                        if task == 'push2' or find(
                            rows, task=task, metric='bottleneck_frequency_2px')],
        'best': best_table(rows), 'verdicts': list(_verdicts(rows)),
        'plots': {name: file if file in pictures else '' for name, file in plots.items()},
        'grids': list(_grids(scale, scales, pictures)),
        'all_runs': pd.DataFrame([{
            'run': f'`{run["name"]}`', 'steps': run['training']['steps'],
            'seconds': f'{run["training"]["seconds"]:.0f}', 'machine': run['training']['machine'],
            'torch': run['training'].get('torch')} for run in runs])}


def missing_runs(runs, scale):
    """
    List what a complete set of results has and these runs lack.

    :param runs: dicts of the runs of one scale.
    :param scale: its name.
    :return: list of runs.PaperRun.
    """
    have = {(run['task'], run['mode'], run['new_pixels'], run['method'], run['seed'])
            for run in runs}
    return [run for run in paper_runs(scale) if (
        run.task, run.mode, run.new_pixels, run.label, run.seed) not in have]


def _settings(runs):
    """Tabulate what was run, on what, and how long."""
    lines = []
    timed = {task: f'{TITLES["push2"]}, {when}' for task, when in TIMED_TITLES.items()}
    frames = EPISODE_FRAMES | {
        name: EPISODE_FRAMES[recording.task] + MORE_FRAMES
        for name, recording in RECORDINGS.items() if 'timing' in recording.options}
    for task, title in (TITLES | timed | ORDER_TITLES).items():
        own = [run for run in runs if run['task'] == task]
        if own:
            data, config = own[0]['data'], own[0]['config']
            hashes = dict.fromkeys(run['data']['hash'][:8] for run in own)
            steps = sorted({run['training']['steps'] for run in own})
            lines.append({
                'task': title, 'frames': frames[task], 'trained on': data['episodes'],
                'held out': data['held_out'], 'data': ' '.join(f'`{name}`' for name in hashes),
                'steps': ' to '.join(map(str, dict.fromkeys((steps[0], steps[-1])))),
                'batch': config.get('batch_size'), 'base width': config.get('base_width'),
                'runs': len(own), 'minutes of training':
                    f'{sum(run["training"]["seconds"] for run in own) / 60:.0f}'})
    return pd.DataFrame(lines, dtype=object)


def _differences(runs):
    """Tabulate the settings, beside the method's own, that are not the same in all runs."""
    lines, every = [], {}  # task -> its methods
    for run in runs:
        every.setdefault(run['task'], set()).add(run['method'])
    for setting in SETTINGS:
        values = {}  # value -> method -> tasks
        for run in runs:
            value = run['config'].get(setting, DEFAULTS.get(setting))
            values.setdefault(value, {}).setdefault(run['method'], set()).add(run['task'])
        if len(values) > 1:
            usual, *others = sorted(values, key=lambda value: (
                -sum(map(len, values[value].values())), str(value)))
            lines += [(f'`{setting}`', str(usual) or 'none', 'all others'), *(
                ('', str(value) or 'none', '; '.join(_of_methods(values[value], every)))
                for value in others)]
    return pd.DataFrame(lines, columns=['setting', 'value', 'of'])


def _of_methods(tasks, every):
    """
    Name methods, those of the same tasks together.

    :param tasks: dict of the set of tasks of each method.
    :param every: dict of the set of all methods of each task.
    """
    whole = [task for task, methods in every.items()
             if methods == {method for method in tasks if task in tasks[method]}]
    together = {}
    for method in sorted(tasks, key=method_order):
        together.setdefault(tuple(sorted(tasks[method] - set(whole))), []).append(method)
    return [f'all of {task}' for task in sorted(whole)] + [
        f'{", ".join(names)}: {", ".join(methods)}'
        for names, methods in together.items() if names]


def _table_1_settings(rows, scale):
    """List the (task, new_pixels) that have a table, also those not run."""
    trained = rows[(rows['mode'] == 'bidirectional') & rows['new_pixels'].notna()]
    settings = {*zip(trained['task'], trained['new_pixels']), *(
        (run.task, run.new_pixels) for run in paper_runs(scale) if run.mode == 'bidirectional')}
    return [(task, new_pixels) for task in TITLES for new_pixels in (True, False)
            if (task, new_pixels) in settings]


def _verdicts(rows):
    """Say of each task how the best of 100 stands to the lowest without VAE, and of which."""
    for task, title in TITLES.items():
        best, other = lowest_best(rows, task), lowest_deterministic(rows, task)
        if best and other:
            gain = gain_of_best(rows, best)
            yield title, best['method'], (
                'below' if gain['ci_low'] > 0 else 'above' if gain['ci_high'] < 0 else
                'not significantly different from'), other['method']


def _grids(scale, scales, pictures):
    """Yield what each picture of predictions shows, and its file name."""
    ends = {other: file_name('', other) for other in scales}
    for task, title in TITLES.items():
        for name in pictures:
            if not name.startswith(f'{task}-') or not name.endswith(ends[scale]) or any(
                    len(end) > len(ends[scale]) and name.endswith(end) for end in ends.values()):
                continue
            mode, dash, rest = name[len(task) + 1:-len(ends[scale])].partition('-')
            variant = ', no new pixels' if f'{dash}{rest}'.startswith('-warp') else ''
            what = GRIDS.get(f'{dash}{rest}'.removeprefix('-warp'))
            if what:
                yield f'{title}, {mode}{variant}: {what}', name
