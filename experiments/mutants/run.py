# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Change the code a little, again and again, and see whether a test fails.

What is changed and which tests are run stands in pyproject.toml, under tool.mutmut. An interrupted
run goes on. The results are in docs/results/mutants.md and mutants.json.
"""

from collections import Counter
from dataclasses import dataclass
import os
import random
import sys

from experiments.mutants.page import write_page
from experiments.mutants.tool import generate, load_mutants, OPEN, try_mutants
from tap_ros.errors import UsageError
from tap_ros.options import Flag, parse


@dataclass(frozen=True)
class Options:
    """
    Options of `make mutants`.

    :param sample: try so many mutants, drawn at random; 0: all.
    :param seed: of the draw.
    :param only: only mutants with this in their name; writes no page.
    :param again: try those again that were not killed, with the tests of now.
    :param jobs: mutants at a time.
    :param page_only: try nothing, write the page.
    """

    sample: int = 0
    seed: int = 0
    only: str = ''
    again: Flag = False
    jobs: int = 1
    page_only: Flag = False


def main():
    """Try mutants and write the page."""
    try:
        args = parse(Options, sys.argv[1:], 'make mutants', (__doc__ or '').strip())
    except UsageError as error:
        sys.exit(f'error: {error}')
    os.environ['OMP_NUM_THREADS'] = '1'
    generate()
    chosen = draw(load_mutants(), args.sample, args.seed)
    if not args.page_only:
        left = [mutant.name for mutant in chosen if args.only in mutant.name
                and (mutant.status == OPEN or args.again and not mutant.killed)]
        print(f'{len(chosen)} mutants, {len(left)} to try', flush=True)
        if left:
            try_mutants(left, args.jobs)
    if not args.only:
        found = load_mutants()
        write_page(draw(found, args.sample, args.seed),
                   Counter(mutant.file for mutant in found.values()), args.seed)


def draw(mutants, number, seed):
    """
    Return the mutants to try, by name; the same ones for the same seed and code.

    :param mutants: {name: Mutant}.
    :param number: how many; all if 0.
    :param seed: of the draw.
    """
    names = sorted(mutants)
    if 0 < number < len(names):
        names = sorted(random.Random(seed).sample(names, number))
    return [mutants[name] for name in names]


if __name__ == '__main__':
    main()
