# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Make the CMake files of the ROS 2 wheels fit this virtual environment.

The CMake targets that the wheels export name two folders of the machine that built the wheels:
the include folder of its Python and that of its numpy. CMake stops at folders that do not exist,
so they are replaced by those of the interpreter that runs this script. ROS 2 from apt names the
right folders and never needs this.
"""

from pathlib import Path
import re
import sys
import sysconfig

import numpy

BUILDER = r'/opt/python/cp\d+-cp\d+'
PYTHON_INCLUDE = re.compile(BUILDER + r'/include/python3\.\d+')
NUMPY_INCLUDE = re.compile(BUILDER + r'/lib/python3\.\d+/site-packages/numpy/(_core|core)/include')


def mend(text, python_include, numpy_include):
    """
    Replace the builder's include folders in the text of a CMake file.

    :param text: the text of the file.
    :param python_include: folder of Python.h here.
    :param numpy_include: folder of numpy/arrayobject.h here.
    :returns: the text with this machine's folders.
    """
    text = NUMPY_INCLUDE.sub(lambda _: numpy_include, text)
    return PYTHON_INCLUDE.sub(lambda _: python_include, text)


def main():
    """Mend every CMake file below the environment's share folder, and say how many changed."""
    changed = 0
    for path in sorted(Path(sys.prefix).glob('share/*/cmake/*.cmake')):
        old = path.read_text()
        new = mend(old, sysconfig.get_path('include'), numpy.get_include())
        if new != old:
            path.write_text(new)
            changed += 1
    print(f'mend_wheels: {changed} CMake files now name the folders of this machine')


if __name__ == '__main__':
    main()
