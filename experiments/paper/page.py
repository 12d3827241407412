# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The results page, in Markdown, from rows and runs.

Sentences that judge depend on the numbers; what a person has to say stands in findings.md.
"""

from experiments.paper.figures import file_name
from experiments.paper.published import BOTTLENECK_2PX, TITLES
from experiments.paper.rows import BEST, find, method_order
from experiments.paper.runs import paper_runs
from experiments.paper.tables import (
    best_table,
    bottleneck_table,
    EQUAL,
    forward_table,
    gains_table,
    lowest_deterministic,
    markdown,
    scores_table,
)
from tap_ros.contract import EPISODE_FRAMES
from tap_ros.evaluation.bottleneck import MIN_MOTION

SETTINGS = ('margin', 'outer_power', 'goal_picture', 'learning_rate', 'gan_weight', 'kl_weight',
            'pretrain_steps')  # may differ between the methods of a scale, see runs.py
GRIDS = {  # what follows <task>-<mode>[-warp] in the name of a picture
    '': 'inputs, each method, and the true frame that matches best',
    '-masks': 'what the output is blended from: warped inputs under their masks, and new pixels',
    '-recursion': 'recursion: with the prediction r = 1 as the goal, r = 2',
    '-samples': 'samples of the VAE, from the same inputs'}

HOW_TO_READ = """\
**min l1** is the error against the frame of the episode that matches best, the per-pixel mean of
the absolute difference on [0, 1]; **match-step** is that frame's number, counted from the start
picture, 0, with its standard deviation over episodes. In brackets are 95% bootstrap intervals over
the held-out episodes. Several seeds are averaged; the intervals do not say how much another
training would differ.

A low min l1 alone proves nothing: who copies the start or the goal picture is near the frame
beside it, and who leaves out the arm and small objects is nearer than who puts them a little
beside their place. So copying stands in every table as a method; **beside an input** says in how
many episodes the match lies within a tenth of the episode from an input; and **of changed pixels**
is the error over those pixels of the same frame alone in which it differs from every input by more
than 0.075: what neither copying nor leaving out gives. The paper's world, pictures and range of l1
(which it does not state) are not ours: only how methods stand to each other can be compared.

In [prediction.json](prediction.json) every number is a row. Metrics of models without new pixels
(`new_pixels` false) end in `_warp_only` where models with new pixels have the same metric, too;
bottlenecks are theirs only. `baseline` names what a gain compares with, `of` the method whose
samples the best of 100 are.
"""


def make_page(rows, runs, left_out, scales, pictures, findings=''):
    """
    Write the page.

    :param rows: of rows.make_rows.
    :param runs: dicts of the runs that the rows are from.
    :param left_out: dicts of finished runs that were scored on other recordings.
    :param scales: in the order wanted.
    :param pictures: file names beside the page.
    :param findings: Markdown that a person wrote.
    :return: Markdown.
    """
    parts = ['# Prediction results\n',
             'Tables and pictures are made by `python -m tap_ros paper --results-only` from the '
             'scores in [runs](runs), never typed; the same numbers as data: '
             '[prediction.json](prediction.json). '
             + ' '.join(_progress(runs, scale) for scale in scales) + '\n']
    if findings.strip():
        parts.append(findings.strip() + '\n')
    parts += ['## How to read the numbers\n', HOW_TO_READ]
    for scale in scales:
        own = [row for row in rows if row['scale'] == scale]
        of_scale = [run for run in runs if run['scale'] == scale]
        if len(scales) > 1:
            parts.append(f'# Scale {scale}\n')
        parts += _setting(of_scale)
        parts += _table_1(own)
        parts += _gains(own, scale, pictures)
        parts += _forward(own, scale, pictures)
        parts += _bottleneck(own, scale, pictures)
        parts += _best(own)
        parts += _grids(scale, scales, pictures)
        parts += _missing(of_scale, scale)
        parts += _commands(of_scale)
    if left_out:
        parts += ['## Left out\n',
                  'Scored on other recordings than the rest of their task, so that their numbers '
                  'do not compare:\n',
                  '\n'.join(f'- `{run["name"]}` ({run["scale"]})' for run in left_out) + '\n']
    return '\n'.join(parts)


def missing_runs(runs, scale):
    """
    List what a complete set of results has and these runs lack, whatever their seeds.

    :param runs: dicts of the runs of one scale.
    :param scale: its name.
    :return: list of runs.PaperRun.
    """
    have = {(run['task'], run['mode'], run['new_pixels'], run['method']) for run in runs}
    return [run for run in paper_runs(scale) if (
        run.task, run.mode, run.new_pixels, run.label) not in have]


def _progress(runs, scale):
    """Say how complete a scale is."""
    missing = missing_runs([run for run in runs if run['scale'] == scale], scale)
    wanted = len(paper_runs(scale))
    return (f'Scale {scale}: {wanted - len(missing)} of the {wanted} trainings that the results '
            'of the paper need.' + (' [What is missing](#missing).' if missing else ''))


def _setting(runs):
    """Say what was run, on what, how long and where."""
    lines = []
    for task in TITLES:
        own = [run for run in runs if run['task'] == task]
        if own:
            data, config = own[0]['data'], own[0]['config']
            lines.append([
                TITLES[task], f'{EPISODE_FRAMES[task]}', f'{data["episodes"]}',
                f'{data["held_out"]}', f'`{data["hash"][:8]}`',
                _range(run['training']['steps'] for run in own),
                f'{config.get("batch_size", "-")}', f'{config.get("base_width", "-")}',
                f'{len(own)}', f'{sum(run["training"]["seconds"] for run in own) / 60:.0f}'])
    machines = sorted({run['training']['machine'] for run in runs})
    collected = sorted({
        command for run in runs for command in run['data']['command'].split('; ')})
    return ['## What was run\n',
            markdown(['task', 'frames', 'trained on', 'held out', 'data', 'steps', 'batch',
                      'base width', 'runs', 'minutes of training'], lines),
            f'Machines: {"; ".join(machines)}.\n', *_differences(runs),
            'The recordings were made by\n', '```bash\n' + '\n'.join(collected) + '\n```\n']


def _differences(runs):
    """Tabulate the settings, beside the method's own, that are not the same in all runs."""
    lines = []
    for setting in SETTINGS:
        methods = {}
        for run in runs:
            methods.setdefault(run['config'].get(setting), set()).add(run['method'])
        if len(methods) > 1:
            values = sorted(methods, key=lambda value: (-len(methods[value]), str(value)))
            lines += [[f'`{setting}`', f'{values[0]}', 'all others'], *(
                ['', f'{value}', ', '.join(sorted(methods[value], key=method_order))]
                for value in values[1:])]
    return ['Not the same in all runs:\n',
            markdown(['setting', 'value', 'methods'], lines, left=3)] if lines else []


def _range(values):
    """Write '3000', or '3000 to 5000'."""
    values = sorted(set(values))
    return f'{values[0]}' if len(values) == 1 else f'{values[0]} to {values[-1]}'


def _table_1(rows):
    parts = ['## Between start and goal (Table 1)\n']
    settings = {(run.task, run.new_pixels) for run in paper_runs(rows[0]['scale'])
                if run.mode == 'bidirectional'}
    settings |= {(row['task'], row['new_pixels']) for row in rows
                 if row['mode'] == 'bidirectional' and 'new_pixels' in row}
    for task, title in TITLES.items():
        for new_pixels in (True, False):
            if (task, new_pixels) in settings:
                parts += [f'### {title}' + ('' if new_pixels else ', models without new pixels')
                          + '\n', scores_table(rows, task, 'bidirectional', new_pixels)]
    return parts


def _plot(name, scale, pictures, text):
    """Show a plot if it is there."""
    name = file_name(name, scale)
    return [f'![{text}]({name})\n'] if name in pictures else []


def _gains(rows, scale, pictures):
    parts = ['## Gains over fix\n']
    tables = [(new_pixels, gains_table(rows, new_pixels)) for new_pixels in (True, False)]
    if not any(table for _, table in tables):
        return [*parts, 'None yet: they need runs of fix and of another method.\n']
    parts += _plot('gains', scale, pictures, 'how far each error is below that of fix, in percent')
    if f'{file_name("gains", scale)}' in pictures:
        parts.append(
            "Dots: beside fix. Squares: beside fixed-time prediction at the same match-step. "
            "Diamonds: the paper's gains of genmin, beside fix.\n")
    parts.append(
        'Paired by episode. A gain counts where both predict equally far from the start: '
        f'*equal* says whether the mean match-steps are within {EQUAL:.0%} of the episode (in the '
        'paper they are up to 11% apart). Equal means can hide opposite ends; the histograms show '
        'that. The last column compares with fixed-time prediction at just the same mean '
        'match-step: with what choosing at random between two of its models would score, where '
        'copying the start and copying the goal are the best models for the times 0 and 1.\n')
    for new_pixels, table in tables:
        if table:
            parts += [*([] if new_pixels else ['Models without new pixels:\n']), table]
    return parts + _plot('match_steps', scale, pictures,
                         'where in the episode the matches of each method lie')


def _forward(rows, scale, pictures):
    parts = ['## From the start alone (Fig. 4)\n',
             *_plot('forward_scatter', scale, pictures, 'error against match-step, ours and the '
                    "authors'"), forward_table(rows)]
    gains = [row for row in rows if row['metric'] == 'gain_over_fix_at_match_step'
             and row['mode'] == 'forward']
    if gains:
        below = sum(row['ci_low'] > 0 for row in gains)
        above = sum(row['ci_high'] < 0 for row in gains)
        parts.append(
            f'Of {len(gains)} methods whose match-step lies between those of the fixed-time '
            f'models of their kind ({", ".join(row["method"] for row in gains)}), {below} have an '
            'error below theirs at the same match-step with the whole interval, '
            f'{above} above, and for {len(gains) - below - above} it could be either. '
            'In between, fixed-time prediction counts as the line in the plot: what choosing at '
            'random between two of its models would score. In the paper every one lies below.\n')
    return parts


def _bottleneck(rows, scale, pictures):
    counted, all_of = (find(rows, task='push2', mode='bidirectional', method='copy-start',
                            metric=metric) for metric in ('bottleneck_frequency_2px', 'min_l1'))
    parts = ['## Bottlenecks (appendix E)\n',
             'Share of predictions, in percent, whose object maps show one object where it '
             'started and the other at its goal (with three objects: one or two at their goals), '
             'to within so many pixels (sum over the objects of the expected distance). Object '
             'positions are ground truth of the simulator, used to score only. Episodes in '
             'which an object moves less than '
             f'{MIN_MOTION:.0f} px do not count, since it is then at its start and its goal at '
             'once' + (f': {counted["n"]} of {all_of["n"]} held-out episodes remain.'
                       if counted and all_of else '.') + '\n',
             'The maps are normalised as in the paper, so that an object that a prediction '
             'leaves out is still somewhere by its map. On the right, and in the last column but '
             'one, predictions count only if the maps of both objects keep at least half of their '
             'mass. The last column says how often the true frame at the time of a '
             'fixed-time method is a bottleneck itself.\n',
             *_plot('bottleneck_curve', scale, pictures,
                    'bottleneck frequency over the threshold'),
             *(f'{TITLES[task]}:\n\n{bottleneck_table(rows, task)}' for task in TITLES
               if task == 'push2' or find(rows, task=task, metric='bottleneck_frequency_2px'))]
    found = [row for row in rows if row['metric'] == 'bottleneck_frequency_2px'
             and row['task'] == 'push2' and row.get('new_pixels') is False]
    if found:
        best = max(found, key=lambda row: row['value'])
        plain, fixed = (find(found, method=method) for method in ('genmin', 'fix'))
        goal = BOTTLENECK_2PX['genmin']
        parts.append(
            f'At 2 px the most comes from {best["method"]}: {_percent(best)}, '
            + ('at least' if best['value'] >= goal else 'less than') + f' the {goal:.0%} of the '
            "paper's genmin." + ('' if plain in (None, best) else
                                 f' Plain genmin: {_percent(plain)}.')
            + ('' if fixed in (None, best) else f' fix: {_percent(fixed)}; in the paper '
               f'{BOTTLENECK_2PX["fix"]:.0%}.') + '\n')
    return parts


def _percent(row):
    return f'{row["value"]:.0%} ({row["ci_low"]:.0%} to {row["ci_high"]:.0%})'


def _best(rows):
    parts = ['## Best of 100 samples\n']
    table = best_table(rows)
    if not table:
        return [*parts, 'None yet: they need runs of genmin-vae-gan.\n']
    parts += ["The paper's genmin + vae has the GAN too: that is genmin-vae-gan here, and "
              '`genmin-vae-best-of-100` takes its samples. The spread is the standard deviation '
              'of a pixel over the samples, on [0, 1], within 6 px of where an object starts or '
              'ends, and elsewhere.\n', table]
    for task, title in TITLES.items():
        best = find(rows, task=task, mode='bidirectional', new_pixels=True, metric='min_l1',
                    method=f'genmin-vae-{BEST}')
        other = lowest_deterministic(rows, task)
        if best and other:
            verdict = ('below' if best['ci_high'] < other['ci_low'] else
                       'above' if best['ci_low'] > other['ci_high'] else 'not clearly apart from')
            parts.append(f'- {title}: {verdict} the lowest method without VAE, '
                         f'{other["method"]}.')
    return [*parts, '']


def _grids(scale, scales, pictures):
    """Show the pictures of predictions that are there."""
    parts = []
    ends = {other: file_name('', other) for other in scales}
    for task in TITLES:
        for name in pictures:
            if not name.startswith(f'{task}-') or not name.endswith(ends[scale]) or any(
                    len(end) > len(ends[scale]) and name.endswith(end) for end in ends.values()):
                continue
            stem = name[len(task) + 1:-len(ends[scale])]
            mode, dash, rest = stem.partition('-')
            variant = ', no new pixels' if f'{dash}{rest}'.startswith('-warp') else ''
            what = GRIDS.get(f'{dash}{rest}'.removeprefix('-warp'))
            if what:
                parts += [f'{TITLES[task]}, {mode}{variant}: {what}.\n',
                          f'![{TITLES[task]}, {mode}{variant}: {what}]({name})\n']
    return parts and [
        '## Pictures\n', 'The first held-out episodes, not chosen by their looks.\n', *parts]


def _missing(runs, scale):
    """List the missing trainings with the commands that make them."""
    missing = missing_runs(runs, scale)
    if not missing:
        return []
    commands = '\n'.join(run.command for run in missing)
    return ['## Missing\n', 'Not trained yet at this scale; each command makes one, and goes on '
            'where it was interrupted:\n', f'```bash\n{commands}\n```\n']


def _commands(runs):
    """List the finished runs, folded away."""
    lines = [[f'`{run["name"]}`', str(run['training']['steps']),
              f'{run["training"]["seconds"]:.0f}', run['training']['machine'],
              run['training'].get('torch', '-')] for run in runs]
    commands = '\n'.join(run['command'] for run in runs)
    return ['<details><summary>All runs and their commands</summary>\n',
            'A command leaves alone what is done: to make a run again, give `--runs` and '
            '`--results` other folders.\n',
            markdown(['run', 'steps', 'seconds', 'machine', 'torch'], lines),
            f'```bash\n{commands}\n```\n', '</details>\n']
