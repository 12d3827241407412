# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The selections that `train predictor --choose` tries, and what it says of them."""

from dataclasses import replace
import re
import shlex
from typing import get_args

from made_episodes import move_squares, write_bag
import numpy as np
import pytest
from tap_ros.cli import main, read
from tap_ros.evaluation.trials import decide, Trial
from tap_ros.prediction.methods import Selection
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import write_marks
from tap_ros.training.train import settings_of

TINY = ['--steps', '2', '--base-width', '4', '--threads', '1', '--no-flip', '--margin', '1',
        '--held-out']


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """Write recordings to train on and to hold out; return them and marks on both."""
    folder = tmp_path_factory.mktemp('bags')
    bags = [write_bag(folder / name, [move_squares(
        [[6, 6], [24, seed]], [[12, 10], [27, seed - 4]], seed=seed) for seed in seeds])
        for name, seeds in (('training', range(8, 14)), ('held_out', range(14, 20)))]
    store = open_recordings(bags, progress=False)
    marks = folder / 'marks.json'
    write_marks(marks, store, bags, {i: [(4, 4)] for i in (0, 1, 2, 6, 7, 8, 9, 11)})
    return *map(str, bags), str(marks)


def test_all_selections_are_tried_and_marks_that_are_held_out_choose(bags, tmp_path, capsys):
    bag, held_out, marks = bags
    options = [bag, *TINY, held_out, '--out', str(tmp_path)]
    assert main(['train', 'predictor', *options, '--marks', marks, '--choose']) == 0
    said = capsys.readouterr().out
    best = said.split()[0]
    assert re.search(r'hits most: \d of 5 held-out marks', said)
    page = (tmp_path / 'choose.html').read_text()
    names = ['fix', *get_args(Selection)]
    assert best in names and [
        name for name in re.findall('<h2>(.*?)</h2>', page) if name in names] == names
    assert page.count('data:image/png;base64,') == len(names) and 'src="http' not in page
    commands = dict(zip(names, re.findall('<pre>(.*?)</pre>', page)))
    assert commands[best] in said
    _, asked = read(['train', 'predictor', *options])
    for name, command in commands.items():
        _, given = read(shlex.split(command)[3:])
        assert settings_of(given) == settings_of(asked) | (
            {'loss': 'fix'} if name == 'fix' else {'selection': name}) | (
                {'marks': marks} if name == 'marks' else {})


def test_of_selections_that_differ_by_less_than_chance_it_is_said():
    def tried(**hits):
        return [Trial(name, '', np.arange(12) < count, f'train {name}')
                for name, count in hits.items()]

    assert decide(tried(fix=0, relative=2, marks=12))[0].endswith('(76%, 100%)')
    first, command = decide(tried(fix=0, relative=9, marks=10))
    assert first.startswith('marks hits most') and first.endswith('not told from: relative')
    assert command == 'train marks'
    few = [replace(one, hits=one.hits[:4]) for one in tried(fix=0, marks=4)]
    assert 'too few' in decide(few)[0] and len(decide(few)) == 1
