# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recorder on a full disk."""

import time

from experiments.faults.children import Reader
from experiments.faults.disk import small_disk
from experiments.faults.fault import Fault
from experiments.faults.nodes.rig import outcome
from std_srvs.srv import SetBool
from tap_ros.errors import TapError
from tap_ros.nodes.clients import call


def recorder(job):
    """Record until the disk is full, ask for a new recording, and end the node."""
    rig = job.rig
    rig.need()
    for trial in job.trials():
        size = int(job.random.integers(400_000, 1_200_000))
        with small_disk(job.folder / f'disk{trial}', size) as disk:
            if disk is None:
                raise TapError('no file system may be mounted here; try as root')
            why = _fill(rig, disk, disk / 'bag')
            rig.processes.pop('recorder_node').kill()
            why = why or _unreadable(disk / 'bag')
        job.record(not why, why)


def _fill(rig, disk, bag):
    """Say what is wrong with how the recorder takes a full disk; an empty string if nothing."""
    node = rig.start('recorder_node', folder=bag, compression='none').wait_until_ready()
    with rig.world(30.0):
        deadline = time.monotonic() + 30
        while '[ERROR]' not in node.text and time.monotonic() < deadline:
            time.sleep(0.1)
        if '[ERROR]' not in node.text:
            return 'no error in the log'
        (disk / 'rest').write_bytes(b'')
        _fill_up(disk / 'rest')
        answer, why = outcome(call, rig.record_client, SetBool.Request(data=True), 10.0)
        if why:
            return why
        if answer.success:
            return f'recorder/record says success on a full disk: {answer.message}'
    if not node.alive:
        return f'it ended: {node.last_line()}'
    code = node.end()
    if code == 0:
        return 'exit code 0 though the recording is not whole'
    return 'a traceback' if 'Traceback' in node.text else '' if code else 'it did not end'


def _fill_up(path):
    """Take what room is left."""
    with path.open('wb', buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            pass


def _unreadable(bag):
    """Say why what was recorded cannot be read; an empty string if it can."""
    with Reader() as reader:
        found = reader.read('recording', bag)
    return f'what was recorded cannot be read: {found["error"]}' if found['error'] else ''


FAULTS = [
    Fault('disk-full-recorder', 'the disk is full while recorder_node records', 'A long recording '
          'fills the disk.', 'The log has an error, recorder/record does not say success, what '
          'was recorded can be read, and the exit code is not 0.', 20, 8.0, recorder)]
