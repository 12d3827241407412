# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Import pictures that stand as arrays in HDF5 files (ALOHA, robomimic) or zarr stores.

An array of pictures is (N, H, W, 3 or 4), (N, 3, H, W), or of N JPEG or PNG files, whose bytes may
be padded. Its last name is the camera, or all names where several end alike, as base_camera/rgb
and hand_camera/rgb; arrays of one camera in several groups with a number, such as data/demo_7/obs,
are an episode each, and so is each file. meta/episode_ends, as of diffusion policy, cuts an array
into episodes.
"""

from collections import Counter
from collections.abc import Iterator
from itertools import count
from pathlib import Path
import re
from typing import Any

import numpy as np
from tap_ros.errors import ConfigError, RecordingError
from tap_ros.images.encodings import decompress
from tap_ros.recording.episode import Episode
from tap_ros.recording.file_bytes import what_else
from tap_ros.recording.formats.pictures import (
    decoded,
    Lacking,
    make_episode,
    Options,
    write_bag,
)
from tap_ros.recording.metadata import natural
from tap_ros.text import escaped, listing

FPS = 10.0  # where nobody says another


def run(args: Options) -> None:
    """
    Import, and print what was.

    :raises TapError: for what cannot be read, and a folder that holds something.
    """
    files = [file for path in map(Path, args.paths) for file in (
        sorted((file for file in path.rglob('*') if file.suffix in ('.hdf5', '.h5')), key=natural)
        or [path])]
    lacking = Lacking()

    def episodes() -> Iterator[Episode]:
        numbers = count()
        for file in files:
            with lacking.passing_over('file', escaped(file.name)):
                for pictures, number in zip(_episodes(_open(file), args.camera), numbers):
                    with lacking.passing_over('episode', str(number)):
                        frames, rows = decoded(pictures, lambda each: args.cut.image(_picture(
                            each)), lacking, f'episode {number}')
                        yield make_episode(
                            frames, rows / (args.fps or FPS), task=args.task, seed=number)

    print(write_bag(args, episodes(), lacking=lacking))


def _open(path: Path) -> Any:
    """Open a file or store: a tree of groups, which act as dicts, and arrays."""
    name = 'zarr' if path.is_dir() or path.suffix == '.zip' else 'h5py'
    if name == 'h5py' and (why := what_else(path)):
        raise RecordingError(why)
    try:
        if name == 'zarr':
            import zarr  # type: ignore[import-not-found]
            return zarr.open(str(path), mode='r')
        import h5py  # type: ignore[import-not-found]
        return h5py.File(path, 'r')
    except ImportError as error:
        raise ConfigError(f'{name} is not installed; type `pip install {name}`') from error


def _episodes(root: Any, camera: str) -> Iterator[Any]:
    """Yield the arrays of pictures of each episode of a camera."""
    arrays = dict(_arrays(root))
    found = {name: array for name, array in arrays.items() if _holds_pictures(array)}
    keys = {name: _camera(name) for name in found}
    short = Counter(key.rpartition('/')[2] for key in set(keys.values()))
    called = {name: last if short[last := key.rpartition('/')[2]] == 1 else key
              for name, key in keys.items()}
    cameras = sorted(set(called.values()))
    if not cameras:
        raise ValueError('it holds no array of pictures')
    if camera not in cameras and (camera or len(cameras) > 1):
        raise ConfigError(f'--camera: expected one of {listing(cameras)}')
    chosen = camera or cameras[0]
    ends = arrays.get('meta/episode_ends')
    for name in sorted(found, key=lambda name: natural(Path(name))):
        if called[name] == chosen:
            cuts = [0, *(np.asarray(ends[:]).tolist() if ends is not None else [len(found[name])])]
            for begin, end in zip(cuts, cuts[1:]):
                yield found[name][begin:end]


def _camera(name: str) -> str:
    """Return the path of an array without the groups whose number tells an episode."""
    *groups, last = name.split('/')
    return '/'.join([*(group for group in groups if 'cam' in group or not re.search(
        r'\d$', group)), last])


def _arrays(group: Any, above: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the arrays below a group, with their paths."""
    for name in set(group) - {'next_obs'}:  # robomimic's observations once more
        if hasattr(group[name], 'dtype'):
            yield above + name, group[name]
        else:
            yield from _arrays(group[name], f'{above}{name}/')


def _holds_pictures(array: Any) -> bool:
    """Tell whether an array is of pictures."""
    if len(array.shape) in (1, 2) and array.dtype.kind in 'uSVO' and len(array):
        first = array[0]
        is_file = isinstance(first, bytes | np.void) or getattr(first, 'dtype', None) == np.uint8
        return is_file and bytes(first).startswith((b'\xff\xd8\xff', b'\x89PNG'))
    return len(array.shape) == 4 and (array.shape[1] == 3 or array.shape[3] in (3, 4))


def _picture(values: Any) -> np.ndarray:
    """Return a picture, uint8 (H, W, 3), of a file with zeros behind it, or of pixels."""
    if np.ndim(values) < 2:
        return decompress(bytes(values), 'unknown')
    if values.dtype.kind == 'f' and values.max() <= 1:
        values = values * 255
    pixels = np.asarray(values).round().clip(0, 255).astype(np.uint8)
    return pixels[..., :3] if pixels.shape[-1] in (3, 4) else np.moveaxis(pixels, 0, -1)
