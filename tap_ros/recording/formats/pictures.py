# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pictures of other formats as the episodes of a bag; the command `python -m tap_ros import-video`.

Of other robots pictures and the task as text are taken; their actions would be commands with
another meaning.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
import re
from typing import Annotated, Any
import warnings

import cv2
import numpy as np
from tap_ros.base.errors import ConfigError, ImageError, RecordingError, RecordingWarning
from tap_ros.base.files import only_writer
from tap_ros.base.options import check_different, default_text, Folder
from tap_ros.base.progress import Progress
from tap_ros.base.text import counted, escaped, listing
from tap_ros.images.crop import Crop
from tap_ros.recording.bags import VIDEOS, what_is
from tap_ros.recording.defects import Defect, describe
from tap_ros.recording.episode import Episode
from tap_ros.recording.formats.videos import at_rate, video_frames
from tap_ros.recording.metadata import natural
from tap_ros.recording.reading import Part
from tap_ros.recording.trust import inside, MOST_BYTES, MOST_FRAMES, regular
from tap_ros.recording.writer import EpisodeWriter, Views, write_metadata
from tyro import conf

EPISODES_PER_FILE = 25
FILES = b'\xff\xd8\xff', b'\x89PNG'  # how JPEG and PNG files begin
DAMAGE = (ImageError, RecordingError, OSError, LookupError, TypeError, ValueError, AttributeError,
          ArithmeticError, MemoryError, RuntimeError, cv2.error)  # of files made by others
_MOST_SECONDS = 86400  # of a demonstration
MOST_CHARACTERS = 1000  # of a task
EPISODE_SPACING_NS = 60 * 10**9  # between the end of an episode and the start of the next
Paths = Annotated[conf.Positional[tuple[str, ...]], conf.arg(
    metavar='PATH [PATH ...]', help_behavior_hint='(required)')]


@dataclass(frozen=True, kw_only=True)
class Target:
    """
    Where imported episodes go, and what is kept of their pictures.

    :param out: folder of the bag; must not exist, or be empty.
    :param crop: square part of the pictures that is kept, as in train --help.
    :param size: pixels a side that they are scaled to; 0: not scaled, and those of videos are kept
        as JPEG.
    :param rate: pictures a second, about; 0: all of them.
    """

    out: Folder
    crop: Part = ''
    size: int = 0
    rate: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a rate that no camera has."""
        if not 0 <= self.rate <= 1000:
            raise ConfigError(f'--rate {self.rate}: expected more than 0, to 1000, or 0')

    @property
    def cut(self) -> Crop:
        """What is made of a picture."""
        return Crop(self.crop, self.size)


@dataclass(frozen=True, kw_only=True)
class Options(Target):
    """
    Options of the commands that import pictures.

    :param paths: files, or folders that hold some at any depth; they are taken in the order of
        the numbers in their names.
    :param camera: NAME of the pictures, of videos that of the files without ending; needed where
        there are several cameras. Given several times, not of videos, the first is the
        predictor's, on /camera/image_raw; each other one is kept for label, on a topic such as
        /camera/wrist/image_raw.
    :param fps: frames a second; 0: as videos say, 10 of arrays and 5 of TFRecord files.
    :param task: what is done in them, as text; TFRecord files tell it themselves.
    """

    paths: Paths
    camera: conf.UseAppendAction[Annotated[tuple[str, ...], conf.arg(
        metavar='NAME', help_behavior_hint='(default: the only one)')]] = ()
    fps: float = 0.0
    task: Annotated[str, conf.arg(metavar='TEXT', help_behavior_hint=default_text)] = ''

    def __post_init__(self) -> None:
        """Refuse rates that no camera has, and a camera that is given twice."""
        super().__post_init__()
        check_different('--camera', self.camera)
        if not 0 <= self.fps <= 1000:
            raise ConfigError(f'--fps {self.fps}: expected more than 0, to 1000, or 0')


def run(args: Options) -> None:
    """
    Import videos, each a demonstration, and print what was.

    :raises TapError: for what cannot be read, and a folder that holds something.
    """
    if len(args.camera) > 1:
        raise ConfigError('--camera: videos are imported of one camera')
    skipped = Skipped()
    files = [file for path in args.paths for file in _of_camera(
        Path(path), find_files(
            [path], [f'*{end}' for end in VIDEOS], skipped), *args.camera)]

    def episodes() -> Iterator[Episode]:
        for number, path in enumerate(sorted(files, key=natural)):
            with skipped.errors_of('video', escaped(path.name)):
                found = ((row / args.fps if args.fps else at, show)
                         for row, (at, show) in enumerate(video_frames(path)))
                frames, seconds = decoded(
                    at_rate(found, args.rate), lambda show: args.cut.image(show()), skipped,
                    escaped(path.name))
                yield make_episode(frames, seconds, task=args.task, seed=number)

    print(write_bag(args, episodes(), skipped, len(files), jpeg=not args.size))


def find_files(paths: Iterable[str | Path], patterns: Iterable[str],
               skipped: 'Skipped') -> list[Path]:
    """
    Return the regular files that are given, or lie in folders, in the order of their numbers.

    :param patterns: of names in folders, in small letters.
    :param skipped: is told of what is no such file, and of links that lead out of a folder.
    :raises RecordingError: for a folder that holds none.
    """
    found = []
    for path in map(Path, paths):
        named = [path] if not path.is_dir() else [
            file for file in path.rglob('*') if not file.is_dir()
            and any(fnmatch(file.name.lower(), pattern) for pattern in patterns)]
        if not named:
            raise RecordingError(f'{escaped(path)}: '
                                 f'{what_is(path) or "holds no file " + listing(patterns, 20)}')
        for file in named:
            with skipped.errors_of('file', escaped(file.name)):
                if file == path:
                    regular(file)
                else:
                    inside(path, file.relative_to(path))
                found.append(file)
    return sorted(found, key=natural)


def _of_camera(path: Path, found: list[Path], camera: str = '') -> list[Path]:
    """Return the videos of a camera; a file alone as it is."""
    if not path.is_dir():
        return found
    names = Counter(file.stem for file in found)
    if not camera and 1 < len(names) < len(found):
        raise ConfigError(f'--camera: expected one of {listing(sorted(names))}, which '
                          f'{escaped(path)} holds of several demonstrations')
    if camera and camera not in names:
        raise ConfigError(f'--camera {escaped(camera)}: {escaped(path)} holds no video of that '
                          f'name; expected one of {listing(sorted(names), 8)}')
    return [file for file in found if camera in ('', file.stem)]


class Skipped:
    """What of an import cannot be used; the rest is written, and this counted and named."""

    def __init__(self) -> None:
        self._defects: list[Defect] = []

    def note(self, why: object, what: str, where: str) -> None:
        """Note why a part cannot be used: what it is, such as a picture, and where it stands."""
        self._defects.append(Defect(escaped(why), what, where=where))

    @contextmanager
    def errors_of(self, what: str, where: str) -> Iterator[None]:
        """Note what cannot be read within, and go on behind it; what is read must be whole."""
        try:
            yield
        except DAMAGE as error:
            self.note(error, what, where)

    def warn(self, out: Path, is_empty: bool) -> None:
        """
        Warn of what was noted, a line a cause.

        :raises RecordingError: when nothing at all could be used.
        """
        lines = [f'{escaped(out)}: {line}' for line in describe(self._defects)]
        if is_empty:
            raise RecordingError('; '.join(lines[:3]).replace(f'; {escaped(out)}: ', '; ') or
                                 f'{escaped(out)}: there is no episode to import')
        for line in lines:
            warnings.warn(line, RecordingWarning, stacklevel=3)


def decoded(pictures: Iterable[tuple[float, Any]], decode: Callable[[Any], np.ndarray],
            skipped: Skipped, place: str) -> tuple[list[np.ndarray], np.ndarray]:
    """
    Decode the pictures of an episode, but those that cannot be used.

    :param pictures: of each a number, such as its time, and what is decoded.
    :param place: of the episode, for what is noted as skipped.
    :return: the pictures, and their numbers, (T,).
    :raises ValueError: when there is none.
    """
    frames, numbers, size = [], list[float](), 0
    for row, (number, each) in enumerate(pictures):
        with skipped.errors_of('picture', f'{row} of {place}'):
            frames.append(decode(each))
            numbers.append(number)
            size += frames[-1].nbytes
        if row >= MOST_FRAMES or size > MOST_BYTES:
            raise RecordingError(
                f'it is longer than {MOST_FRAMES} pictures or {MOST_BYTES >> 30} GiB; cut it into '
                'demonstrations, or keep less of each picture (--size)')
    if not frames:
        raise ValueError('none of its pictures can be used')
    return frames, np.array(numbers)



def make_episode(frames: Sequence[np.ndarray], seconds: Sequence[float] | np.ndarray,
                 object_names: tuple[str, ...] = (), **known: Any) -> Episode:
    """
    Make an episode of pictures.

    :param frames: T pictures, uint8 (H, W, 3).
    :param seconds: (T,), when they were taken, increasing.
    :param object_names: of K objects, whose pixels are known.
    :param known: other fields of Episode; what is left out is unknown, and not recorded.
    :return: Episode.
    :raises ValueError: for times and a seed that a recording cannot hold.
    """
    T, K = len(frames), len(object_names)
    seconds = np.asarray(seconds, float) - seconds[0]
    if not (np.diff(seconds) > 0).all() or not seconds[-1] < _MOST_SECONDS:
        raise ValueError('its times are not those of a demonstration: they have to increase, by '
                         f'less than {_MOST_SECONDS} s')
    if not 0 <= known.get('seed', 0) < 2**64:
        raise ValueError(f'its seed {escaped(known["seed"], 30)} is none: 0 to 2^64 - 1')
    known['task'] = known.get('task', '').encode(errors='replace').decode()[:MOST_CHARACTERS]
    unknown = np.full((T, K, 7), np.nan)
    none = np.full((T, 4), np.nan, np.float32)
    none[-1] = 0  # nothing leads on from the last frame
    fields = {
        'actions': none, 'grippers': np.full((T, 4), np.nan, np.float32),
        'object_pixels': np.full((T, K, 2), np.nan, np.float32), 'object_poses': unknown,
        'goal_frame': None, 'goal_pixels': np.full((K, 2), np.nan, np.float32),
        'goal_poses': np.full((K, 7), np.nan), 'object_source': 'imported'}
    return Episode(frames=np.stack(frames), object_names=object_names,
                   stamps=np.round(seconds * 1e9).astype(np.int64),
                   **(fields | known))


def signal_fields(found: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the fields of an Episode with numbers by name, (T, width) each; {} without any."""
    if not found:
        return {}
    names = [escaped(name, 60) + (f'/{k}' if values.shape[1] > 1 else '')
             for name, values in found.items() for k in range(values.shape[1])]
    with np.errstate(over='ignore'):  # absurd numbers become infinite
        signals = np.concatenate([*found.values()], 1, dtype=float, casting='unsafe')
        return {'signal_names': tuple(names), 'signals': signals.astype(np.float32)}


def print_signals(names: Collection[str], count: int = 0) -> None:
    """
    Print which numbers beside the pictures are kept as signals, if any.

    :param names: of arrays of so many numbers in all; or of each number, see signal_fields.
    """
    if names:
        arrays = names if count else dict.fromkeys(re.sub(r'/\d+$', '', name) for name in names)
        print(f'signals: {listing(arrays)}: {count or len(names)} numbers')


def _is_free(folder: Path) -> bool:
    """Return whether a folder holds nothing, or what an import has left that was killed."""
    left = list(folder.iterdir())
    ours = re.compile(rf'{re.escape(folder.resolve().name)}_\d+\.mcap(\.part)?')
    return not left or (all(ours.fullmatch(one.name) and one.is_file() for one in left)
                        and any(one.suffix == '.part' for one in left))


def write_bag(target: Target, episodes: Iterable[Episode | tuple[Episode, Views]],
              skipped: Skipped, count: int | None = None, jpeg: bool = False) -> str:
    """
    Write episodes one after the other, in files of EPISODES_PER_FILE: all of them, or nothing.

    :param target: Target.
    :param episodes: iterable of Episode, whose stamps count from anywhere, alone or with Views.
    :param skipped: what could not be used of them, when they have been read.
    :param count: how many there are, to show progress.
    :param jpeg: keep pictures as JPEG, a sixth of the bytes and the time; of videos, which have
        lost more.
    :return: a line that says what was written.
    :raises ConfigError: for a folder that holds something.
    :raises RecordingError: when there is no episode.
    """
    out, begin, frames, done, size = Path(target.out), 10**9, 0, 0, (0, 0)
    if out.exists() and not (out.is_dir() and _is_free(out)):
        raise ConfigError(f'--out {escaped(out)}: is not empty; name a new folder')
    is_new, whole = not out.exists(), False
    with only_writer(out):
        try:
            for old in out.iterdir():
                old.unlink()  # of an import that was killed
            with ExitStack() as stack:
                for each in Progress(episodes, 'importing', count, unit='episode', delay=1):
                    episode, views = each if isinstance(each, tuple) else (each, None)
                    if done % EPISODES_PER_FILE == 0:
                        stack.close()
                        name = f'{out.resolve().name}_{done // EPISODES_PER_FILE}.mcap'
                        writer = stack.enter_context(EpisodeWriter(out / name, jpeg=jpeg))
                    stamps = episode.stamps - episode.stamps[0] + begin
                    writer.write(replace(episode, stamps=stamps), views)
                    begin, size = int(stamps[-1]) + EPISODE_SPACING_NS, episode.frames.shape[1:3]
                    frames, done = frames + len(episode), done + 1
            skipped.warn(out, is_empty=not done)
            write_metadata(out)
            whole = True
        finally:
            for file in () if whole else out.iterdir():
                file.unlink(missing_ok=True)
            if is_new and not whole:
                out.rmdir()
    return (f'{escaped(out)}: {counted(done, "episode")}, {frames} frames of {size[1]}x{size[0]} '
            'pixels')
