# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run the steps of the Dockerfile by chroot, where there is no docker.

    sudo python3 scripts/dockerfile.py ROOT [NAME=VALUE ...]

ROOT is a folder with a system in it that stands for the image of FROM, such as Ubuntu 24.04 of
debootstrap with ROS 2 Jazzy, rosdep, a user `ubuntu`, and /proc and /dev mounted; the variables
that the image would set stand in its /etc/environment. It is changed. NAME=VALUE is what
--build-arg is to docker.
"""

from pathlib import Path
import re
import shlex
import shutil
import subprocess
import sys

CHECKOUT = Path(__file__).resolve().parents[1]


def steps(text):
    """Return the (instruction, rest) of a Dockerfile, lines joined and comments left out."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith('#')]
    joined = re.sub(r'\\\n\s*', ' ', '\n'.join(lines))
    return [line.split(None, 1) for line in joined.splitlines() if line.strip()]


def copy(root, folder, words):
    """Carry out COPY of files, or of all that git tracks, into a folder of ROOT."""
    owner = next((word.split('=')[1] for word in words if word.startswith('--chown=')), 'root')
    *sources, target = [word for word in words if not word.startswith('--')]
    inside = Path(folder, target)
    Path(f'{root}{inside}').mkdir(parents=True, exist_ok=True)
    if sources == ['.']:
        subprocess.run(f'git ls-files -z | tar -c --null -T - | tar -x -C {root}{inside}',
                       shell=True, cwd=CHECKOUT, check=True)
    else:
        for source in sources:
            shutil.copy(CHECKOUT / source, f'{root}{inside}')
    subprocess.run(['chroot', root, 'chown', '-R', f'{owner}', str(inside)], check=True)


def build(root, *arguments):
    """Carry out the Dockerfile in ROOT, with NAME=VALUE in place of its ARG."""
    user, folder, shell = 'root', '/', ['/bin/sh', '-c']
    variables = {'PATH': '/usr/sbin:/usr/bin:/sbin:/bin'} | dict(
        re.findall(r'^(\w+)=(.*)$', Path(root, 'etc', 'environment').read_text(), re.MULTILINE))
    for number, (instruction, rest) in enumerate(steps((CHECKOUT / 'Dockerfile').read_text()), 1):
        print(f'step {number}: {instruction} {rest[:80]}', flush=True)
        if instruction in ('ARG', 'ENV'):
            for word in shlex.split(rest):
                name, _, value = word.partition('=')
                variables[name] = re.sub(r'\$(\w+)', lambda found: variables[found[1]], value)
            variables.update(word.split('=', 1) for word in arguments)
        elif instruction == 'SHELL':
            shell = re.findall('"(.*?)"', rest)
        elif instruction == 'USER':
            user = rest
        elif instruction == 'WORKDIR':
            folder = rest
        elif instruction == 'COPY':
            copy(root, folder, shlex.split(rest))
        elif instruction == 'RUN':
            home = '/root' if user == 'root' else f'/home/{user}'
            there = shlex.join(['cd', folder]) + ' && ' + rest
            subprocess.run(['chroot', f'--userspec={user}', root, '/usr/bin/env', '-i',
                            f'HOME={home}', *(f'{k}={v}' for k, v in variables.items()),
                            *shell, there], check=True)


if __name__ == '__main__':
    if len(sys.argv) < 2 or not Path(sys.argv[1], 'bin').exists():
        sys.exit(__doc__)
    try:
        build(*sys.argv[1:])
    except subprocess.CalledProcessError as error:
        sys.exit(f'error: this step ended with {error.returncode}')
