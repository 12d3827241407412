# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes that are started and ended at any moment: exit code 0, no traceback, no hang."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
import shutil
import signal
import time

from experiments.faults.children import describe_exit
from experiments.faults.fault import Fault
from experiments.faults.nodes.attacked import Attacked
import numpy as np

END_S = 10.0
SIDE_BY_SIDE = 2
EARLY = 'ended by Python itself, while it imported'
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def start_stop(job, name):
    """
    Start a node, and end it during its start or after it.

    Before Python has run the first line of the node a signal ends the interpreter by itself; that
    is no fault of the node, and counts as held when it left no traceback.
    """
    random = np.random.default_rng(0)
    usual_s = _seconds_to_start(job.folder, name)
    trials = [(trial, random.uniform(0, 1.2 * usual_s), random.uniform(0, 0.5) * (trial % 3 > 0))
              for trial in job.trials()]
    with ThreadPoolExecutor(SIDE_BY_SIDE) as pool:
        early = 0
        for why, seconds in pool.map(lambda trial: _one(job.folder, name, *trial), trials):
            early += why == EARLY
            job.record(why in ('', EARLY), why, seconds)
    job.note = f'{early} times {EARLY}'


def _seconds_to_start(folder, name):
    """Return how long a start takes, two at a time as in the trials."""
    begin = time.monotonic()
    nodes = [
        Attacked(name, folder / f'usual{number}.log', _parameters(folder, name, number)).start()
        for number in range(SIDE_BY_SIDE)]
    try:
        for node in nodes:
            node.wait_until_ready()
        return time.monotonic() - begin
    finally:
        for node in nodes:
            node.kill()


def _parameters(folder, name, number):
    return {'folder': folder / f'bag{number}'} if name == 'recorder_node' else {}


def _one(folder, name, trial, early_s, late_s):
    """Start and end a node once; return what was wrong, and the seconds that it took to end."""
    parameters = _parameters(folder, name, trial)
    node = Attacked(name, folder / f'{trial}.log', parameters).start()
    if trial % 2:
        time.sleep(early_s)
    else:
        node.wait_until_ready()
        time.sleep(late_s)
    began = '[INFO]' in node.text
    number = SIGNALS[trial // 2 % len(SIGNALS)]
    asked = time.monotonic()
    code = node.end(number, END_S)
    seconds = time.monotonic() - asked
    for bag in parameters.values():
        shutil.rmtree(bag, ignore_errors=True)
    if code is None:
        return f'did not end within {END_S:g} s of {number.name}', seconds
    if not began and ', in run_node' not in node.text and (
            code == -number or 'KeyboardInterrupt' in node.text):
        return EARLY, seconds
    if 'Traceback' in node.text:
        return f'a traceback after {number.name}: {node.last_line()}', seconds
    if code != 0:
        return f'{describe_exit(code)} after {number.name}: {node.last_line()}', seconds
    return '', seconds


FAULTS = [
    Fault(f'start-stop-{name.removesuffix("_node").replace("visual_mpc", "planner")}',
          f'{name} is started and ended at any moment', 'A launch file is interrupted, or a '
          'supervisor restarts a node.', f'It ends within {END_S:g} s, with exit code 0 and '
          'without a traceback; while Python imports, the signal may end Python itself.', 200,
          seconds, partial(start_stop, name=name), 'until it had ended', 's')
    for name, seconds in (('sim_node', 2.0), ('predictor_node', 2.0), ('visual_mpc_node', 2.2),
                          ('recorder_node', 1.5))]
