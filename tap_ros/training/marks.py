# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The preference w(t) of a training: by stillness, or labels of a few marks (labels.py)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
import sys
from typing import Any, TYPE_CHECKING

import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import listing
from tap_ros.images.robot_mask import hidden_pixels, RobotMask
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import Mark, Marks, read_marks
from tap_ros.recording.reading import reading_of
from tap_ros.training.films import film_together, signals_like
from tap_ros.training.labels import Film, fit, SIZE, spread
from tap_ros.training.preference import describe, LEAST_FRAMES, still
from tap_ros.training.run import bags_of

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore
    from tap_ros.training.predictor_config import TrainingConfig

LIKELIEST = 7  # frames of an episode that may be the label
LEAST = 1e-37  # w of the others; its logarithm is finite, so that some target is always the best


def episode_preferences(
        store: 'EpisodeStore', config: 'TrainingConfig', training: np.ndarray,
        progress: bool = False) -> tuple[list[np.ndarray] | None, dict[str, Any]]:
    """
    Compute the preference w(t) that a training needs, by stillness or from marks.

    :param training: indices of the episodes to train on.
    :param progress: show a bar.
    :return: w of each episode, float32 (levels, T), 1 in those too short for targets; None if it
        follows from the time. And what the weights file tells of the marks.
    :raises ConfigError: see label_episodes.
    """
    found = [np.ones((config.recursion, T), np.float32) for T in store.lengths]
    if config.selection == 'still':
        for i, w in enumerate(found):
            if w.shape[1] >= LEAST_FRAMES:
                w[:] = still(describe(store.frames(i), hidden_of(store, i, config.robot_mask)))
        return found, {}
    if not config.marks:
        return None, {}
    marks = read_marks(config.marks, store)
    whole = store
    if store.camera_size and store.camera_size[0] != store.camera_size[1]:
        # What the cut leaves out may tell the moment.
        whole = open_recordings(bags_of(config), progress=False, reading=replace(
            reading_of(config), crop='whole', size=SIZE))
    labels, levels = label_episodes(whole, marks, training, config, progress)
    for w, label in zip(found, labels):
        if label is not None:
            w[:] = label
    print_marks_report(levels)
    return found, {'marks': {'sha256': marks.digest, 'levels': levels}}


def hidden_of(store: 'EpisodeStore', i: int, robot_mask: RobotMask) -> np.ndarray | None:
    """Return which pixels (T, H, W) of an episode a robot mask hides; None: none."""
    masks = None if robot_mask == 'none' else store[i].robot_masks
    return None if masks is None else hidden_pixels(masks, robot_mask)


def label_episodes(store: 'EpisodeStore', marks: Marks, training: np.ndarray,
                   config: 'TrainingConfig', progress: bool = False,
                   ) -> tuple[list[np.ndarray | None], list[dict[str, Any]]]:
    """
    Find how likely each frame is the one that is marked, by the marks of the training episodes.

    :param training: indices of the episodes to train on; marks of others are left out.
    :param progress: show a bar.
    :return: of each episode w of its frames, (levels, T), 1 at the likeliest one, LEAST beyond the
        LIKELIEST; None for one too short. And of each level how well a mark is found by what is
        learned from the others. Predictions between start and goal begin with the last mark, those
        from the start alone with the first.
    :raises ConfigError: without marks there, or where an episode has not one for each level.
    """
    chosen = sorted(set(marks.episodes) & set(training.tolist()))
    if not chosen:
        raise ConfigError(f'marks: none of the {len(marks.episodes)} marked demonstrations is '
                          'trained on; mark some of those that are not held out')
    order = slice(None) if config.forward else slice(None, None, -1)
    if config.mark_name:
        order = slice(k := marks.number(config.mark_name, chosen), k + 1)
    count = len(marks.names) if config.mark_name else config.recursion
    for i in chosen:
        if len(marks.episodes[i]) != count:
            one = f', or choose one of {listing(marks.names)} by --mark-name' * bool(marks.names)
            raise ConfigError(
                f'marks: demonstration {i} has {len(marks.episodes[i])}, and each needs {count}, '
                f'one for a level of recursion; mark as many, or give --recursion{one}')
    beside = [open_recordings(bags_of(config), progress=False, reading=replace(
        reading_of(config), image_topic=topic, crop='whole', size=SIZE))
        for topic in config.label_topic]
    signals = signals_like(store, config.label_signals)
    films = [film_together(store, i, beside, signals, hidden_of(store, i, config.robot_mask))
             for i in range(len(store))]
    # All marks of a demonstration are found together, also where one is trained on.
    moments = {i: np.array([
        store[i].stamps[(first + last) // 2] - store[i].stamps[0]
        for first, last in marks.episodes[i]]) / 1e9 for i in chosen}
    of_chosen = [one for i in chosen if (one := films[i])]
    model, left_out = fit(of_chosen, list(moments.values()), progress)
    if among := marks.labels.intersection(chosen):  # they come from each other
        about = [{'demonstrations': len(chosen), 'labels': len(among)}] * count
    else:
        about = [_worth(of_chosen, np.array(true), np.array(guess)) for true, guess in zip(
            np.transpose(list(moments.values())),
            np.transpose(left_out) if left_out else [()] * count)]
    about = about[order]
    labels: list[np.ndarray | None] = []
    for i, one in enumerate(films):
        if one is None:
            labels.append(None)
            continue
        share = np.exp(model.log_posterior(one))  # (M, T)
        if i in moments:
            share = np.stack([spread(one, second) for second in moments[i]])
        seconds = (store[i].stamps - store[i].stamps[0]) / 1e9
        w = np.stack([np.interp(seconds, one.stamps, row) for row in share])
        w[:, [0, -1]] = 0  # start and goal are no moments between them
        w /= w.max(1, keepdims=True)
        few = np.sort(w, 1)[:, -LIKELIEST:][:, :1]
        labels.append(np.where(w >= few, w, 0).clip(LEAST)[order].astype(np.float32))
    return labels, about


def _worth(films: Sequence[Film], true: np.ndarray, guess: np.ndarray) -> dict[str, Any]:
    """Say how well marks are found by one another; true, guess: (N,) s, or no guess."""
    facts: dict[str, Any] = {'demonstrations': len(films)}
    if len(guess):
        within = np.array([one.tolerance for one in films])
        facts |= {'seconds': round(float(np.median(within)), 3),
                  'found': int((np.abs(guess - true) <= within).sum()),
                  'random': float(np.mean([one.near(second, one.tolerance)
                                           for one, second in zip(films, true)]))}
    return facts


def chance(mark: Mark, length: int, tolerance: int = 1) -> float:
    """Return in which share of the frames between start and goal a mark would be hit."""
    first, last = max(1, mark[0] - tolerance), min(length - 2, mark[1] + tolerance)
    return (last - first + 1) / (length - 2)


def print_marks_report(about: Sequence[Mapping[str, Any]]) -> None:
    """Print before a training what the marks are worth; on stderr."""
    from scipy.stats import binomtest  # takes a second to import
    for level, facts in enumerate(about, start=1):
        count = facts['demonstrations']
        name = 'marks' if len(about) == 1 else f'marks, level {level}'
        if 'labels' in facts:
            text = (f'{count} demonstrations, {facts["labels"]} of them labels; `label` printed '
                    'how good these are')
        elif 'found' not in facts:
            text = f'{count} marked, so nothing tells what that is worth; mark ten'
        else:
            found, random = facts['found'], facts['random']
            low, high = binomtest(found, count).proportion_ci(method='wilson')
            text = (f'{count} demonstrations. Learned from the others, a mark is found within '
                    f'{facts["seconds"]:.2g} s in {found / count:.0%} ({low:.0%} to {high:.0%}), '
                    f'by a random frame in {random:.0%}')
            if low <= random:
                text += ': they are not told from chance; mark more, or other moments'
        print(f'{name}: {text}', file=sys.stderr)
