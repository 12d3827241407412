# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Change the code a little, again and again, and see whether a test fails.

What is changed and which tests are run stands in pyproject.toml, under tool.mutmut. An interrupted
run goes on. The results are in docs/results/mutants.md and mutants.json.
"""

import argparse
from collections import Counter
import os
import random

from experiments.mutants.tool import generate, load_mutants, OPEN, try_mutants


def main():
    """Try mutants and write the page."""
    parser = argparse.ArgumentParser(prog='make mutants', description=__doc__)
    parser.add_argument('--sample', type=int, metavar='N',
                        help='try N mutants drawn at random, not all')
    parser.add_argument('--seed', type=int, default=0, help='of the draw (default: %(default)s)')
    parser.add_argument('--only', default='', metavar='TEXT',
                        help='only mutants with this in their name; writes no page')
    parser.add_argument('--again', action='store_true',
                        help='try those again that were not killed, with the tests of now')
    parser.add_argument('--jobs', type=int, default=1, metavar='N',
                        help='mutants at a time (default: %(default)s)')
    parser.add_argument('--page-only', action='store_true', help='try nothing, write the page')
    args = parser.parse_args()
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
        # Not above: processes that test mutants must not inherit the package without mutants.
        from experiments.mutants.page import write_page
        found = load_mutants()
        write_page(draw(found, args.sample, args.seed),
                   Counter(mutant.file for mutant in found.values()), args.seed)


def draw(mutants, number, seed):
    """
    Return the mutants to try, by name; the same ones for the same seed and code.

    :param mutants: {name: Mutant}.
    :param number: how many; all if None.
    :param seed: of the draw.
    """
    names = sorted(mutants)
    if number is not None and number < len(names):
        names = sorted(random.Random(seed).sample(names, number))
    return [mutants[name] for name in names]


if __name__ == '__main__':
    main()
