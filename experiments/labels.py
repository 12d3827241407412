# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How well a few marks label all other demonstrations, where the moments are known."""

from dataclasses import dataclass
import json
from pathlib import Path

import numpy as np
from tap_ros.apps.label_command import describe_all, Signals, WITHIN_S
from tap_ros.base.errors import ConfigError
from tap_ros.base.options import File, Folder
from tap_ros.base.progress import Progress
from tap_ros.recording.reading import Reading, Topics
from tap_ros.training.labels import Film, label, SIZE


@dataclass(frozen=True)
class Options:
    """
    Options of `python -m experiments labels`.

    It prints, for each name, the share of demonstrations labelled within .3, .5 and 1 s, in the
    mean of the draws; each demonstration that is not marked counts.

    :param recordings: one bag folder with all demonstrations.
    :param truth: JSON file {episode: {"grasp_s": 2.6, ...}}, s from the start of each episode.
    :param image_topic: the camera's topic; needed where several topics of pictures are in them.
    :param signals: parts of names of signals that count beside the pictures, such as Hand.
    :param marks: demonstrations that are marked in each draw.
    :param draws: how many; draw k has the seed k.
    :param out: folder for labels.json with the errors; '': none is written.
    """

    recordings: Folder
    truth: File
    image_topic: Topics = ()
    signals: Signals = ()
    marks: int = 10
    draws: int = 16
    out: Folder = ''


def run(options: Options) -> None:
    """
    Label by marks drawn at random, and print the table.

    :raises ConfigError: for a truth of other demonstrations.
    """
    store, films = describe_all(options.recordings, Reading(
        options.image_topic, crop='whole', size=SIZE), options.signals)
    truth = json.loads(Path(options.truth).read_text())
    if len(truth) != len(store):
        raise ConfigError(f'truth: {len(truth)} episodes, and the recordings have {len(store)}')
    names = [name for name in truth['0'] if name.endswith('_s')]
    moments = [np.array([truth[str(i)][name] for name in names]) for i in range(len(store))]
    errors: dict[str, list[np.ndarray]] = {'labels': [], 'fixed share of the time': []}
    for draw in Progress(range(options.draws), desc='labelling', delay=1):
        chosen = np.random.default_rng(draw).choice(len(films), options.marks, replace=False)
        found = guess(films, moments, chosen.tolist(), names)
        for way, labels in found.items():
            errors[way] += [np.abs(labels[i] - moments[i])
                            for i in range(len(films)) if i not in chosen]
    print(f'| {options.marks} marks, {options.draws} draws | ' + ' | '.join(
        f'{name.removesuffix("_s")}: within {" / ".join(f"{s:g}" for s in WITHIN_S)} s'
        for name in names) + ' |\n|---|' + '---|' * len(names))
    for way, those in errors.items():
        shares = [(np.stack(those) <= s + 1e-3).mean(0) for s in WITHIN_S]
        print(f'| {way} | ' + ' | '.join(
            ' / '.join(f'{share[m]:.0%}' for share in shares) for m in range(len(names))) + ' |')
    if options.out:
        Path(options.out).mkdir(parents=True, exist_ok=True)
        (Path(options.out) / 'labels.json').write_text(json.dumps(
            {way: np.stack(those).round(3).tolist() for way, those in errors.items()}) + '\n')


def guess(films: list[Film | None], moments: list[np.ndarray], chosen: list[int],
          names: list[str]) -> dict[str, list[np.ndarray]]:
    """Return the moments (M,) s of all demonstrations, by labels and by a fixed share."""
    ends = np.array([film.stamps[-1] if film else np.nan for film in films])
    share = np.median([moments[i] / ends[i] for i in chosen], 0)
    return {'labels': label(films, {i: moments[i] for i in chosen}, names).moments,
            'fixed share of the time': [end * share for end in ends]}
