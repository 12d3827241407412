# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The metadata.yaml of a bag: written as by rosbag2 of Jazzy (version 9), read in any version."""

from functools import cache
from pathlib import Path
import re

from tap_ros.errors import RecordingError
from tap_ros.files import write_atomically
import yaml

FILE_NAME = 'metadata.yaml'
_KEY = 'rosbag2_bagfile_information'


def bag_information(files):
    """
    Describe a bag.

    :param files: list of dicts, one a file in playing order: path (name within the bag),
        start and end (ns), message_count, topics (topic -> dict of type, qos, type_hash, count).
    :return: what stands in metadata.yaml, without its outermost key.
    """
    filled = [f for f in files if f['message_count']] or [{'start': 0, 'end': 0}]
    start, end = min(f['start'] for f in filled), max(f['end'] for f in filled)
    topics = {}
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


def to_yaml(value):
    """Return a value as the YAML text that rosbag2 would write."""
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, default_flow_style=False)


def _from_yaml(text):
    return yaml.load(text, Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader))


class _Dumper(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):
    """Writes equal values in full; rosbag2 knows no anchors."""

    def ignore_aliases(self, data):
        return True


def save(folder, files):
    """
    Write metadata.yaml atomically.

    :param folder: of the bag.
    :param files: as in bag_information.
    """
    write_atomically(Path(folder, FILE_NAME), to_yaml({_KEY: bag_information(files)}))


def files_by_number(folder):
    """Return the .mcap files of a folder in the order of the numbers in their names."""
    return sorted(Path(folder).glob('*.mcap'), key=_natural)


def bag_files(folder):
    """
    Return the .mcap files of a bag in playing order.

    Without a metadata.yaml (a recorder that was killed), in the order of the numbers in the names.

    :param folder: of the bag.
    :return: list of paths; empty when there is no .mcap file.
    :raises RecordingError: for a bag of another storage or compressed by rosbag2 as a whole.
    """
    folder = Path(folder)
    path = folder / FILE_NAME
    if not path.exists():
        return files_by_number(folder)
    try:
        information = _from_yaml(path.read_text())[_KEY]
        storage = information['storage_identifier']
        names = information['relative_file_paths']
        compression = information.get('compression_format') or ''
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(
            f'{path}: not the metadata of a rosbag2 bag ({error}); remove it to read the .mcap '
            'files without it, or make it anew (ros2 bag reindex)') from error
    if storage != 'mcap':
        raise RecordingError(
            f'{path}: the bag is stored as {storage}; only mcap is read '
            '(record with -s mcap, or ros2 bag convert)')
    if compression:
        raise RecordingError(
            f'{path}: the bag is compressed by rosbag2 ({compression}); use the compression '
            'inside mcap instead (--storage-preset-profile zstd_fast, or ros2 bag convert)')
    files = [folder / Path(name).name for name in names]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise RecordingError(
            f'{path} names files that are not there: {", ".join(missing)}; bring them back, or '
            'make metadata.yaml anew (ros2 bag reindex)')
    return files


@cache
def qos_from_text(text):
    """Return the offered QoS profiles that stand in a channel's metadata; [] when unknown."""
    try:
        profiles = _from_yaml(text) if text else []
    except yaml.YAMLError:
        return []
    return profiles if isinstance(profiles, list) else []


def _natural(path):
    """Sort push2_10 behind push2_2."""
    return [int(p) if p.isdigit() else p for p in re.split(r'(\d+)', path.name)]
