# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Laws of clocks that lie: every picture is kept, in order, with its actions, and it is told.

Each defect is put at random into recordings of random rates and lengths; what is read is compared
with the undamaged one.
"""

import re

from made_bags import camera, read
from made_bags import record as record_bag
from made_clocks import record, Recording, SECOND, WALL
import numpy as np
import pytest
from tap_ros.recording import tracks
from tap_ros.recording.reading import Reading
from tap_ros.recording.tracks import join

CAMERA, OTHERS = ('frame',), ('twist', 'joint', 'mark')
ALL = (*CAMERA, 'mask', *OTHERS)
SIZES = (0.25, 0.35, 0.5, 1, 1.97, 3, 10, 60, 3600, 86400)  # s
NEAR = 3  # frames near a defect whose action or joints may be those of the next one


def place(bag, random, ends=False):
    """Return the row of a picture: one of the first or last three, or any other."""
    frames = bag.rows('frame')
    if ends:
        return frames[random.choice([1, 2, 3, -3, -2, -1])]
    return frames[random.integers(5, len(frames) - 5)]


def set_clock(names, way, logs=False, stamps=True, least=0.0, ends=False, twice=False):
    """Return what sets clocks back (way -1) or forward from a place on."""
    def spoil(bag, random):
        frames = bag.rows('frame')
        places = [frames[15], frames[-15]] if twice else [place(bag, random, ends)]
        for row in places:
            size = max(random.choice(SIZES), 2.1 / bag.rate, least)
            behind = bag.rows(*names)
            behind = behind[behind >= row]
            bag.stamp[behind] += int(way * size * SECOND) * stamps
            bag.log[behind] += int(way * size * SECOND) * logs
    return spoil


def off(*names):
    """Return what stamps topics by the clock of another computer."""
    def spoil(bag, random):
        bag.stamp[bag.rows(*names)] += int(
            random.choice([-1, 1]) * random.choice([1, 1.5, 3, 20, 7200]) * SECOND)
    return spoil


def started(bag, random):
    bag.stamp[bag.rows(*CAMERA)] -= WALL - 40 * SECOND


def restarted(bag, random):
    started(bag, random)
    rows = bag.rows(*CAMERA)
    rows = rows[rows >= place(bag, random)]
    bag.stamp[rows] -= bag.stamp[rows[0]] - int(random.uniform(0, 10) * SECOND)


def got_the_time(names, logs):
    def spoil(bag, random):
        rows = bag.rows(*names)
        rows = rows[rows < place(bag, random)]
        bag.stamp[rows] -= WALL - 50 * SECOND
        bag.log[rows] -= (WALL - 50 * SECOND) * logs
    return spoil


def wrong(stamps=1, logs=0, ends=False):
    def spoil(bag, random):
        row, size = place(bag, random, ends), random.choice([-2000, -30, -6, 6, 30, 2000])
        bag.stamp[row] += int(size * SECOND) * stamps
        bag.log[row] += int(size * SECOND) * logs
    return spoil


def stamped(name, change):
    """Return what puts change(stamps, random) in place of the stamps of a topic."""
    def spoil(bag, random):
        rows = bag.rows(name)
        bag.stamp[rows] = change(bag.stamp[rows], random)
    return spoil


def standing(stamps, random):
    stamps, first = stamps.copy(), random.integers(5, len(stamps) - 12)
    stamps[first:first + 6] = stamps[first]
    return stamps


def half(stamps, _):
    return np.minimum(stamps, stamps[len(stamps) // 2])


def camera_waits(bag, random):
    """Write pictures up to a second late, several at once, with their commands."""
    for name in (*CAMERA, 'mask', 'twist'):
        rows = bag.rows(name)
        bag.log[rows] = bag.log[rows] // SECOND * SECOND + SECOND + np.arange(len(rows)) * 2000
    order = np.argsort(bag.log, kind='stable')
    for name in ('name', 'log', 'stamp', 'number'):
        setattr(bag, name, getattr(bag, name)[order])


def both(first, second):
    def spoil(bag, random):
        first(bag, random)
        second(bag, random)
    return spoil


def answering(bag, random):
    """Stamp commands as the pictures that they answer."""
    commands = bag.rows('twist')
    bag.stamp[commands] = bag.stamp[bag.rows('frame')[bag.number[commands].astype(int)]]


DEFECTS = {  # how, and what the warnings name
    'camera back': (set_clock(CAMERA, -1), '/cam'),
    'camera forward': (set_clock(CAMERA, 1, least=1), '/cam'),
    'camera back at an end': (set_clock(CAMERA, -1, ends=True), '/cam'),
    'camera back twice': (set_clock(CAMERA, -1, twice=True), '/cam'),
    'camera since its start': (started, '/cmd'),
    'camera replugged': (restarted, '/cam'),
    'camera gets the time': (got_the_time(CAMERA, 0), '/cam'),
    'all back': (set_clock(ALL, -1, logs=True), 'recorder.* back'),
    'all back at an end': (set_clock(ALL, -1, logs=True, ends=True), 'recorder.* back'),
    'all back twice': (set_clock(ALL, -1, logs=True, twice=True), 'recorder.* back'),
    'all get the time': (got_the_time(ALL, 1), 'recorder.* forward'),
    'logs back': (set_clock(ALL, -1, logs=True, stamps=False), 'recorder.* back'),
    'logs forward': (set_clock(ALL, 1, logs=True, stamps=False), None),
    'stamps back': (set_clock(ALL, -1), '/cam'),
    'joints back': (set_clock(['joint'], -1, least=1), '/joint_states'),
    'joints forward': (set_clock(['joint'], 1, least=1), '/joint_states'),
    'commands back': (set_clock(['twist'], -1, least=1), '/cmd'),
    'commands of another computer': (off('twist'), '/cmd'),
    'all but the camera of another': (off(*OTHERS), '/cmd(.|\n)*/joint_states'),
    'camera of another': (off(*CAMERA), '/cmd(.|\n)*/joint_states'),
    'a stamp wrong': (wrong(), '/cam'),
    'one wrong at an end': (wrong(ends=True), '/cam'),
    'a log time wrong': (wrong(0, 1), 'recorder.* back'),
    'some zero': (stamped('frame', lambda s, r: s * (r.random(len(s)) > 0.1)), '/cam'),
    'all zero': (stamped('frame', lambda s, _: 0 * s), None),
    'frozen': (stamped('frame', lambda s, _: 0 * s + 36 * SECOND), '/cam.*repeated'),
    'frozen in part': (stamped('frame', standing), '/cam.*5 are repeated'),
    'whole seconds': (stamped('frame', lambda s, _: s // SECOND * SECOND), '/cam.*repeated'),
    'joints of whole seconds': (
        stamped('joint', lambda s, _: s // SECOND * SECOND), '/joint_states'),
    'joints stand from the middle': (stamped('joint', half), '/joint_states'),
    'camera waits to be written': (camera_waits, None),
    'joints without': (stamped('joint', lambda s, _: 0 * s), None)}
DEFECTS |= {
    'camera back, then all': (both(set_clock(CAMERA, -1, least=1), set_clock(
        ALL, -1, logs=True, least=1)), 'recorder.* back'),
    'frozen, commands answer': (both(DEFECTS['frozen'][0], answering), '/cam.*repeated'),
    'commands without, camera back': (both(
        set_clock(CAMERA, -1, least=1), stamped('twist', lambda s, _: 0 * s)), '/cam')}


@pytest.mark.parametrize('defect', DEFECTS)
def test_what_is_read_is_what_was_recorded_whatever_the_clocks_say(defect):
    spoil, words = DEFECTS[defect]
    for seed in range(6):
        random = np.random.default_rng(seed)
        rate = [5, 10, 15, 30][seed % 4]
        good = record(random, rate, 1 + seed // 4 % 2, marks=seed % 3 == 0,
                      joints='joint' in defect or 'but' in defect or random.random() < 0.8)
        good.rate = rate
        numbers, table, said = good.read()
        assert not said
        bad = good.spoilt(spoil, random)
        bad_numbers, found, told = bad.read()
        assert bad_numbers == numbers, (seed, told)
        assert (found.actions != table.actions).any(1).sum() <= NEAR, (seed, told)
        joints = np.abs(found.grippers - table.grippers)[:, 0]
        assert (joints > 0.1).sum() + (np.isnan(found.grippers[:, 0]) & ~np.isnan(
            table.grippers[:, 0])).sum() <= NEAR, (seed, told)
        assert (np.diff(found.stamps) > 0).all()
        assert all(map(found.has_masks, range(len(found))))
        if words is None:
            assert not told
        elif 'joint' not in words or 'joint' in bad.name:
            assert re.search(words, '\n'.join(told)), (seed, told)
            assert len(told) == len({re.sub(r'[\d.]', '', text) for text in told}) <= 4
            assert not re.search(r' -\d', ''.join(told))


def simulated(random, restarts, speed, episodes=5, frames=8):
    """Return a Recording of a simulation, whose time stands still while others work."""
    wall, now, events, number = WALL / SECOND, 0.0, [], 0

    def send(name, value):
        events.append((name, wall + random.uniform(0.0002, 0.002), now, value))

    for _ in range(episodes):
        now = now * (not restarts) + random.choice([0.0, 9.0]) * (not restarts)
        wall += random.uniform(0, 3)
        for event in (0, 1):
            send('mark', event)
            for _ in range(frames * (1 - event)):
                send('frame', number)
                send('mask', number)
                wall += random.choice([0.01, 2])
                send('twist', number)
                for _ in range(12):
                    now, wall = now + 0.02, wall + 0.02 / speed * random.uniform(0.8, 1.2)
                    send('joint', number)
                number += 1
    return Recording(events)


def assert_untouched(bag):
    """Check that times that are right stay as they are, and nothing is said."""
    parts, _, _ = join([bag.columns()])
    found = tracks.correct_times(parts, bag.columns(), np.empty((0, 2), np.int64))
    for name, track in parts.items():
        order = np.argsort(track.log, kind='stable')
        np.testing.assert_array_equal(found[name].stamp, track.stamp[order])
        np.testing.assert_array_equal(found[name].log, track.log[order])


def swap(bag, random):
    """Let ten pictures arrive just before the one that was taken before them."""
    rows = bag.rows('frame')
    at = random.choice(len(rows) // 2 - 1, 10, replace=False) * 2
    bag.stamp[rows[at]], bag.stamp[rows[at + 1]] = bag.stamp[rows[at + 1]], bag.stamp[rows[at]]


def written(bag, key):
    """Return messages in the order of a key, but their times."""
    order = np.argsort(key, kind='stable')
    found = bag.spoilt(lambda *_: None, None)
    for name in ('name', 'log', 'stamp', 'number'):
        setattr(found, name, getattr(bag, name)[order])
    return found


@pytest.mark.filterwarnings('error')
def test_good_recordings_stay_as_they_are():
    for seed in range(30):
        random = np.random.default_rng(seed)
        assert_untouched(record(random, [5, 10, 15, 30, 60][seed % 5], marks=seed % 2, **[
            {'jitter': 0.4, 'lost': 0.2}, {'latency': (0.01, 0.3)}, {'latency': (0.2, 0.6)}, {},
            {'joints': False, 'frames': 5}, {'pause': 0.5, 'jitter': 0.4}][seed % 6]))
        assert_untouched(simulated(random, seed % 2, [0.1, 0.7, 1, 3, 10][seed % 5]))
        late = record(random, 20)  # answers that take long, in the order in which they came
        answering(late, random)
        late.log[late.rows('twist')] += 12 * SECOND // 10
        assert_untouched(written(late, late.log))
        assert_untouched(written(late, late.log + SECOND * (late.name == 'frame')))
        assert_untouched(written(late, np.unique(late.name, return_inverse=True)[1]))
        late.log += random.integers(0, SECOND // 25, len(late.log))
        late.stamp[late.rows('joint')[::2]] -= SECOND // 20  # of another driver
        assert_untouched(late)
        paired = record(random, 20)  # now and then a driver sends two states of one stamp
        joints = paired.rows('joint')[:-2]
        paired.stamp[joints[1::3]] = paired.stamp[joints[::3]][:len(joints[1::3])]
        assert_untouched(paired)
        burst = record(random, 20)
        burst.log = np.maximum.accumulate(burst.log // SECOND * SECOND + SECOND
                                          + np.arange(len(burst.log)))
        assert_untouched(burst)
        swapped = record(random, 10, 1).spoilt(swap, random)
        (numbers,), table, said = swapped.read()
        assert not said and (np.diff(table.stamps) > 0).all()
        assert sorted(numbers) == list(range(len(numbers)))
        assert (np.array(numbers) != np.arange(len(numbers))).sum() == 20


@pytest.mark.parametrize('pause', [3, 6])
def test_a_clock_that_is_set_back_in_a_pause_joins_no_demonstrations(pause):
    for seed, size in enumerate((1, 1.5, 2.5, 5, 5.5, 60, 3600)):
        for stamps, logs in ((1, 1), (1, 0), (0, 1)):
            random = np.random.default_rng(seed)
            good = record(random, 10, frames=25, pause=pause)
            numbers, table, _ = good.read(gap=2.5)
            bad = good.spoilt(lambda *_: None, random)
            before, after = bad.rows('frame')[len(numbers[0]) - 1:][:2]
            place = random.integers(before + 1, after, endpoint=True)
            bad.stamp[place:] -= int(size * SECOND) * stamps
            bad.log[place:] -= int(size * SECOND) * logs
            bad_numbers, found, told = bad.read(gap=2.5)
            assert bad_numbers == numbers, (size, stamps, logs, told)
            assert (found.actions != table.actions).any(1).sum() <= 1
            np.testing.assert_allclose(found.grippers, table.grippers, atol=0.1)
            assert 'back' in told[0], told
            assert len(told) == len({text.split(':')[1] for text in told})  # one a topic


def test_bags_are_read_so_with_the_cache_and_a_rate(tmp_path):
    times = 1.7e9 + np.arange(40) * 0.1 + np.repeat([0, 12], 20)
    for number, (stamps, count) in enumerate((
            (np.floor(times), 1), (np.full(40, 5.0), 1), (times, 0),
            (np.where(np.arange(40) < 6, times - 1.7e9, times), 1))):
        bag = record_bag(tmp_path / str(number), [
            camera(stamp, i, log + 0.02) for i, (stamp, log) in enumerate(zip(stamps, times))])
        found, told = read(bag)
        assert [e.frames[:, 0, 0, 0].tolist() for e in found] == [[*range(20)], [*range(20, 40)]]
        assert len(told) == count and all('topic /camera/image_raw' in text for text in told)
        found, _ = read(bag, reading=Reading(rate=5))
        assert [len(episode) for episode in found] in ([10, 10], [11, 10])
    again = np.repeat(times[::2], 2)
    found, told = read(record_bag(tmp_path / 'again', [
        camera(t, round(t * 10) % 256, t + 0.02 * (1 + i % 2)) for i, t in enumerate(again)]))
    assert [len(episode) for episode in found] == [10, 10] and not told  # each picture once
