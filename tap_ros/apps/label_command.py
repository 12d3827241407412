# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros label`: from ten marks to a label in every demonstration."""

from collections.abc import Mapping, Sequence
import csv
from dataclasses import dataclass, replace
import io
import json
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically
from tap_ros.base.options import File, Folder
from tap_ros.base.progress import Progress
from tap_ros.base.text import counted, escaped, listing
from tap_ros.evaluation.intervals import share_interval
from tap_ros.images.drawing import png_bytes
from tap_ros.recording.bags import find_bags, Paths
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.events import Event, write_events
from tap_ros.recording.formats.lerobot_subtasks import (
    describe_set,
    Ends,
    segment_names,
    UNLABELLED,
    write_subtasks,
)
from tap_ros.recording.marks import beside, Mark, numbered, read_marks, write_marks
from tap_ros.recording.metadata import FILE_NAME
from tap_ros.recording.reading import Reading, reading_of, ReadingOptions
from tap_ros.training.films import film_together, signals_like
from tap_ros.training.labels import Film, label, Labels, SIZE
from tyro import conf

WITHIN_S = (0.3, 0.5, 1.0)  # of which the share of labels is told
UNSURE = 0.5  # a confidence below is a warning in the MCAP
SHEET_SIZE = 96, 128  # px, height and width, of a picture in the contact sheet
SHEET_ROWS = 40  # demonstrations in it, at most
BEFORE_AND_AFTER_S = (-0.5, 0.0, 0.5)
_LINE = 14  # px of a line of text
Signals = Annotated[tuple[str, ...], conf.arg(
    metavar='PART [PART ...]', help_behavior_hint='(default: none)')]


@dataclass(frozen=True)
class WholeReading(ReadingOptions):
    """
    Where demonstrations are cut, and which of their pictures count.

    :param image_topic: the camera's topic; needed where several topics of pictures are in them.
        Of several all count; labels.png shows the first.
    """

    crop: Annotated[str, conf.Fixed, conf.Suppress] = 'whole'
    size: Annotated[int, conf.Fixed, conf.Suppress] = SIZE


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param recordings: .mcap files, bag folders, or folders of these.
    :param marks: file of `python -m tap_ros mark`; by default the one beside the first recording.
    :param out: folder for labels.json, labels.csv, labels.png, labels.marks.json, the labels as
        marks, and of each bag an MCAP file that viewers open together with it.
    :param signals: parts of names of signals that count beside the pictures, such as Hand; '' is a
        part of each name.
    :param write_lerobot: the LeRobot data set from which the recording was imported: its rows get
        the subtasks that the labels tell apart, instead of those that it has; rows of
        demonstrations without labels get one called unlabelled.
    """

    recordings: Annotated[conf.Positional[tuple[str, ...]], conf.arg(
        metavar='BAG [BAG ...]', help_behavior_hint='(required)')]
    out: Folder
    marks: File = ''
    signals: Signals = ()
    write_lerobot: Folder = ''
    reading: WholeReading = WholeReading()


def run(options: Options) -> None:
    """
    Label the demonstrations, and say how far off a label is to be expected.

    :raises TapError: for recordings or marks that cannot be used.
    """
    known, indices = describe_set(options.write_lerobot) if options.write_lerobot else ({}, {})
    store, films = describe_all(
        options.recordings, reading_of(options.reading), options.signals)
    path = Path(options.marks) if options.marks else beside(options.recordings[0])
    marks = read_marks(path, store)
    by_hand = marks.marked
    if not by_hand:
        raise ConfigError(f'{escaped(path)}: all of them are labels; mark some demonstrations')
    marked = {i: store.seconds(i)[[(first + last) // 2 for first, last in those]]
              for i, those in by_hand.items()}
    names = marks.names or tuple(
        f'mark {k + 1}' for k in range(len(next(iter(marked.values()), ()))))
    labels = label(films, marked, names, progress=True)
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    places = numbered(store, options.recordings, out)
    rows = [{'recording': places[i][0], 'episode': places[i][1], 'name': name,
             'seconds': round(float(second), 3), 'stamp': round(
                 int(store[i].stamps[0]) / 1e9 + float(second), 6),
             'confidence': round(float(sure), 3), 'marked': i in marked}
            for i in range(len(store)) if films[i] is not None
            for name, second, sure in zip(names, labels.moments[i], labels.confidence[i])]
    write_atomically(out / 'labels.json', json.dumps({
        'names': names, 'marks': marks.digest, 'labels': rows}, indent=1) + '\n')
    write_atomically(out / 'labels.csv', to_csv(rows))
    frames = {i: those for i in range(len(store)) if (
        those := by_hand.get(i) or frames_of(store, i, labels.moments[i]))}
    write_marks(out / 'labels.marks.json', store, options.recordings, frames, names,
                frames.keys() - by_hand.keys())
    write_atomically(out / 'labels.png', png_bytes(contact_sheet(store, labels, set(marked))))
    parts = segment_names(names)
    for source, name in distinct_names(store).items():
        write_events(out / f'{name}.labels.mcap', (
            event for i in range(len(store)) if store.source(i) == source and films[i] is not None
            for event in events_of(store, i, labels, parts)))
    print(worth([(films[i], marked[i]) for i in marked], labels))
    if options.write_lerobot:
        numbers = numbers_of(store, indices)
        count, missing = write_subtasks(options.write_lerobot, parts, {
            numbers[i]: Ends(labels.moments[i].tolist(), float(store.seconds(i)[-1]),
                             float(np.diff(store.seconds(i)).max())) for i in frames})
        print(f'{options.write_lerobot}: {count} rows with the subtasks {listing(parts)}' + (
            f'; {counted(missing, "demonstration")} without labels: {UNLABELLED}'
            if missing else ''))
        if (version := str(known.get('codebase_version'))).startswith('v2'):
            print(f'{options.write_lerobot}: is of {escaped(version, 20)}, and lerobot shows the '
                  'subtasks of v3.0 only; convert it with the package lerobot, then run this '
                  'again: the conversion leaves the subtasks out')
    print(f'{out}: {counted(len(store), "demonstration")} labelled; look at labels.png: '
          'numbers cannot tell whether all marks are early or late')


def describe_all(recordings: Paths, reading: Reading,
                 signals: Sequence[str]) -> tuple[EpisodeStore, list[Film | None]]:
    """Return the demonstrations as the first camera saw them, and what is known of each."""
    bags = find_bags(recordings)
    store, *beside = (open_recordings(bags, reading=replace(reading, image_topic=topic))
                      for topic in reading.cameras)
    names = signals_like(store, signals)
    return store, [film_together(store, i, beside, names) for i in Progress(
        range(len(store)), desc='describing', unit='demonstration', delay=1)]


def numbers_of(store: EpisodeStore, indices: Mapping[int, int]) -> list[int]:
    """
    Return the index in a LeRobot data set of each demonstration.

    It is known by the seed, as some may have been lost at import; where these repeat, as in
    recordings that were exported rather than imported, by the order.

    :param indices: by seed, see describe_set.
    """
    seeds = [episode.seed for episode in store]
    if len({*seeds}) < len(seeds):
        return list(range(len(seeds)))
    return [indices.get(seed, seed) for seed in seeds]


def frames_of(store: EpisodeStore, i: int, moments: np.ndarray) -> Sequence[Mark]:
    """Return the frames of moments (M,) s as marks; none where these would not be in order."""
    if not np.isfinite(moments).all():
        return ()
    stamps = store[i].stamps
    away = np.abs((stamps - stamps[0]) / 1e9 - moments[:, None])
    frames = away[:, 1:-1].argmin(1) + 1  # neither start nor goal
    return [(t, t) for t in frames.tolist()] if (np.diff(frames) > 0).all() else ()


def distinct_names(store: EpisodeStore) -> dict[Path, str]:
    """Return a name for each bag of a store, by its first file: that of its folder or file."""
    names: dict[Path, str] = {}
    for source in dict.fromkeys(map(store.source, range(len(store)))):
        first = source.parent.name if (source.parent / FILE_NAME).exists() else source.stem
        name, number = first, 1
        while name in names.values():
            name, number = f'{first}-{number + 1}', number + 1
        names[source] = name
    return names


def events_of(store: EpisodeStore, i: int, labels: Labels, parts: Sequence[str]) -> list[Event]:
    """Return the start of a demonstration, its moments, and its end."""
    ends = [Event(*store.recorded(i, t)[2:], subtask) for t, subtask in (
        (0, parts[0]), (int(store.lengths[i]) - 1, ''))]
    moments = []
    for name, second, sure, subtask in zip(labels.names, labels.moments[i], labels.confidence[i],
                                           parts[1:]):
        t = int(np.abs(store.seconds(i) - second).argmin())
        moments.append(Event(
            *store.recorded(i, t)[2:], subtask, name,
            f'demonstration {i} at {second:.1f} s, {sure:.0%}', sure < UNSURE))
    return [ends[0], *moments, ends[1]]


def to_csv(rows: Sequence[dict[str, object]]) -> str:
    """Return rows as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def worth(marked: Sequence[tuple[Any, np.ndarray]], labels: Labels) -> str:
    """
    Return in words how far off labels are, by leaving out each marked demonstration once.

    :param marked: Film and marks (M,) s of each.
    """
    if not labels.left_out:
        return f'{len(marked)} marked demonstrations do not tell how good labels are; mark ten'
    lines = [f'Each of {len(marked)} marked demonstrations, labelled by the others: share of '
             f'labels within {", ".join(f"{s:g}" for s in WITHIN_S)} s (95%), median error']
    ends = np.array([film.stamps[-1] for film, _ in marked])
    for m, name in enumerate(labels.names):
        true = np.array([moments[m] for _, moments in marked])
        random = float(np.mean([film.near(moments[m], WITHIN_S[1]) for film, moments in marked]))
        found = {}
        for way, guess in {
                'label': [moments[m] for moments in labels.left_out],
                'fixed share of the time': [
                    end * np.median(np.delete(true / ends, i)) for i, end in enumerate(ends)],
                'slowest frame': [film.stamps[film.slowest] for film, _ in marked]}.items():
            errors = np.abs(np.array(guess) - true)
            found[way] = [share_interval(errors <= s + 1e-6) for s in WITHIN_S]
            lines.append(f'  {name}, {way}: ' + ', '.join(
                f'{one.value:.0%} ({one.low:.0%} to {one.high:.0%})' for one in found[way])
                + f'; {np.median(errors):.2f} s')
        lines.append(f'  {name}, random frame: {random:.0%} within {WITHIN_S[1]:g} s' + (
            '' if found['label'][1].low > random else
            '; labels are not told from chance: mark more demonstrations, or other moments'))
    return '\n'.join(lines)


def contact_sheet(store: EpisodeStore, labels: Labels, marked: set[int]) -> np.ndarray:
    """
    Draw the labelled moments, the least certain first: .5 s before, at, and .5 s after each.

    :return: uint8 (height, width, 3) rgb.
    """
    usable = [i for i in range(len(store)) if np.isfinite(labels.moments[i]).all()]
    order = sorted(usable, key=lambda i: (i in marked, labels.confidence[i].min()))[:SHEET_ROWS]
    rows = []
    for i in order:
        frames, stamps = store.frames(i), store.seconds(i)
        row = []
        for name, second, sure in zip(labels.names, labels.moments[i], labels.confidence[i]):
            for offset in BEFORE_AND_AFTER_S:
                frame = frames[np.abs(stamps - second - offset).argmin()]
                panel = np.full((SHEET_SIZE[0] + _LINE, SHEET_SIZE[1], 3), 255, np.uint8)
                panel[_LINE:] = cv2.resize(frame, SHEET_SIZE[::-1], interpolation=cv2.INTER_AREA)
                text = f'{i} {name} {second:.1f} s ' + ('marked' if i in marked else f'{sure:.0%}')
                if offset == 0:
                    cv2.putText(panel, text, (2, _LINE - 3), cv2.FONT_HERSHEY_SIMPLEX, 0.33,
                                (0, 0, 0), 1, cv2.LINE_AA)
                    panel[_LINE:_LINE + 2] = panel[-2:] = (220, 38, 127)
                row.append(panel)
        rows.append(np.concatenate(row, 1))
    return np.concatenate(rows)
