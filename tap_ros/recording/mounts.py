# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the arm of a recording stood, in a file beside it.

A driver's joint states hold angles; where the gripper was follows from them and from this.
"""

from dataclasses import asdict, dataclass
import json
from math import isfinite
from pathlib import Path

from tap_ros.errors import RecordingError
from tap_ros.files import write_atomically
from tap_ros.plugins import names
from tap_ros.robots.arm import DEFAULT_ARM, get_arm, Mount

FILE_NAME = 'arm_mount.json'
_MAX_BYTES = 2**16


@dataclass(frozen=True)
class ArmMount:
    """
    The contents of the file, which need not be there.

    :param mount: where the arm stood.
    :param opening: of the gripper, 0 to 1, where no joint states tell it.
    :param arm: its name.
    """

    mount: Mount = get_arm(DEFAULT_ARM).mount
    opening: float = 0.0
    arm: str = DEFAULT_ARM


def write_mount(folder: str | Path, found: ArmMount) -> None:
    """
    Write the file of a bag.

    :raises StorageError: when it cannot be written.
    """
    values = {**asdict(found.mount), 'opening': found.opening, 'arm': found.arm}
    write_atomically(Path(folder) / FILE_NAME, (json.dumps(values, indent=2) + '\n').encode())


def read_mount(folder: str | Path) -> ArmMount:
    """
    Read the file of a bag; without it, where the simulator's arm stands.

    :raises RecordingError: when the file cannot be used.
    """
    path = Path(folder) / FILE_NAME
    if not path.exists():
        return ArmMount()
    expected = {**asdict(ArmMount().mount), 'opening': 0.0, 'arm': DEFAULT_ARM}
    try:
        if not path.is_file() or path.stat().st_size > _MAX_BYTES:
            raise ValueError('no regular file, or too long')
        values = {'arm': DEFAULT_ARM} | json.loads(path.read_bytes())  # earlier ones lack it
        if set(values) != set(expected) or len(values['position']) != 3:
            raise ValueError('its fields are others')
        if values['arm'] not in names('tap_ros.arms'):
            raise ValueError('it names an arm that is not known')
        x, y, z = map(float, values['position'])
        yaw, tool, opening = (float(values[name]) for name in ('yaw', 'tool', 'opening'))
        if not all(map(isfinite, (x, y, z, yaw, tool, opening))):
            raise ValueError('it holds infinity or NaN')
    except (OSError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise RecordingError(f'{path}: cannot be used ({error}); expected values such as '
                             f'{json.dumps(expected)}') from error
    return ArmMount(Mount((x, y, z), yaw, tool), opening, values['arm'])
