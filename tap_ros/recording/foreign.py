# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is given as a recording: MCAP, or something else that is read likewise or explained."""

from pathlib import Path

from tap_ros.recording.mcap_file import McapFile


def recognise(path: Path) -> list[list[Path]] | None:
    """
    Return the bags at a path that are not MCAP: a list of lists of files, in playing order.

    :param path: of a file or folder that exists.
    :return: what open_file reads; None for what may be MCAP.
    :raises RecordingError: for what cannot be read; it says what it is, and a command that helps.
    """
    return None


def open_file(path: str | Path) -> McapFile:
    """
    Open one file of a bag.

    :param path: as find_bags returns it.
    :return: McapFile, or what has its methods topics, counts and messages and its attributes path,
        channels and losses.
    :raises RecordingError: as McapFile.
    """
    return McapFile(path)
