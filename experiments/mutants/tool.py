# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""mutmut, asked for some of its mutants; what it found stays in mutants/ for the next run."""

from dataclasses import dataclass
from importlib.metadata import version
from itertools import accumulate
from pathlib import Path
import subprocess
import sys

import libcst
from mutmut import __main__ as mutmut
from mutmut.mutation.data import SourceFileMutationData
from mutmut.mutation.diff_apply import get_diff_for_mutant
from mutmut.mutation.file_mutation import MutationVisitor
from mutmut.state import state
from mutmut.stats import status_by_exit_code
from mutmut.utils.file_utils import copy_also_copy_files, copy_src_dir, walk_mutatable_files
from mutmut.utils.format_utils import orig_function_and_class_names_from_key
from mutmut.workers.isolation import ForkServerRunner

VERSION = version('mutmut')
MODES = ('torch.inference_mode()', 'torch.no_grad()')
STATS = Path('mutants/mutmut-stats.json')  # which tests reach what, and how long they take
BUDGET_S = 20  # of tests for one mutant, by their time without it; one is always run
KILLED = ('killed', 'timeout', 'segfault')
OPEN = 'not checked'


@dataclass(frozen=True)
class Mutant:
    """
    A changed function and what the tests said of it.

    :param name: of mutmut.
    :param file: path of the source file, from the root of the repository.
    :param function: name of the function, with its class.
    :param status: of mutmut: 'killed', 'survived', 'no tests', 'timeout', 'not checked' ...
    """

    name: str
    file: str
    function: str
    status: str

    @property
    def killed(self):
        """Whether a test failed, or never ended, with this mutant."""
        return self.status in KILLED

    def changed_lines(self):
        """Return the lines without and with the change, as two texts."""
        lines = get_diff_for_mutant(self.name, path=Path(self.file)).splitlines()[2:]
        return tuple('\n'.join(line[1:].strip() for line in lines if line.startswith(sign))
                     for sign in '-+')


def generate():
    """
    Write the mutants of every file; results of functions that changed are forgotten.

    Where a source or a test has changed, all tests are run again before mutants are tried.
    """
    Path('mutants').mkdir(exist_ok=True)
    newest = max(path.stat().st_mtime for folder in ('tap_ros', 'test')
                 for path in Path(folder).rglob('*.py'))
    if STATS.exists() and STATS.stat().st_mtime < newest:
        STATS.unlink()
    copy_src_dir()
    copy_also_copy_files()
    mutmut.create_mutants(1)


def try_mutants(names, jobs):
    """
    Run the tests that reach each of these mutants, the fastest first, until one fails.

    In a process of its own: one that has imported the package without mutants would test that.

    :param names: of mutants; jobs: how many at a time.
    """
    subprocess.run([sys.executable, '-m', __spec__.name, str(jobs), *names], check=True)


def load_mutants():
    """Return {name: Mutant} of all mutants."""
    mutants = {}
    for path in walk_mutatable_files():
        data = SourceFileMutationData(path=path)
        data.load()
        for name, code in data.exit_code_by_key.items():
            function, owner = orig_function_and_class_names_from_key(name)
            mutants[name] = Mutant(name, str(path), f'{owner}.{function}' if owner else function,
                                   status_by_exit_code[code])
    return mutants


def _mutate_below_modes():
    """
    Let functions be mutated whose only decorators set a mode of torch.

    mutmut leaves out every decorated function; that would be all of the planner's search.
    """
    skip = MutationVisitor._skip_node_and_children

    def skip_but_for_modes(self, node):
        if isinstance(node, libcst.FunctionDef) and node.decorators:
            written = [libcst.Module([]).code_for_node(each.decorator) for each in node.decorators]
            if all(text in MODES for text in written):
                return False
        return skip(self, node)

    MutationVisitor._skip_node_and_children = skip_but_for_modes


def _run_fast_tests_first():
    """Run the tests of a mutant by their duration, until the next would go beyond BUDGET_S."""
    submit = ForkServerRunner.submit

    def submit_fast(self, mutant_name, tests, *limits):
        durations = state().duration_by_test
        tests = sorted(tests, key=lambda test: (durations[test], test))
        ends = accumulate(durations[test] for test in tests)
        within = sum(end <= BUDGET_S for end in ends)
        submit(self, mutant_name, tests[:max(1, within)], *limits)

    ForkServerRunner.submit = submit_fast


def _run_clean_tests_once():
    """
    Leave out the run of all tests without mutants that mutmut begins with.

    The one that finds which tests reach what is such a run, and see generate.
    """
    ForkServerRunner.run_clean_tests = lambda self, tests: 0


_mutate_below_modes()
_run_fast_tests_first()
_run_clean_tests_once()

if __name__ == '__main__':
    mutmut.cli(['run', '--max-children', *sys.argv[1:]], standalone_mode=False)
