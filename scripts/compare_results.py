# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Tell whether this checkout makes the same recordings, weights, scores and plans as another commit.

    python scripts/compare_results.py COMMIT

The same commands run with the same seeds in both, bit for bit is compared, and this checkout's are
run by both engines. Times, machines and versions are left out of the comparison. A few minutes on
two cores. The exit code is 1 when anything differs.
"""

import hashlib
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile

from geometry_msgs.msg import TwistStamped
from mcap.reader import make_reader
import numpy as np
from rclpy.serialization import deserialize_message
from safetensors.numpy import load_file
from tqdm import tqdm
import tyro

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = 'bags/sample_push2'
QUICK = ['--steps', '3', '--batch-size', '4', '--test-fraction', '0.3', '--threads', '1',
         '--device', 'cpu', '--recordings', SAMPLE]
SMALL = [*QUICK, '--precision', 'float32', '--base-width', '4', '--new-pixels',
         '--min-crop', '0.8']
PLANNING = ['evaluate', 'planning', '--tasks', 'push2', '--scenes', '1', '--jobs', '2',
            '--step-budget', '12', '--plan-samples', '32', '--plan-iterations', '2',
            '--recordings', '{out}/recordings',
            '--methods', 'nothing', 'direct', 'true_subgoal', 'shipped', 'shipped:carried']
COMMANDS = {
    **{f'collect {task}': ['collect', '--task', task, '--episodes', '2', '--workers', '2']
       for task in ('push2', 'push3', 'grasp', 'pick_place')},
    **{f'train {method} {mode}': ['train', *SMALL, '--mode', mode, '--method', method]
       for mode, method in (('bidirectional', 'fix'), ('bidirectional', 'genmin-wo-gan+relative'),
                            ('bidirectional', 'genmin-vae-gan'), ('forward', 'genmin2'))},
    'train the forward model': ['train', '--model', 'forward', *QUICK],
    'score push2': ['evaluate', 'prediction', '--weights', 'push2', '--recordings', SAMPLE,
                    '--all'],
    'score the forward model': ['evaluate', 'forward', '--recordings', SAMPLE,
                                '--test-fraction', '1'],
    'plan': PLANNING}
ENGINES = ('collect push2', 'plan')  # those that run a list of tasks
# Keys of JSON files that say how, where and how fast; what came of it stands beside them.
LEFT_OUT = ('seconds', '_ms', 'machine', 'commit', 'version', 'command', 'settings', 'precision')
SETTINGS = 'config.json'  # has those that only one of the commits knows
PLACES = ('out', 'recordings')


def run(checkout, arguments, out, *options):
    """Run a command of tap_ros from a checkout; return the hash of what it wrote."""
    env = {**os.environ, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': str(checkout)}
    arguments = [word.replace('{out}', str(out)) for word in arguments]
    done = subprocess.run(
        [sys.executable, '-m', 'tap_ros', *arguments, '--out', str(out), *options], cwd=checkout,
        env=env, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f'{checkout}: tap_ros {" ".join(arguments)}: exit code '
                         f'{done.returncode}\n{done.stdout[-1000:]}{done.stderr[-2000:]}')
    return digest(out)


def digest(out):
    """Return a short hash of what a folder holds, files that say how long it took aside."""
    parts = hashlib.sha256()
    for path in sorted(Path(out).rglob('*')):
        if path.suffix == '.mcap':
            with path.open('rb') as file:
                for _, channel, message in make_reader(file).iter_messages():
                    data = message.data
                    if channel.topic.endswith('twist_cmds'):
                        linear = deserialize_message(data, TwistStamped).twist.linear
                        # 0.0 and -0.0 are the same command
                        data = np.array([linear.x, linear.y, linear.z]) + 0.0
                    parts.update(f'{channel.topic} {message.log_time}'.encode() + bytes(data))
        elif path.suffix == '.safetensors':
            for name, tensor in sorted(load_file(path).items()):
                parts.update(name.encode() + tensor.tobytes())
        elif path.suffix == '.json' and path.name != SETTINGS:
            parts.update(json.dumps(kept(json.loads(path.read_text())), sort_keys=True).encode())
        else:
            continue
        parts.update(path.name.encode())
    return parts.hexdigest()[:16]


def kept(value):
    """Return what is compared of a JSON value."""
    if isinstance(value, dict):
        return {key: kept(item) for key, item in value.items()
                if key not in PLACES and not any(word in key for word in LEFT_OUT)}
    if isinstance(value, list):
        return [kept(item) for item in value
                if not (isinstance(item, dict) and item.get('metric') == 'plan_ms')]
    return value


def main(commit: tyro.conf.Positional[str], only: str = ''):
    """
    Compare results with those of another commit; exit with 1 when anything differs.

    :param commit: what to compare with, as git names it.
    :param only: only commands whose names hold this word.
    """
    chosen = {name: command for name, command in COMMANDS.items() if only in name}
    rows, differ = [], False
    with tempfile.TemporaryDirectory(prefix='compare-') as folder:
        before = Path(folder) / 'before'
        subprocess.run(['git', 'worktree', 'add', '--quiet', '--detach', str(before), commit],
                       cwd=ROOT, check=True)
        try:
            for at, (name, command) in enumerate(tqdm(chosen.items(), unit='')):
                found = [run(before, command, f'{folder}/there/{at}'),
                         run(ROOT, command, f'{folder}/here/{at}')]
                if name in ENGINES:
                    found.append(run(ROOT, command, f'{folder}/ray/{at}', '--engine', 'ray'))
                same = len(set(found)) == 1
                differ |= not same
                rows.append(f'{"same" if same else "DIFFERENT":<10} {name:<40} {" ".join(found)}')
        finally:
            subprocess.run(['git', 'worktree', 'remove', '--force', str(before)], cwd=ROOT)
    print(f'Compared with {commit}; hashes: there, here, here with --engine ray', *rows,
          sep='\n')
    raise SystemExit(1 if differ else 0)


if __name__ == '__main__':
    tyro.cli(main)
