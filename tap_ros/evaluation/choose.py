# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The option `train predictor --choose`: short trainings of each selection, on a page to choose from.

No error, and nothing else that needs no marks, tells which selection has found the bottleneck. So
a person looks at strips; or marks that are held out decide.
"""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
import shlex
from typing import Any, get_args, NamedTuple

from tap_ros.errors import ConfigError
from tap_ros.files import write_atomically
from tap_ros.prediction import training_config
from tap_ros.prediction.methods import Selection
from tap_ros.prediction.training_config import TrainingConfig
from tap_ros.recording.reading import reading_of
from tap_ros.training.recipes import find_recipe
from tap_ros.training.split import FEW
from tap_ros.training.train import recipe_of, settings_of

TRIAL = {'steps': 400, 'batch_size': 8}  # at most
HELD_OUT = (0.2, 0.3, 0.4, 0.5)  # shares; the first one that holds out a third of the marks
STRIPS = 8  # held-out demonstrations that are drawn
_FOUND = {'relative': 'what copying the start or the goal shows worst',
          'progress': 'what looks about half way from the start to the goal',
          'absolute': "what is predicted with the least error, the paper's method",
          'fix': 'the middle of the time', 'marks': 'what is marked',
          'still': 'where pictures change least between start and goal'}
_STYLE = ('body { font: 15px/1.5 sans-serif; margin: 1rem auto; max-width: 60rem; '
          'padding: 0 1rem; } img { max-width: 100%; } pre { background: #eee; '
          'padding: .5rem; white-space: pre-wrap; } td { padding-right: 2rem; text-align: left; }')


@dataclass(frozen=True, kw_only=True)
class Options(training_config.Options):
    """
    Options of the command `train predictor`.

    :param choose: train each selection for a short time instead, and write a page, choose.html,
        with what they predict for held-out demonstrations and the commands that train them.
    """

    choose: bool = False


class Candidate(NamedTuple):
    """A selection that was tried: its name, sheet of strips, command, and hits of marks."""

    name: str
    sheet: bytes  # PNG
    command: str
    hits: Any  # bool (N,) of N marked held-out demonstrations


defaults = training_config.defaults


def run(args: Options) -> None:
    """
    Train; or with --choose try the selections, print where the page is, and what marks say.

    :raises ConfigError: for settings that no selection can be trained with.
    """
    if not args.choose:
        training_config.run(args)
        return
    settings = settings_of(args)
    out = Path(settings['out'] or 'runs/predictor')
    tried, counts = _try(args, _configs(settings, out))
    said = _decide(tried)
    write_atomically(out / 'choose.html', _page(tried, counts, said))
    print('\n'.join([*said, str(out / 'choose.html')]))


def _configs(settings: Mapping[str, Any], out: Path) -> dict[str, TrainingConfig]:
    """Return the configuration of each selection that goes with the other settings."""
    found, refused = {}, None
    for name in ('fix', *get_args(Selection)):
        if name == 'marks' and not settings['marks']:
            continue
        changes = _options(name, settings) | {'out': str(out / 'choose' / name)}
        changes |= {key: min(settings[key], most) for key, most in TRIAL.items()}
        try:
            found[name] = TrainingConfig(**{**settings, 'marks': '', **changes})
        except ConfigError as error:
            refused = error
    if not found and refused:
        raise refused
    return found


def _options(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that make a selection."""
    if name == 'fix':
        return {'loss': 'fix', 'selection': training_config.DEFAULTS['selection']}
    return {'loss': 'genmin', 'selection': name} | (
        {'marks': settings['marks']} if name == 'marks' else {})


def _try(args: Options, configs: Mapping[str, TrainingConfig]) -> tuple[
        list[Candidate], dict[str, int]]:
    """Train and score the selections; return them, and how many demonstrations there are."""
    from dataclasses import replace

    import numpy as np
    from tap_ros.evaluation.hits import is_hit
    from tap_ros.evaluation.prediction import evaluate
    from tap_ros.evaluation.strips import draw_strips
    from tap_ros.images.drawing import png_bytes
    from tap_ros.prediction.predictor import load_network
    from tap_ros.prediction.training import train
    from tap_ros.recording.cache import open_recordings
    from tap_ros.recording.marks import read_marks
    from tap_ros.training.inpainted import fill, with_masks
    from tap_ros.training.run import paths_of
    from tap_ros.training.split import split_episodes, warn_if_few
    first = next(iter(configs.values()))
    store = open_recordings(paths_of(first), reading=reading_of(first))
    marks = read_marks(args.objective.marks, store) if args.objective.marks else None
    known = set(marks.episodes) if marks else set()
    for share in HELD_OUT:
        parts = with_masks(store, split_episodes(
            store, max(share, first.test_fraction), held_out=first.held_out), first.robot_mask)
        if share > HELD_OUT[0] and len(parts[1]) > len(parts[0]):
            break  # too few would be left to train on
        (kept, held_out), fraction = parts, max(share, first.test_fraction)
        if len(known & set(held_out.tolist())) >= len(known) / 3:
            break
    if not len(held_out):
        raise ConfigError('recordings: no demonstration is left to be held out; record more')
    warn_if_few(held_out)
    marked = np.array([i for i in held_out.tolist() if i in known], int)
    goal, filled, tried = 'recorded', fill(store, first.robot_mask), []
    for name, config in configs.items():
        weights = train(replace(config, test_fraction=fraction))
        network, _ = load_network(weights)
        hits = np.zeros(0, bool)
        if marks and len(marked):
            matched = evaluate(network, store, marked, goal, filled)['prediction'].match_step
            hits = np.array([is_hit(marks.episodes[i], t, 1) for i, t in zip(
                marked.tolist(), matched.tolist())])
        shown = np.concatenate([marked, np.setdiff1d(held_out, marked)])[:STRIPS]
        tried.append(Candidate(
            name, png_bytes(draw_strips(network, store, shown, goal, filled, marks)),
            command_of(args, name), hits))
    return tried, {'steps': first.steps, 'training': len(kept), 'held_out': len(held_out),
                   'marked': len(marked)}


def command_of(args: Options, name: str) -> str:
    """Write the command that trains a selection with the other options as they are."""
    given = settings_of(args)
    recipe = args.recipe or recipe_of('predictor', given['recordings'], given)
    usual = {**training_config.DEFAULTS, **find_recipe('predictor', recipe).settings}
    changed = {key: value for key, value in given.items()
               if key not in ('recordings', 'selection', 'loss', 'marks')
               and value != usual.get(key, '')} | _options(name, given)
    words = ['python', '-m', 'tap_ros', 'train', 'predictor', *given['recordings']]
    words += ['--recipe', recipe]
    for key, value in changed.items():
        option = key.replace('_', '-')
        if isinstance(value, bool):
            words.append(f'--{option}' if value else f'--no-{option}')
        elif key == 'image_topic':
            words += [word for topic in value for word in (f'--{option}', topic)]
        else:
            words += [f'--{option}', *map(str, value if isinstance(value, tuple) else [value])]
    return shlex.join(words)


def _decide(tried: Sequence[Candidate]) -> list[str]:
    """Say which selection the held-out marks choose, if there are any."""
    if not len(tried[0].hits):
        return ['look at the page and choose: no marks are held out that could']
    from tap_ros.evaluation.intervals import share_interval
    if len(tried[0].hits) < FEW:
        return [f'look at the page and choose: {len(tried[0].hits)} held-out marks are too few; '
                'mark more to let them choose']
    best = max(tried, key=lambda one: int(one.hits.sum()))
    low = share_interval(best.hits).low
    near = [one.name for one in tried
            if one is not best and share_interval(one.hits).high > low]
    return [f'{best.name} hits most: {_share(best.hits)}'
            + (f'; not told from: {", ".join(near)}' if near else ''), best.command]


def _share(hits: Any) -> str:
    """Write how often held-out marks are hit."""
    from tap_ros.evaluation.intervals import share_interval
    value, low, high = share_interval(hits)
    return f'{int(hits.sum())} of {len(hits)} held-out marks, {value:.0%} ({low:.0%}, {high:.0%})'


def _page(tried: Sequence[Candidate], counts: Mapping[str, int], said: Sequence[str]) -> str:
    """Write the page."""
    parts = [
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Choose a selection</title>'
        f'<style>{_STYLE}</style><h1>Which selection shows the bottleneck?</h1>',
        f'<p>Each was trained for {counts["steps"]} steps on {counts["training"]} demonstrations. '
        f'The rows are of the {counts["held_out"]} that were held out. Choose the one that shows '
        'the moment you want in most rows; the command below its strips trains it in full. If '
        'none does, mark a dozen demonstrations (<code>python -m tap_ros mark</code>). No error '
        'tells which is right, so there is none here.</p>']
    if counts['marked']:
        rows = ''.join(f'<tr><td>{one.name}</td><td>{_share(one.hits)}</td></tr>' for one in tried)
        parts.append(
            '<h2>What the marks say</h2><p>Matched frames within one frame of a mark, in marked '
            'demonstrations that none was trained on; in brackets 95% intervals.</p>'
            f'<table>{rows}</table><p><b>{escape(said[0])}</b></p>')
    for one in tried:
        parts.append(
            f'<h2>{one.name}</h2><p>Looks for {_FOUND.get(one.name, one.name)}.</p><img alt="'
            f'strips of {one.name}" src="data:image/png;base64,{b64encode(one.sheet).decode()}">'
            f'<pre>{escape(one.command)}</pre>')
    return '\n'.join([*parts, '</html>\n'])
