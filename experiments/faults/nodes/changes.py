# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes that change during a goal, clocks that jump, names that forge log lines."""

import time

from experiments.faults.fault import Fault
from experiments.faults.nodes.attacked import Attacked
from experiments.faults.nodes.rig import outcome
from experiments.faults.nodes.world import (
    first_pictures,
    goal_fields,
    objects_message,
    predict_fields,
    TOPICS,
)
import numpy as np
from sensor_msgs.msg import Image
from tap_msgs.msg import Episode, ObjectStates
from tap_ros.nodes.clients import in_executor
from tap_ros.nodes.topics import STREAM, to_stamp

STOP_S = 0.5
END_S = 8.0
CHANGED = 'the scene has changed'
DISCOVERED_S = 0.5  # that a new publisher takes to be heard
FORGED = 'FORGED LINE'
NAMES = (f'red\n{FORGED}', f'\x1b[31m{FORGED}\x1b[0m', f'a\r{FORGED}', f'a\x85{FORGED}',
         f'a\u2028{FORGED}', '\x1b]0;title\x07', f'a\x00\n{FORGED}')


def _judge(job, handle, moment):
    """Take down whether a goal was aborted after a change, and nothing moved any more."""
    end, why = outcome(job.rig.result, handle, END_S)
    took = time.monotonic() - moment
    if why:
        outcome(job.rig.finish, handle)
        why = f'the goal went on: {why}'
    elif not end.startswith('aborted: ') or CHANGED not in end:
        why = f'the goal {end}'
    late = job.rig.commands.moves(moment + STOP_S * job.patience)
    if not why and late:
        why = f'a move was sent {late[-1].at - moment:.1f} s after the change'
    job.record(not why, why, took)


def _goal(trial):
    """Return a goal that brings its own picture, or one whose picture comes by topic."""
    return goal_fields() if trial % 2 else {'mode': 'direct', 'step_budget': 1000}


def reset(job):
    """Reset the simulator, which runs in real time, during a goal."""
    rig = job.rig
    rig.need('visual_mpc_node', sim='real')
    for trial in job.trials():
        rig.reset(2 * trial)
        rig.commands.forget()
        begin = time.monotonic()
        handle = rig.begin(**_goal(trial))
        rig.commands.wait_for_moves(begin, 2, 20.0)
        rig.reset(2 * trial + 1)
        _judge(job, handle, time.monotonic())


def other_simulator(job):
    """Start a second simulator during a goal."""
    rig = job.rig
    rig.need('visual_mpc_node', sim='real')
    for trial in job.trials():
        rig.reset(trial)
        rig.commands.forget()
        other = Attacked('sim_node', rig.folder / 'other_sim.log',
                         {'seed': 99}, ('-r', '__node:=other_sim'))
        begin = time.monotonic()
        handle = rig.begin(**_goal(trial))
        rig.commands.wait_for_moves(begin, 1, 20.0)
        try:
            other.start().wait_until_ready()
            _judge(job, handle, time.monotonic() + DISCOVERED_S)
        finally:
            other.end()


def in_world(job, change):
    """Change what a World publishes, during a goal."""
    rig = job.rig
    rig.need('visual_mpc_node')
    with rig.world() as world:
        for trial in job.trials():
            world.restore()
            time.sleep(0.5)
            rig.commands.forget()
            handle = rig.begin_moving()
            change(world, trial)
            _judge(job, handle, time.monotonic())


def clock_jump(world, trial):
    """Let the clock jump ahead or back."""
    world.shift_s = (3600.0, -3600.0, 10.0, -10.0)[trial % 4]


def objects_change(world, trial):
    """Let an object vanish or appear."""
    seen = first_pictures()[0]
    if trial % 2:
        world.pixels, world.names = seen.object_pixels[:1], seen.object_names[:1]
    else:
        world.pixels = np.concatenate([seen.object_pixels, [[5.0, 5.0]]])
        world.names = (*seen.object_names, 'newcomer')


def future_stamps(job):
    """Reach goals while somebody publishes far-future stamps once a second."""
    rig = job.rig
    rig.need('visual_mpc_node')
    publishers = {topic: rig.node.create_publisher(kind, name, STREAM)
                  for topic, (kind, name) in TOPICS.items()}
    try:
        with rig.world() as world:
            for trial in job.trials():
                topics = [[topic] for topic in TOPICS] + [list(TOPICS)]
                chosen = topics[trial % len(topics)]
                handle, why = outcome(rig.begin, **goal_fields(step_budget=4))
                begin, ends = time.monotonic(), None
                while handle is not None and time.monotonic() < begin + 20:
                    messages = world.messages(to_stamp(time.time_ns() + 10**15))
                    for topic in chosen:
                        publishers[topic].publish(messages[topic])
                    ends = ends or in_executor(rig.node, handle.get_result_async, 5.0)
                    time.sleep(1.0)
                    if ends.done():
                        break
                if handle is not None:
                    end, why = outcome(rig.result, handle, 1.0)
                    why = why or ('' if end.startswith('succeeded') else f'the goal {end}')
                job.record(not why, f'{", ".join(chosen)}: {why}', time.monotonic() - begin)
    finally:
        for publisher in publishers.values():
            rig.node.destroy_publisher(publisher)


def forged_names(job):
    """Send names with newlines and control characters to every node, and look into its log."""
    rig = job.rig
    nodes = ('visual_mpc_node', 'predictor_node', 'recorder_node')
    rig.need(*nodes, sim='real')
    rogue = rig.node.create_publisher(ObjectStates, 'objects', STREAM)
    episodes = rig.node.create_publisher(Episode, 'episode', STREAM)
    seen = first_pictures()[0]
    try:
        for trial in job.trials():
            name = NAMES[trial % len(NAMES)]
            objects = objects_message(seen, to_stamp(0), names=(name, name))
            said = [outcome(rig.reset, 0, name)]
            said += [outcome(rig.predict, 10.0, **predict_fields(**fields)) for fields in (
                {'mode': name}, {'start_objects': objects},
                {'start': Image(width=64, height=64, encoding=name, step=192)})]
            rogue.publish(objects)
            episodes.publish(Episode(event=Episode.START, task=name, outcome=name))
            for fields in ({'mode': name}, {'goal_objects': objects}):
                handle, _ = outcome(rig.begin, **goal_fields(**fields))
                if handle is not None:
                    said.append(outcome(rig.result, handle, 15.0))
            texts = {node: attacked.text for node, attacked in rig.processes.items()}
            wrong = [node for node, text in texts.items() if _is_forged(text)]
            answers = [getattr(answer, 'message', answer) for answer, _ in said if answer]
            why = f'a forged line in the log of {", ".join(wrong)}' if wrong else ''
            if any(not text.isprintable() for text in answers):
                why = 'an answer that does not print'
            rig.check()
            job.record(not why, why)
            if wrong:  # what is in a log stays there
                for node in list(rig.processes):
                    rig.remove(node)
                rig.need(*nodes, sim='real')
    finally:
        rig.node.destroy_publisher(rogue)
        rig.node.destroy_publisher(episodes)


def _is_forged(text):
    """Tell whether a log holds control characters, or a line that a name has made."""
    return any(line.startswith(FORGED) or not line.isprintable()
               for line in text.replace('\t', ' ').split('\n'))


ABORTED = ('The goal is aborted with the reason, and no move is sent later than '
           f'{STOP_S:g} s after the change.')
FAULTS = [
    Fault('scene-reset', 'the scene is reset during a goal', 'Somebody starts a new scene while '
          'the arm pushes towards the goal of the old one.', ABORTED, 20, 4.0, reset,
          'until the goal ended', 's'),
    Fault('scene-other-simulator', 'a second simulator is started during a goal', 'Two cameras '
          'publish on the same topic: pictures of two scenes take turns.', 'The goal is aborted '
          f'with the reason, and no move is sent later than {STOP_S + DISCOVERED_S:g} s after the '
          f'second simulator says that it is ready, which includes {DISCOVERED_S:g} s until it is '
          'discovered.', 10, 9.0, other_simulator,
          f'until the goal ended, from {DISCOVERED_S:g} s after it was ready', 's'),
    Fault('scene-clock', 'the clock jumps during a goal', 'A computer sets its clock back, '
          'or more than 10 s ahead, or a recording is played in a loop.', ABORTED, 20, 3.0,
          lambda job: in_world(job, clock_jump), 'until the goal ended', 's'),
    Fault('scene-objects', 'objects appear or vanish during a goal', 'Somebody takes an object '
          'away or adds one; or the tracker loses one.', ABORTED, 20, 3.0,
          lambda job: in_world(job, objects_change), 'until the goal ended', 's'),
    Fault('future-stamps', 'messages from the future once a second', 'Another machine, whose '
          'clock is wrong, publishes on the same topic.', 'The goal of four steps succeeds.', 20,
          5.0, future_stamps, 'for the goal', 's'),
    Fault('forged-names', 'newlines and control characters in names', 'A name of an object or a '
          'task holds a line that looks like one of the log, or commands to the terminal.',
          'Logs and answers show it escaped, in one line.', 28, 4.0, forged_names)]
