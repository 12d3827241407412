# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Results from finished runs: the numbers as data, the page, its plots and pictures."""

from collections import Counter
import json
from pathlib import Path

from experiments.paper import figures
from experiments.paper.names import COPIES
from experiments.paper.page import make_page
from experiments.paper.pictures import write_grids
from experiments.paper.rows import as_frame, group_runs, make_rows
from experiments.paper.runs import label
from tap_ros.errors import ConfigError
from tap_ros.files import write_atomically, write_rows

SCALES = ('full', 'small')  # the order on the page
_KEYS = {'name', 'task', 'mode', 'method', 'new_pixels', 'seed', 'scale', 'command', 'config',
         'data', 'training', 'evaluation'}


def load_runs(folder):
    """
    Read what the finished runs left; methods are named as runs.label has it.

    :param folder: with a subfolder for each scale, and in it a JSON file for each run.
    :return: list of dicts, by scale and name.
    :raises ConfigError: if a file is damaged or lacks something; the message names it.
    """
    runs = []
    for path in sorted(Path(folder).glob('*/*.json')):
        try:
            run = json.loads(path.read_text())
        except ValueError as error:
            raise ConfigError(
                f'{path}: is damaged ({error}); remove it and run it again') from None
        missing = _KEYS - set(run)
        if missing:
            raise ConfigError(f'{path}: lacks {", ".join(sorted(missing))}; remove it and run it '
                              'again')
        run['method'] = label(run['method'], run.get('variant', ''), run.get('recursion', 1))
        runs.append(run)
    return runs


def on_same_episodes(runs):
    """
    Leave out runs that were scored on other episodes than most of their task, mode and scale.

    Numbers of different held-out episodes must not stand in one table. What copying an
    input costs in each tells them apart; the hash of a recording also depends on the last digits
    of joint positions, in which machines differ.

    :param runs: of load_runs.
    :return: (runs to compare, runs left out).
    """
    def of(run):
        return run['scale'], run['task'], run['mode']

    def data(run):
        scores = run['evaluation']
        return (*(tuple(scores[copy]['min_l1']) for copy in COPIES if copy in scores),
                *(tuple(other['copy-goal']['min_l1'])
                  for _, other in sorted(scores.get('shifted', {}).items())))
    counts = {}
    for run in runs:
        counts.setdefault(of(run), Counter())[data(run)] += 1
    kept = [run for run in runs if counts[of(run)].most_common(1)[0][0] == data(run)]
    return kept, [run for run in runs if run not in kept]


def write_results(folder='docs/results', runs='runs/paper', recordings='bags', pictures=True):
    """
    Write prediction.json, the page README.md, its plots, and pictures where weights are at hand.

    :param folder: to write to; the runs' numbers are in its subfolder runs/<scale>, and
        findings.md, if there, is put into the page.
    :param runs: folder with runs' weights: <scale>/<name>/predictor.safetensors.
    :param recordings: folder with the recordings, one for each task.
    :param pictures: whether to make the pictures of predictions again.
    :return: rows of prediction.json.
    :raises ConfigError: if there are no finished runs, or one cannot be read.
    """
    folder = Path(folder)
    loaded = load_runs(folder / 'runs')
    if not loaded:
        raise ConfigError(f'{folder / "runs"}: there are no finished runs; make some with '
                          'python -m tap_ros paper')
    kept, left_out = on_same_episodes(loaded)
    groups = group_runs(kept)
    rows = make_rows(groups)
    write_rows(folder / 'prediction.json', told_apart(rows))
    frame = as_frame(rows)
    scales = [scale for scale in SCALES if any(run['scale'] == scale for run in kept)]
    for scale in scales:
        _write_plots(folder, scale, frame, groups)
        if pictures:
            write_grids(folder, [run for run in kept if run['scale'] == scale],
                        Path(runs) / scale, recordings)
    findings = folder / 'findings.md'
    page = make_page(frame, kept, left_out, scales, sorted(p.name for p in folder.glob('*.png')),
                     findings.read_text() if findings.exists() else '')
    write_atomically(folder / 'README.md', page)
    return rows


def told_apart(rows):
    """
    Name metrics so that task, mode, method, metric and scale belong to one row.

    The metrics of models without new pixels end in _warp_only where the task has models with new
    pixels, too; but for bottlenecks, which only the former have.

    :param rows: of make_rows.
    :return: list of dicts.
    """
    def place(row):
        return row['task'], row['mode'], row['scale']

    both = {place(row) for row in rows if row.get('new_pixels')}
    return [{**row, 'metric': f'{row["metric"]}_warp_only'}
            if row.get('new_pixels') is False and 'bottleneck' not in row['metric']
            and place(row) in both else row for row in rows]


def _write_plots(folder, scale, rows, groups):
    """Draw the plots of a scale; remove those that have nothing to show any more."""
    rows = rows[rows['scale'] == scale]
    groups = [group for group in groups if group.key['scale'] == scale]
    plots = {
        'forward_scatter': figures.forward_scatter(rows),
        'bottleneck_curve': figures.bottleneck_curve(rows),
        'gains': figures.gains(rows),
        'timing': figures.timing(rows),
        'match_steps': figures.match_histograms(groups)}
    for name, png in plots.items():
        path = folder / figures.file_name(name, scale)
        if png is not None:
            write_atomically(path, png)
        else:
            path.unlink(missing_ok=True)
