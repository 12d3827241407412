# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Import pictures that stand as arrays in HDF5 files, as of ALOHA and robomimic.

An array of pictures is (N, H, W, 3 or 4), (N, 3, H, W), or of N JPEG or PNG files, whose bytes may
be padded. Its last name is the camera, or all names where several end alike, as base_camera/rgb
and hand_camera/rgb; arrays of one camera in several groups with a number, such as data/demo_7/obs,
are an episode each, and so is each file. Arrays of as many numbers beside them become signals.

Only what is stored in the file itself is read: no links, no arrays that other files hold, and
nothing that a plug-in has to unpack.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import partial
from itertools import count
import math
import os
from pathlib import Path
import re
from typing import Any

import numpy as np
from tap_ros.base.contract import MAX_PICTURE_BYTES, MOST_SIGNALS
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.base.text import escaped, listing
from tap_ros.images.encodings import decompress
from tap_ros.recording.bags import what_else, what_is
from tap_ros.recording.episode import Episode
from tap_ros.recording.formats.other_cameras import other_cameras, print_views
from tap_ros.recording.formats.pictures import (
    decoded,
    FILES,
    find_files,
    make_episode,
    Options,
    print_signals,
    signal_fields,
    Skipped,
    write_bag,
)
from tap_ros.recording.formats.videos import at_rate
from tap_ros.recording.metadata import natural
from tap_ros.recording.trust import Budget, MOST_BYTES, MOST_FRAMES
from tap_ros.recording.writer import Views

FPS = 10.0  # where nobody says another
_KEPT = 2**20  # bytes of chunks that HDF5 keeps unpacked
_SHARED = 50  # that bytes of rows of any length count: they are not compressed, but may be shared


def run(args: Options) -> None:
    """
    Import, and print what was.

    :raises TapError: for what cannot be read, and a folder that holds something.
    """
    import h5py
    while h5py.h5pl.size():  # a plug-in for an array is code
        h5py.h5pl.remove(0)
    skipped, others, kept = Skipped(), other_cameras(args.camera), dict[str, None]()
    files = find_files(args.paths, ('*.hdf5', '*.h5'), skipped)

    def show(each: Any) -> np.ndarray:
        return args.cut.image(_picture(each))

    def episodes() -> Iterator[tuple[Episode, Views]]:
        numbers = count()
        for file in files:
            with skipped.errors_of('file', place := escaped(file.name)):
                if why := (what_is if file.name.endswith('.zarr.zip') else what_else)(file):
                    raise RecordingError(why)
                with h5py.File(file, 'r') as root:
                    budget, beside = Budget(
                        file.stat().st_size), dict[str, dict[str, Any]]()
                    arrays = dict(_arrays(root, skipped, budget, beside))
                    beside_it = {topic: {_demonstration(name): arrays[name] for name in _chosen(
                        arrays, one.key)} for topic, one in others.items()}
                    for name, number in zip(_chosen(arrays, *args.camera[:1]), numbers):
                        with skipped.errors_of('array', f'{escaped(name)} of {place}'):
                            found = ((row / (args.fps or FPS), each)
                                     for row, each in enumerate(arrays[name]()))
                            frames, times = decoded(at_rate(found, args.rate), show, skipped,
                                                    f'episode {number}')
                            rows = np.rint(times * (args.fps or FPS)).astype(int)
                            own = _demonstration(name)
                            fields = _signals(beside.get(own, {}), rows, budget, skipped)
                            kept.update(dict.fromkeys(fields.get('signal_names', ())))
                            yield make_episode(
                                frames, times, task=args.task, seed=number, **fields), {
                                topic: others[topic].view(
                                    those[own], rows, show, skipped, f'episode {number}')
                                for topic, those in beside_it.items() if own in those}

    print(write_bag(args, episodes(), skipped))
    print_views(others)
    print_signals(kept)


def _chosen(arrays: Collection[str], camera: str = '') -> list[str]:
    """Return the names of the arrays of a camera, each an episode."""
    keys = {name: _camera(name) for name in arrays}
    short = Counter(key.rpartition('/')[2] for key in set(keys.values()))
    called = {name: last if short[last := key.rpartition('/')[2]] == 1 else key
              for name, key in keys.items()}
    cameras = sorted(set(called.values()))
    if not cameras:
        raise ValueError('it holds no array of pictures')
    if camera not in cameras and (camera or len(cameras) > 1):
        raise ConfigError(f'--camera: expected one of {listing(cameras)}')
    return [name for name in sorted(arrays, key=lambda name: natural(Path(name)))
            if called[name] == (camera or cameras[0])]


def _camera(name: str) -> str:
    """Return the path of an array without the groups whose number tells an episode."""
    *groups, last = name.split('/')
    return '/'.join([*(group for group in groups if 'cam' in group or not re.search(
        r'\d$', group)), last])


def _demonstration(name: str) -> str:
    """Return the path of the group whose number tells an episode, '' of a file that is one."""
    groups = name.split('/')[:-1]
    last = max((k for k, group in enumerate(groups, start=1) if 'cam' not in group and re.search(
        r'\d$', group)), default=0)
    return '/'.join([*groups[:last], ''])


def _signals(numbers: Mapping[str, Any], rows: np.ndarray, budget: Budget,
             skipped: Skipped) -> dict[str, Any]:
    """
    Return the fields of an Episode with the numbers beside an array of pictures.

    :param numbers: arrays of numbers of the demonstration by their paths.
    :param rows: (T,), of the pictures that are taken.
    """
    found, left = dict[str, np.ndarray](), MOST_SIGNALS
    for path, array in sorted(numbers.items()):
        width = math.prod(array.shape[1:])
        if len(array) > rows.max() and width <= left:
            with skipped.errors_of(
                    'array', f'{escaped(path)} of {escaped(Path(array.file.filename).name)}'):
                budget.take(array.nbytes)
                found[path.removeprefix(_demonstration(path))] = array[:].reshape(
                    len(array), width)[rows]
                left -= width
    return signal_fields(found)


def _arrays(root: Any, skipped: Skipped, budget: Budget,
            numbers: dict[str, dict[str, Any]],
            ) -> Iterator[tuple[str, Callable[[], Iterable[Any]]]]:
    """Yield paths and readers of the arrays of pictures; note numbers by demonstration."""
    import h5py
    groups, seen, place = [('', root)], set(), escaped(Path(root.filename).name)
    while groups:
        above, group = groups.pop()
        if (address := h5py.h5o.get_info(group.id).addr) in seen:  # groups may hold each other
            continue
        seen.add(address)
        for name in set(group) - {'next_obs'}:  # robomimic's observations once more
            path = above + os.fsdecode(name)
            with skipped.errors_of('array', f'{escaped(path)} of {place}'):
                if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                    continue  # to another file, or what is read anyway
                one = group[name]
                if isinstance(one, h5py.Group):
                    groups.append((f'{path}/', one))
                elif isinstance(one, h5py.Dataset) and _holds_pictures(one, budget):
                    yield path, partial(_read, one, budget)
                elif isinstance(one, h5py.Dataset) and _holds_numbers(one):
                    numbers.setdefault(_demonstration(path), {})[path] = one


def _read(array: Any, budget: Budget) -> Iterable[Any]:
    """Return the rows of an array; of an array of any length one after the other."""
    if array.dtype.kind == 'O':
        return (_row(array, row, budget) for row in range(len(array)))
    if array.nbytes > MOST_BYTES:
        raise RecordingError(f'it has more than {MOST_BYTES >> 30} GiB')
    budget.take(array.nbytes)
    return array[:]


def _row(array: Any, row: int, budget: Budget) -> Any:
    """Return a row; what is unpacked for it counts, as rows may share all that a file holds."""
    chunk = math.prod(array.chunks or ()) * max(array.dtype.itemsize, 16)  # of a reference
    budget.take(chunk if chunk > _KEPT else 0)
    values = array[row]
    budget.take(_SHARED * (getattr(values, 'nbytes', 0) or len(values)))
    return values


def _holds_numbers(array: Any) -> bool:
    """Return whether an array is of some numbers a row, in its own file."""
    shape = tuple(array.shape or ())
    return (array.dtype.kind in 'iufb' and len(shape) in (1, 2) and 0 < len(array) <= MOST_FRAMES
            and 0 < math.prod(shape[1:]) <= MOST_SIGNALS and not array.is_virtual
            and not array.external and array.id.get_storage_size() > 0
            and math.prod(array.chunks or ()) <= MOST_FRAMES * MOST_SIGNALS)


def _holds_pictures(array: Any, budget: Budget) -> bool:
    """
    Return whether an array is of pictures.

    :raises RecordingError: for one whose values are not all in its own file.
    """
    shape, kind = tuple(array.shape or ()), array.dtype.kind
    is_files = len(shape) in (1, 2) and kind in 'uSVO' and 0 not in shape
    if not is_files and not (len(shape) == 4 and kind in 'uif' and 0 not in shape
                             and (shape[1] == 3 or shape[3] in (3, 4))):
        return False
    row_bytes = math.prod(shape[1:]) * array.dtype.itemsize
    if array.is_virtual or array.external:
        raise RecordingError('its values are in other files, which are not read')
    if not array.id.get_storage_size():
        raise RecordingError('its values were never written')
    if len(array) > MOST_FRAMES:
        raise RecordingError(f'it has {len(array)} rows; at most {MOST_FRAMES} are read')
    if row_bytes > 8 * MAX_PICTURE_BYTES or math.prod(
            array.chunks or ()) * array.dtype.itemsize > MOST_BYTES:
        raise RecordingError(f'its pictures have {row_bytes} bytes')
    if not is_files:
        return True
    first = _row(array, 0, budget)
    is_file = isinstance(first, bytes | np.void) or getattr(first, 'dtype', None) == np.uint8
    return is_file and bytes(first).startswith(FILES)


def _picture(values: Any) -> np.ndarray:
    """Return a picture, uint8 (H, W, 3), of a file with zeros behind it, or of pixels."""
    if np.ndim(values) < 2:
        return decompress(bytes(values), 'unknown')
    if values.dtype.kind == 'f':
        if not np.isfinite(values).all():
            raise ValueError('it holds NaN or infinity')
        values = values * 255 if values.max() <= 1 else values
    pixels = np.asarray(values).round().clip(0, 255).astype(np.uint8)
    return pixels[..., :3] if pixels.shape[-1] in (3, 4) else np.moveaxis(pixels, 0, -1)
