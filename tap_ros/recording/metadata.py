# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What stands beside the .mcap files of a bag: metadata.yaml, and where the recorded arm stood.

metadata.yaml is written as by rosbag2 of Jazzy (version 9), and read in any version.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
import json
from math import isfinite
from pathlib import Path
import re
from typing import Any

from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.base.files import write_atomically
from tap_ros.base.text import escaped, listing
from tap_ros.recording.trust import parse_json, read_bytes
from tap_ros.robots.arm import DEFAULT_ARM, get_arm, Mount
import yaml

FILE_NAME, MOUNT_NAME = 'metadata.yaml', 'arm_mount.json'
PACKED = '.zstd', '.zst'  # behind the name of a file that was compressed as a whole
MAX_BYTES = 2**23  # of metadata.yaml
DEEPEST = 50  # levels of it; rosbag2 writes 8
LONGEST = 2**16  # characters of a word without quotes
_UNUSABLE = (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, OverflowError)
_KEY = 'rosbag2_bagfile_information'


def bag_information(files: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """
    Describe a bag.

    :param files: list of dicts, one a file in playing order: path (name within the bag),
        start and end (ns), message_count, topics (topic -> dict of type, qos, type_hash, count).
    :return: what stands in metadata.yaml, without its outermost key.
    """
    filled = [f for f in files if f['message_count']] or [{'start': 0, 'end': 0}]
    start, end = min(f['start'] for f in filled), max(f['end'] for f in filled)
    topics: dict[str, dict[str, Any]] = {}
    for file in files:
        for topic, info in file['topics'].items():
            merged = topics.setdefault(topic, {**info, 'count': 0})
            merged['count'] += info['count']
    return {
        'version': 9,
        'storage_identifier': 'mcap',
        'duration': {'nanoseconds': end - start},
        'starting_time': {'nanoseconds_since_epoch': start},
        'message_count': sum(f['message_count'] for f in files),
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic, 'type': info['type'], 'serialization_format': 'cdr',
                    'offered_qos_profiles': info['qos'],
                    'type_description_hash': info['type_hash']},
                'message_count': info['count'],
            } for topic, info in sorted(topics.items())],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [f['path'] for f in files],
        'files': [
            {
                'path': f['path'],
                'starting_time': {'nanoseconds_since_epoch': f['start']},
                'duration': {'nanoseconds': f['end'] - f['start']},
                'message_count': f['message_count'],
            } for f in files],
        'custom_data': None,
        'ros_distro': 'jazzy',
    }


class _Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
    """Takes no `<<`, which can make a short text endless."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Leave `<<` as it is; it is no key then."""


def from_yaml(text: str | bytes) -> Any:
    """Return a value; raise ValueError for one so deep that libyaml would end the process."""
    depth = 0
    for event in yaml.parse(text, _Loader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise ValueError(f'it is more than {DEEPEST} levels deep')
        if isinstance(event, yaml.ScalarEvent) and not event.style and len(event.value) > LONGEST:
            raise ValueError(f'it has a word of {len(event.value)} letters')  # 1:1:1... takes days
    return yaml.load(text, _Loader)


def to_yaml(value: Any) -> str:
    """Return a value as the YAML text that rosbag2 would write."""
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, default_flow_style=False)


class _Dumper(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):  # type: ignore[misc]
    """Writes equal values in full; rosbag2 knows no anchors."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def save(folder: str | Path, files: Sequence[dict[str, Any]]) -> None:
    """
    Write metadata.yaml atomically.

    :param folder: of the bag.
    :param files: as in bag_information.
    """
    write_atomically(Path(folder, FILE_NAME), to_yaml({_KEY: bag_information(files)}))


def natural(path: Path) -> list[int | str]:
    """Return what sorts part_10 behind part_2."""
    return [int(part) if part.isdecimal() else part for part in re.split(r'(\d+)', str(path))]


def files_by_number(folder: str | Path, ending: str = '.mcap') -> list[Path]:
    """Return the files of a storage in a folder in the order of the numbers in their names."""
    found = {path.stem if path.suffix in PACKED else path.name: path
             for end in (*PACKED, '') for path in Path(folder).glob(f'*{ending}{end}')}
    return sorted(found.values(), key=natural)


def bag_files(folder: str | Path) -> list[Path]:
    """
    Return the .mcap files of a bag in playing order.

    Without a metadata.yaml (a recorder that was killed), in the order of the numbers in the names.

    :param folder: of the bag.
    :return: list of paths; empty when there is no .mcap file.
    :raises RecordingError: for a bag of another storage, and for a metadata.yaml that cannot be
        used.
    """
    folder = Path(folder)
    path = folder / FILE_NAME
    if not path.exists():
        return files_by_number(folder)
    if not path.is_file():  # opening a FIFO would wait for its writer
        raise RecordingError(f'{path}: not a regular file')
    try:
        with open(path, 'rb') as stream:
            information = from_yaml(stream.read(MAX_BYTES))[_KEY]
        storage, paths = information['storage_identifier'], information['relative_file_paths']
        if not isinstance(paths, list) or not all(isinstance(name, str) for name in paths):
            raise ValueError('relative_file_paths is no list of names')
        if not isinstance(storage, str):  # what is no text may be endless as text
            raise ValueError('storage_identifier is no name')
        if len(set(paths)) < len(paths):
            raise ValueError('relative_file_paths names a file twice')
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error
    except _UNUSABLE as error:
        raise RecordingError(
            f'{path}: not the metadata of a rosbag2 bag ({escaped(" ".join(str(error).split()))});'
            ' remove it to read the .mcap files without it, or make it anew (ros2 bag reindex)'
        ) from error
    if storage not in ('mcap', 'sqlite3'):
        raise RecordingError(
            f'{path}: the bag is stored as {escaped(storage, 40)}; mcap and sqlite3 are read; '
            'make one of these with ros2 bag convert where its storage is installed')
    files = [folder / Path(name).name for name in paths]
    files = [file if _is_file(file) else file.with_suffix('') if file.suffix in PACKED else file
             for file in files]  # some were unpacked since
    missing = [file.name for file in files if not _is_file(file)]
    if missing:
        raise RecordingError(
            f'{path} names files that are not there: {listing(missing)}; bring them back, or '
            'make metadata.yaml anew (ros2 bag reindex)')
    return files


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False


@dataclass(frozen=True)
class ArmMount:
    """
    The contents of arm_mount.json, which need not be there.

    A driver's joint states hold angles; where the gripper was follows from them and from this.

    :param mount: where the arm stood.
    :param opening: of the gripper, 0 to 1, where no joint states tell it.
    :param arm: its name.
    """

    mount: Mount = get_arm(DEFAULT_ARM).mount
    opening: float = 0.0
    arm: str = DEFAULT_ARM


def write_mount(folder: str | Path, found: ArmMount) -> None:
    """
    Write arm_mount.json into the folder of a bag.

    :raises StorageError: when it cannot be written.
    """
    values = {**asdict(found.mount), 'opening': found.opening, 'arm': found.arm}
    write_atomically(Path(folder) / MOUNT_NAME, (json.dumps(values, indent=2) + '\n').encode())


def read_mount(folder: str | Path) -> ArmMount:
    """
    Read arm_mount.json of a bag; without it, return where the simulator's arm stands.

    :raises RecordingError: when the file cannot be used.
    """
    path = Path(folder) / MOUNT_NAME
    if not path.exists():
        return ArmMount()
    expected = {**asdict(ArmMount().mount), 'opening': 0.0, 'arm': DEFAULT_ARM}
    try:
        values = {'arm': DEFAULT_ARM} | parse_json(
            read_bytes(path, MAX_BYTES))  # earlier ones lack it
        x, y, z = map(float, values['position'])
        yaw, tool, opening = (float(values[name]) for name in ('yaw', 'tool', 'opening'))
        if not isfinite(x + y + z + yaw + tool + opening):
            raise ValueError('it holds infinity or NaN')
        return ArmMount(Mount((x, y, z), yaw, tool), opening, get_arm(values['arm']).name)
    except (ConfigError, RecordingError, OSError, LookupError, ValueError, TypeError,
            OverflowError) as error:
        raise RecordingError(f'{path}: cannot be used ({escaped(error)}); expected values such as '
                             f'{json.dumps(expected)}') from error
