# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From the scores of runs to rows: one number each, with an interval and the runs that it is from.

Intervals are 95% bootstrap intervals over the held-out episodes. Runs that differ by the seed only
are averaged, episode by episode; by_seed tells how far trainings differ.
"""

from dataclasses import dataclass
import re

from experiments.paper.runs import LONG, OURS, PAST_VARIANTS, VARIANTS
import numpy as np
import pandas as pd
from tap_ros.evaluation.bottleneck import THRESHOLDS
from tap_ros.evaluation.intervals import bootstrap
from tap_ros.evaluation.shown import SHOWN

COPIES = ('copy-start', 'copy-goal')
BEST = 'best-of-100'
RESAMPLES = 1000
PLACE, PICK = 0.8, 0.2  # least and most of the object's way behind it, for these two moments
_DIGITS = 6
_NONE = np.empty((1, 0))
COLUMNS = ['task', 'mode', 'method', 'metric', 'value', 'ci_low', 'ci_high', 'n', 'seeds',
           'by_seed', 'scale', 'new_pixels', 'of', 'baseline', 'runs']


@dataclass(frozen=True)
class Group:
    """Runs that differ by the seed only; all scored on the same N episodes."""

    key: dict  # task, mode, method, scale and, where something was trained, new_pixels
    scores: dict  # float arrays (S, N), a row for each run; NaN where undefined
    runs: str  # their names, with blanks between
    of: str = ''  # for the best of 100, the method that was sampled from


def group_runs(runs):
    """Put runs of load_runs together that differ by the seed only; add copying and best of 100."""
    sorted_runs = {}
    for run in sorted(runs, key=lambda run: (run['name'], run['seed'])):
        key = tuple(run[name] for name in ('task', 'mode', 'method', 'scale', 'new_pixels'))
        sorted_runs.setdefault(key, []).append(run)
    groups, copied = [], set()
    for (task, mode, method, scale, new_pixels), same in sorted_runs.items():
        key = {'task': task, 'mode': mode, 'method': method, 'scale': scale}
        trained = {**key, 'new_pixels': new_pixels}
        groups.append(_group(trained, same, 'prediction'))
        if 'best_of_100' in same[0]['evaluation']:
            groups.append(_group({**trained, 'method': best_of_name(method)}, same, 'best_of_100',
                                 of=method))
        for copy in COPIES:
            if copy in same[0]['evaluation'] and (task, mode, scale, copy) not in copied:
                copied.add((task, mode, scale, copy))
                groups.append(_group({**key, 'method': copy}, same[:1], copy))
        for name in same[0]['evaluation'].get('shifted', ()):
            other = name if name.startswith(task) else f'{task}_{name}'
            shifted = [{**run, 'evaluation': run['evaluation']['shifted'][name]} for run in same]
            groups.append(_group({**trained, 'task': other}, shifted, 'prediction'))
            if (other, mode, scale) not in copied:
                copied.add((other, mode, scale))
                groups.append(_group({**key, 'task': other, 'method': 'copy-goal'}, shifted[:1],
                                     'copy-goal'))
    return groups


def _group(key, runs, part, of=''):
    """Stack the scores of runs."""
    parts = [run['evaluation'][part] for run in runs]
    names = [name for name in ('min_l1', 'match_step', 'match_fraction', 'changed_l1',
                               'bottleneck', 'hand', 'objects')
             if all(name in part for part in parts)]
    scores = {name: np.array([part[name] for part in parts], float) for name in names}
    if part == 'prediction' and all('target_bottleneck' in run['evaluation'] for run in runs):
        scores['target_bottleneck'] = np.array(
            [run['evaluation']['target_bottleneck'] for run in runs], float)
    if part == 'prediction' and all('recursion' in run['evaluation'] for run in runs):
        scores['way'] = np.array(  # S, N, levels
            [[level['way'] for level in run['evaluation']['recursion']] for run in runs],
            float).swapaxes(1, 2)
    names = ' '.join(run['name'] for run in runs)
    return Group(key, scores, names, of)


def make_rows(groups):
    """
    Compute every number of the results, a dict of COLUMNS each.

    Bottlenecks are scored without new pixels only, which have no origin to follow (App. E). min_l1
    is the per-pixel mean on [0, 1], match_step counts frames from the start picture (0), all else
    are shares. Of those whose match has the objects PLACE of their way behind them,
    pick_after_place is the share of which the next level's match has them PICK of it behind them.
    """
    rows = [_row(group, metric, lambda array, statistic=statistic: statistic(array, -1).mean(0),
                 values, by_seed=' '.join(f'{x:.6g}' for x in statistic(values, -1)))
            for group in groups for metric, statistic, values in _measures(group)
            if values.size]
    for group in groups:
        baseline = find_baseline(group, groups)
        if baseline is not None and not group.key['method'].startswith('fix'):
            rows.append(_row(group, 'gain_over_fix', relative_gain, group.scores['min_l1'],
                             baseline.scores['min_l1'], baseline=baseline.key['method']))
    return rows + _equal_gain_rows(groups) + _best_rows(groups)


def _measures(group):
    """Yield the name, the statistic over episodes and the values (S, N) of each metric."""
    known = {name: values[:, np.isfinite(values).all(0)] for name, values in group.scores.items()}
    for metric in ('min_l1', 'match_step', 'match_fraction'):
        yield metric, np.mean, known.get(metric, _NONE)
    yield 'match_step_std', np.std, known.get('match_step', _NONE)
    yield 'changed_l1', np.mean, known.get('changed_l1', _NONE)
    if {'hand', 'objects'} <= set(group.scores):
        both = np.minimum(group.scores['hand'], group.scores['objects'])
        yield 'shows_both', np.mean, both[:, np.isfinite(both).all(0)] >= SHOWN
    if 'way' in group.scores:
        first, second = np.moveaxis(group.scores['way'], -1, 0)
        place = first >= PLACE  # not of NaN
        if place.any(1).all():
            yield 'pick_after_place', _mean_of_known, np.where(place, second <= PICK, np.nan)[
                :, place.any(0)]
    if group.key.get('new_pixels'):
        return
    for threshold in THRESHOLDS:
        yield (f'bottleneck_frequency_{threshold}px', np.mean,
               known.get('bottleneck', _NONE) <= threshold)
    yield 'target_bottleneck_frequency_2px', np.mean, known.get('target_bottleneck', _NONE) <= 2


def _mean_of_known(values, axis):
    """Average what is not NaN; NaN without any."""
    known = np.isfinite(values)
    with np.errstate(invalid='ignore'):
        return np.where(known, values, 0).sum(axis) / known.sum(axis)


def _row(group, metric, statistic, *arrays, **more):
    """Make one row."""
    value, low, high = (
        round(x, _DIGITS) for x in bootstrap(statistic, *arrays, resamples=RESAMPLES))
    key = {name: group.key[name] for name in ('task', 'mode', 'method')}
    return {**key, 'metric': metric, 'value': value, 'ci_low': low, 'ci_high': high,
            'n': arrays[0].shape[-1], 'seeds': len(arrays[0]), 'scale': group.key['scale'],
            'runs': group.runs,
            **{name: group.key[name] for name in ('new_pixels',) if name in group.key},
            **({'of': group.of} if group.of else {}), **more}


def relative_gain(error, baseline):
    """Compute by which share the mean error (S, ..., N) is below the baseline's."""
    return 1 - error.mean((0, -1)) / baseline.mean((0, -1))


def find_baseline(group, groups):
    """
    Return the Group of fix in the same setting, or None.

    A method is compared with fix of the same network; without GAN, with fix-wo-gan where that was
    run; a variant with fix of that variant where that was run.
    """
    name = group.key['method']
    wo_gan = '-wo-gan' in name or (re.search(r'-vae(?!-gan)', name) and BEST not in name)
    names = ('fix-wo-gan', 'fix') if wo_gan else ('fix', 'fix-wo-gan')
    for variant in dict.fromkeys((variant_of(name), network_of(name))):
        for method in names:
            for other in groups:
                if other.key == {**group.key, 'new_pixels': group.key.get('new_pixels', True),
                                 'method': method + variant}:
                    return other
    return None


def _best_rows(groups):
    """Compare the best of 100 samples with the lowest method without VAE, at equal steps."""
    rows = []
    for group in groups:
        others = [other for other in groups if '-vae' not in other.key['method']
                  and variant_of(other.key['method']) not in LONG and all(
                      other.key.get(part) == group.key[part]
                      for part in ('task', 'mode', 'scale', 'new_pixels'))] if group.of else []
        if others:
            lowest = min(others, key=lambda other: other.scores['min_l1'].mean())
            rows.append(_row(group, 'gain_over_deterministic', relative_gain,
                             group.scores['min_l1'], lowest.scores['min_l1'],
                             baseline=lowest.key['method']))
    return rows


def _equal_gain_rows(groups):
    """
    Compare methods with fixed-time ones at the same mean match-step (as Fig. 4 does by eye).

    That of fixed-time prediction is the lower hull of the fix models: what choosing at random
    between two of them would score. Between start and goal, copying belongs to them: it is the
    best prediction for the times 0 and 1. A method with a match-step beyond theirs, or whose
    interval reaches beyond, gets no row.
    """
    rows = []
    for group in groups:
        name, mode = group.key['method'], group.key['mode']
        if name in COPIES or name.startswith('fix') or 'match_step' not in group.scores:
            continue
        same = [other for other in groups
                if all(other.key[part] == group.key[part] for part in ('task', 'mode', 'scale'))
                and other.key.get('new_pixels') in (None, group.key['new_pixels'])]
        fixed = [[other for other in same if re.fullmatch(
            r'fix[\d.]*(-wo-gan)?' + re.escape(variant), other.key['method'])]
            for variant in (variant_of(name), network_of(name))]
        copies = [other for other in same if other.key['method'] in COPIES]
        baselines = (fixed[0] or fixed[1]) + (copies if mode == 'bidirectional' else [])
        if not any(fixed) or len(baselines) < 2:
            continue
        step = bootstrap(lambda array: array.mean((0, -1)), group.scores['match_step'],
                         resamples=RESAMPLES)
        ends = [other.scores['match_step'].mean() for other in baselines]
        if not min(ends) <= step.low <= step.high <= max(ends):
            continue
        row = _row(group, 'gain_over_fix_at_match_step', _gain_at_match_step,
                   *(g.scores[score] for g in (group, *baselines)
                     for score in ('match_step', 'min_l1')),
                   baseline=' '.join(other.key['method'] for other in baselines))
        if np.isfinite(row['value']):
            rows.append(row)
    return rows


def _gain_at_match_step(*arrays):
    """Compute the gain from scores (match_step, min_l1) of a method and then of each fix."""
    means = np.array([array.mean((0, -1)) for array in arrays])
    points = list(zip(means[2::2], means[3::2]))
    return 1 - means[1] / lower_hull(means[0], points)


def lower_hull(at, points):
    """Interpolate between those two of (position, value) that give the lowest value; else NaN."""
    lowest = np.full(np.shape(at), np.inf)
    for x, y in points:
        for x2, y2 in points:
            with np.errstate(invalid='ignore', divide='ignore'):
                share = np.where(x == x2, 0.0, (at - x) / (x2 - x))
                between = (x <= at) & (at <= x2)
            lowest = np.where(between, np.fmin(lowest, y + share * (y2 - y)), lowest)
    return np.where(np.isfinite(lowest), lowest, np.nan)


def best_of_name(method):
    """
    Name the best of 100 samples of a method with a VAE.

    The paper's genmin + vae is its Eq. 10, with GAN: genmin-vae-gan here. So its samples are those
    of genmin-vae-best-of-100; those of the CVAE without GAN (Eq. 9), genmin-vae here, are of
    genmin-vae-wo-gan-best-of-100.
    """
    stem, plus, suffix = method.partition('+')
    stem = stem.removesuffix('-gan') if stem.endswith('-vae-gan') else f'{stem}-wo-gan'
    return f'{stem}-{BEST}{plus}{suffix}'


def variant_of(method):
    """Return which variant of runs.py a method's name has; '' for the method as it is."""
    name = re.sub(r'-r\d+$', '', method)
    return max((variant for variant in (*VARIANTS, *PAST_VARIANTS) if name.endswith(variant)),
               key=len)


def network_of(method):
    """Return OURS for a method with our network, '' for the paper's; both are variants."""
    return OURS if variant_of(method).startswith(OURS) else ''


def as_frame(rows):
    """Make a DataFrame of rows; new_pixels is NA for copying."""
    return pd.DataFrame(rows, columns=COLUMNS).astype({'new_pixels': 'boolean'})
