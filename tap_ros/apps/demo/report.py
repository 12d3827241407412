# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the demo says of its scenes: a table of each task, and a self-contained HTML page."""

import base64
from collections.abc import Iterator, Mapping, Sequence
import io
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment
import numpy as np
from PIL import Image
from tap_ros.apps.demo.film import Scene
from tap_ros.base.files import write_atomically
from tap_ros.evaluation.intervals import Interval, mean_interval
from tap_ros.training.split import FEW

MODES = {'direct': 'direct', 'subgoal': 'via the subgoal'}


class Row(NamedTuple):
    """Some scenes together; intervals of 95% are a paired bootstrap over scenes."""

    label: str
    scenes: int
    cm: tuple[float, float]  # final distance, direct and via the subgoal
    nearer: Interval  # cm, by the subgoal
    reached: tuple[int, int]  # scenes in which every object ended near its goal
    more: Interval  # of them in points, by the subgoal

    def texts(self) -> list[str]:
        """Return the cells of a table."""
        share = [f'{100 * n / self.scenes:.0f}%' for n in self.reached]
        nearer, more = '{:+.1f} ({:+.1f} to {:+.1f})', '{:+.0f} ({:+.0f} to {:+.0f})'
        if self.scenes < FEW:  # their interval says nothing
            nearer, more = '{:+.1f}', '{:+.0f}'
        return [self.label, str(self.scenes), *(f'{cm:.1f}' for cm in self.cm),
                nearer.format(*self.nearer), *share, more.format(*self.more)]


CLEARLY = 0.1  # m from its goal, directly: no near miss
COLUMNS = ('task', 'scenes', 'cm left, direct', 'via subgoal', 'nearer by', 'succeed, direct',
           'via subgoal', 'more, points')


def summary(scenes: Sequence[Scene]) -> list[Row]:
    """Return a Row of each task, those of a task being together, and of all if there are many."""
    groups = [(task, list(group)) for task, group in groupby(scenes, lambda scene: scene.task)]
    if len(groups) > 1:
        groups.append(('together', list(scenes)))
    return [_row(label, group) for label, group in groups]


def _row(label: str, scenes: Sequence[Scene]) -> Row:
    runs = [[scene.runs[mode] for mode in MODES] for scene in scenes]
    cm = np.array([[run.final_cm for run in pair] for pair in runs])
    reached = np.array([[run.reached for run in pair] for pair in runs])
    return Row(label, len(scenes), tuple(cm.mean(0).tolist()), mean_interval(cm[:, 0] - cm[:, 1]),
               tuple(reached.sum(0).tolist()),
               mean_interval(100.0 * (reached[:, 1].astype(int) - reached[:, 0])))


def in_words(row: Row) -> str:
    """Say what came of some scenes."""
    direct, via = row.reached
    chance = ', which chance may explain' if row.nearer.low <= 0 <= row.nearer.high else ''
    if row.scenes == 1:
        return (f'One scene, which proves nothing: objects end {row.nearer.value:.1f} cm nearer '
                'to their goals via the predicted subgoal.')
    told = (f'Via the predicted subgoal {via} of {row.scenes} scenes succeed, directly {direct}; '
            f'objects end on average {row.nearer.value:.1f} cm nearer to their goals')
    if row.scenes < FEW:
        return f'{told}. So few scenes prove nothing.'
    return f'{told} (95% interval {row.nearer.low:.1f} to {row.nearer.high:.1f}){chance}.'


def results_table(rows: Sequence[Row]) -> str:
    """Return rows as lines of text."""
    cells = [list(COLUMNS), *(row.texts() for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells)]
    lines = ['  '.join(text.rjust(width) for text, width in zip(line, widths)) for line in cells]
    return '\n'.join([lines[0], '-' * len(lines[0]), *lines[1:]])


def write_report(path: str | Path, scenes: Sequence[Scene], films: Mapping[str, bytes],
                 note: str, facts: Mapping[str, str]) -> None:
    """
    Write the page; everything is inside the one file.

    :param path: of the HTML file.
    :param scenes: list of Scene.
    :param films: WebP films by their captions.
    :param note: how the numbers were made.
    :param facts: what made the page: name and value, such as date and command.
    """
    rows = summary(scenes)
    template = Path(__file__).with_name('report.html').read_text()
    write_atomically(path, Environment(autoescape=True).from_string(template).render(
        words=in_words(rows[-1]), columns=COLUMNS, rows=[row.texts() for row in rows], note=note,
        facts=facts, films=[(caption, _uri(data)) for caption, data in films.items()],
        scenes=[(f'{scene.task} {scene.seed}', list(_stills(scene))) for scene in scenes]))


def as_row(scene: Scene) -> dict[str, Any]:
    """Return what is compared of a scene: metres of each object to its goal after each step."""
    return {'task': scene.task, 'seed': scene.seed, **{
        mode: scene.runs[mode].distances.tolist() for mode in MODES}}


def shown(scenes: Sequence[Scene]) -> dict[str, Scene]:
    """
    Return of which scene of each task a film is shown, by its caption.

    It is the first one that fails clearly directly and succeeds via the subgoal; without one the
    first that succeeds via the subgoal alone, and the first of all if none does.
    """
    found = {}
    for task, group in groupby(scenes, lambda scene: scene.task):
        first, *others = group
        caption, scene = next(
            ((words, one) for words, fits in FILMED.items() for one in (first, *others)
             if fits(one)), ('the first scene', first))
        found[f'{task} {scene.seed}: {caption}'] = scene
    return found


def gains(scene: Scene) -> bool:
    """Return whether a scene succeeds via the subgoal alone."""
    return scene.runs['subgoal'].reached and not scene.runs['direct'].reached


def gains_clearly(scene: Scene) -> bool:
    """Return whether besides an object is far from its goal after the direct run."""
    return gains(scene) and bool(scene.runs['direct'].distances[-1].max() > CLEARLY)


FILMED = {  # of a scene that fits, the first kind first
    f'the first scene that succeeds via the subgoal and ends {100 * CLEARLY:.0f} cm off or more '
    'directly': gains_clearly,
    'the first scene of this task that succeeds only via the subgoal': gains}


def _stills(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield (caption, data URI) of start, first subgoal, and the ends of both runs."""
    runs = scene.runs
    yield 'start', _still(scene.seen('subgoal', 0))
    for i, subgoal in enumerate(runs['subgoal'].subgoals[:1]):
        yield f'predicted: {scene.decided(subgoal)}', _still(scene.headed(i))
    for mode, name in MODES.items():
        run = runs[mode]
        yield (f'{name}: {run.final_cm:.1f} cm, {"success" if run.reached else "failed"}',
               _still(scene.seen(mode, -1)))


def _still(picture: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, 'webp', quality=80)
    return _uri(buffer.getvalue())


def _uri(data: bytes) -> str:
    return f'data:image/webp;base64,{base64.b64encode(data).decode()}'
