# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The process that reads damaged files, so that a crash, a hang or a bomb ends it and not the run.

A line of standard input is a JSON list: what to read, and the file. The line that answers says
what came of it. Whatever the files hold, nothing but such lines is printed.
"""

import hashlib
import json
import sys
import time
import traceback
import warnings


def read_recording(path):
    """Return what a recording holds: for each episode a hash of the whole and of each frame."""
    from tap_ros.recording.reader import iter_episodes
    episodes = []
    for episode in iter_episodes(path):
        whole = hashlib.sha1()
        for field in vars(episode).values():
            whole.update(field.tobytes() if hasattr(field, 'tobytes') else repr(field).encode())
        frames = [hashlib.sha1(frame.tobytes() + stamp.tobytes()).hexdigest()[:12]
                  for frame, stamp in zip(episode.frames, episode.stamps)]
        episodes.append([whole.hexdigest(), frames])
    return episodes


def read_weights(path):
    """Return a hash of what a weights file makes the planner's forward model compute with."""
    from tap_ros.planning.forward_model import LearnedForwardModel
    model = LearnedForwardModel.load(path, precision='float32')
    found = hashlib.sha1(repr(model.config).encode())
    for name, tensor in sorted(model.state_dict().items()):
        found.update(name.encode() + tensor.contiguous().numpy().tobytes())
    return found.hexdigest()


def read_predictor(path):
    """Load the network of a predictor; return what its training says of itself."""
    from tap_ros.prediction.predictor import load_network
    _, training = load_network(path)
    return sorted(training)


READERS = {'recording': read_recording, 'weights': read_weights, 'predictor': read_predictor}


def answer(what, path):
    """Read a file and return what came of it, as a dict that JSON can hold."""
    from tap_ros.errors import TapError
    begin = time.monotonic()
    found = {'content': None, 'error': None, 'kind': None, 'expected': False}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        try:
            found['content'] = READERS[what](path)
        except Exception as error:
            found['error'], found['kind'] = str(error), type(error).__name__
            found['expected'] = isinstance(error, TapError)
            if not found['expected']:
                last = traceback.extract_tb(error.__traceback__)[-1]
                found['kind'] += f' in {last.filename.rsplit("/", 1)[-1]}:{last.lineno}'
    found['warnings'] = [str(warning.message) for warning in caught]
    found['seconds'] = time.monotonic() - begin
    found['peak_mb'] = peak_mb()
    return found


def peak_mb():
    """Return the most memory that this process has held; getrusage would count its parent's."""
    with open('/proc/self/status') as status:
        return next(int(line.split()[1]) for line in status if line.startswith('VmHWM')) / 1024


def main():
    """Answer line by line."""
    out = sys.stdout
    sys.stdout = sys.stderr
    for line in sys.stdin:
        print(json.dumps(answer(*json.loads(line))), file=out, flush=True)


if __name__ == '__main__':
    main()
