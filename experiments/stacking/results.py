# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Numbers from result files: shares and means with intervals, and paired differences."""

import pandas as pd
from tap_ros.evaluation.intervals import mean_interval, share_interval

SHARES = ('success', 'first_right')
MEANS = ('moves', 'final_cm', 'steps', 'seconds')
COMPARED_WITH = ('direct', 'lowest_first', 'fix')
SAME = ('look', 'device')  # where these agree, results are compared
ABOUT = ('look', 'device', 'object_places', 'predictor_weights', 'command', 'date', 'machine',
         'version')


def make_rows(results):
    """
    Turn results into the rows of stacking.json.

    Intervals are of 95%: Wilson's of shares, by bootstrap over scenes of means and differences. A
    difference is this method minus another, over the scenes that both were run on.

    :param results: of planning.results.load_results.
    :return: list of dicts.
    """
    rows = []
    tables = {key: _table(scenes) for key, (_, scenes) in results.items()}
    for (task, name), (settings, scenes) in results.items():
        mine = tables[task, name]
        measured = [(metric, share_interval(mine[metric]), len(mine), {}) for metric in SHARES]
        measured += [(metric, mean_interval(mine[metric]), len(mine), {}) for metric in MEANS]
        for other in COMPARED_WITH:
            if other == name or (task, other) not in results or any(
                    settings[key] != results[task, other][0][key] for key in SAME):
                continue
            gaps = (mine['success'] - tables[task, other]['success']).dropna()  # of both
            if len(gaps):
                measured.append(('success_difference', mean_interval(gaps), len(gaps),
                                 {'against': other}))
        for metric, (value, low, high), count, more in measured:
            rows.append({
                'task': task, 'method': name, 'metric': metric, 'value': round(value, 4),
                'ci_low': round(low, 4), 'ci_high': round(high, 4), 'n': count,
                'first_scene': min(scenes), **more,
                **{key: settings.get(key) for key in ABOUT}})
    return rows


def _table(scenes):
    """Return a line of numbers for each scene, by seed."""
    table = pd.DataFrame.from_dict(scenes, 'index').sort_index()
    return table[[*SHARES, *MEANS]].astype(float)
