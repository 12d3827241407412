# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Digests of what must not change by accident: bags, trainings, predictions, plans, scores, loops.

    python scripts/golden.py            compare with test/golden.json; exit code 1 if any differs
    python scripts/golden.py --write    put this machine's digests there

Digests are bit for bit, on one thread of one kind of processor. test/golden.json keeps them by
processor and version of torch; on another one nothing is compared.
"""

from dataclasses import dataclass
import hashlib
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile

os.environ['OMP_NUM_THREADS'] = '1'
os.environ.setdefault('MUJOCO_GL', 'egl')
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # experiments/ is not installed

from experiments.bench.everything import processor  # noqa: E402
from experiments.planning.episode import run_episode  # noqa: E402
from experiments.planning.methods import parse_method  # noqa: E402
from mcap.reader import make_reader  # noqa: E402
import numpy as np  # noqa: E402
from safetensors.numpy import load_file  # noqa: E402
from sim_bridge.simulator import Simulator  # noqa: E402
from tap_ros.planning.forward_model import LearnedForwardModel  # noqa: E402
from tap_ros.planning.visual_mpc import Memory, Scene, VisualMPC  # noqa: E402
from tap_ros.prediction.predictor import SubgoalPredictor  # noqa: E402
from tap_ros.recording.cache import open_recordings  # noqa: E402
from tap_ros.training.forward_scores import measure_maps, measure_pictures  # noqa: E402
from tap_ros.weights import FORWARD_MODEL, PREDICTORS  # noqa: E402
import torch  # noqa: E402
import tyro  # noqa: E402

FILE = ROOT / 'test' / 'golden.json'
SAMPLE = ROOT / 'bags' / 'sample_push2'
QUICK = [str(SAMPLE), '--steps', '10', '--batch-size', '4', '--test-fraction', '0.3', '--threads',
         '1', '--device', 'cpu', '--split', 'crc32']
PREDICTOR = ['predictor', *QUICK, '--precision', 'float32', '--base-width', '4', '--start-crop',
             '0', '--progress-margin', '0']
PAPER = [*PREDICTOR, '--decoder', 'separate', '--no-skips']
TRAININGS = {  # options of `train`
    'relative': [*PREDICTOR, '--selection', 'relative', '--start-crop', '0.3'],
    'progress': [*PAPER, '--progress-margin', '0.5', '--new-pixels', '--goal-picture', 'last'],
    'vae-gan': [*PAPER, '--selection', 'absolute', '--gan', '--latent', 'vae', '--new-pixels',
                '--min-crop', '0.8'],
    'fix': [*PAPER, '--loss', 'fix'],
    'forward prediction': [*PAPER, '--selection', 'absolute', '--beta', '2', '--mode', 'forward'],
    'forward model': ['forward', *QUICK]}
TASKS = {'push2': 2, 'order3': 1, 'grasp': 2, 'pick_place': 1, 'stack2': 1}  # episodes of each


def digest(*parts):
    """Return a short hash of arrays and texts."""
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, str | bytes):
            found.update(part.encode() if isinstance(part, str) else part)
        else:
            part = np.ascontiguousarray(part)
            found.update(f'{part.dtype} {part.shape}'.encode() + part.tobytes())
    return found.hexdigest()[:16]


def command(arguments):
    """Run `python -m tap_ros` in this checkout."""
    path = os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run([sys.executable, '-m', 'tap_ros', *arguments], cwd=ROOT,
                          env=os.environ | {'PYTHONPATH': path}, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f'tap_ros {" ".join(arguments)}: exit code {done.returncode}\n'
                         f'{done.stdout[-1000:]}{done.stderr[-2000:]}')


def recordings():
    """Read the sample recording."""
    yield 'read push2', digest(*(
        part for episode in open_recordings([str(SAMPLE)], progress=False) for part in (
            episode.frames, episode.stamps, episode.actions, episode.grippers,
            episode.object_pixels, episode.object_poses, episode.goal_frame,
            episode.goal_pixels)))


def predictions():
    """Predict with all shipped weights."""
    episode = open_recordings([str(SAMPLE)], progress=False)[0]
    start, goal = episode.frames[0], episode.frames[-1]
    pixels = episode.object_pixels[0], episode.object_pixels[-1]
    for name in sorted(PREDICTORS):
        predictor = SubgoalPredictor.load(name)
        forward = predictor.mode == 'forward'
        found = predictor.predict(start, None if forward else goal, pixels[0],
                                  None if forward else pixels[1], num_samples=2,
                                  recursion_depth=1 if forward else 2, seed=3)
        yield f'predict {name}', digest(*(
            part for subgoal in found for part in (subgoal.image, subgoal.object_maps)))


def plans():
    """Plan three actions after one another, to pixels and to maps."""
    episode = open_recordings([str(SAMPLE)], progress=False)[0]
    mpc = VisualMPC.load(FORWARD_MODEL)
    subgoal, = SubgoalPredictor.load('push2').predict(
        episode.frames[0], episode.frames[-1], episode.object_pixels[0], episode.goal_pixels)
    for name, goal in (('pixels', mpc.goal(episode.goal_pixels)),
                       ('maps', mpc.goal(maps=subgoal.object_maps))):
        memory, parts = Memory(5), []
        for t in range(3):
            scene = Scene(episode.frames[t], episode.grippers[t], episode.object_pixels[t])
            plan = mpc.plan(scene, goal, memory)
            memory = plan.memory
            parts += [plan.actions, plan.elites, np.array([plan.cost, plan.expected_distance])]
        yield f'plan to {name}', digest(*parts)


def loops():
    """Push twelve steps in the simulator, directly and via a predicted subgoal."""
    mpc, predictor = VisualMPC.load(FORWARD_MODEL), SubgoalPredictor.load('push2')
    simulator = Simulator('push2', 64)
    try:
        for text in ('direct', 'shipped'):
            run = run_episode(simulator, mpc, parse_method(text), 12, 1_000_003, predictor)
            yield f'loop {text}', digest(run.actions, run.distances, *run.frames)
    finally:
        simulator.close()


def scores():
    """Score the shipped forward model in the sample, by its maps and by its pictures."""
    episodes = open_recordings([str(SAMPLE)], progress=False)
    model, some = LearnedForwardModel.load(FORWARD_MODEL), np.arange(6)
    for measure in (measure_maps, measure_pictures):
        yield f'score {measure.__name__}', digest(*(
            values for _, measured in sorted(measure(model, episodes, some).items())
            for values in measured.values()))


def collections(folder):
    """Collect episodes; a digest for each topic, so that a change can be told by its place."""
    for task, episodes in TASKS.items():
        out = Path(folder, task)
        command(['collect', '--task', task, '--episodes', str(episodes), '--workers', '1',
                 '--out', str(out)])
        parts = {}
        for path in sorted(out.rglob('*.mcap')):
            with path.open('rb') as file:
                for _, channel, message in make_reader(file).iter_messages():
                    parts.setdefault(channel.topic, []).append(
                        f'{message.log_time} {message.publish_time} '.encode() + message.data)
        for topic, found in sorted(parts.items()):
            yield f'collect {task} {topic}', digest(*found)


def trainings(folder):
    """Train ten steps of each kind."""
    for name, options in TRAININGS.items():
        out = Path(folder, name.replace(' ', '_'))
        command(['train', *options, '--out', str(out)])
        file, = (path for path in out.glob('*.safetensors') if 'checkpoint' not in path.name)
        state = load_file(file)
        yield f'train {name}', digest(*(part for key in sorted(state) for part in
                                        (key, state[key])))


def machine():
    """Return what digests depend on beside the code: the processor, torch."""
    return f'{processor()} torch {torch.__version__.split("+")[0]}'


def make():
    """Return {what: digest}."""
    found = {}
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix='golden-') as folder:
        os.environ['TAP_ROS_CACHE'] = str(Path(folder, 'cache'))
        for part in (recordings(), predictions(), plans(), loops(), scores(),
                     collections(Path(folder, 'bags')), trainings(Path(folder, 'runs'))):
            for name, value in part:
                print(f'{value}  {name}', flush=True)
                found[name] = value
    return found


@dataclass
class Options:
    """
    Options of the command.

    :param write: keep the digests in test/golden.json.
    """

    write: tyro.conf.FlagCreatePairsOff[bool] = False


def main(options):
    """Compare or write; return the exit code."""
    known = json.loads(FILE.read_text()) if FILE.exists() else {}
    found, name = make(), machine()
    if options.write:
        FILE.write_text(json.dumps({**known, name: found}, indent=1, sort_keys=True) + '\n')
        return 0
    if name not in known:
        print(f'{name}: no digests are known; write them with --write on a commit to compare with')
        return 2
    before = known[name]
    differ = [what for what in before if before[what] != found.get(what)]
    print('\n'.join([f'not known here: {what}' for what in found if what not in before]
                    + [f'DIFFERENT: {what}' for what in differ] or ['all as before']))
    return 1 if differ else 0


if __name__ == '__main__':
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
