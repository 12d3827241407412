# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Benchmark of /predict_subgoal: its time beside that of the model alone, and many clients at once.

The time is taken by a client in this process, while another one publishes pictures and objects as
a camera would; the model alone runs in turns with it, with the same inputs and number of threads,
while nothing else does. Answers per second are those of clients that ask again as soon as they
are answered, each with a queue of its own, spread over a few processes.
"""

import contextlib
from dataclasses import dataclass, field
import multiprocessing
import os
import signal
import tempfile
import threading
import time

import numpy as np
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.nodes.client import Client, request_fields
from tap_ros.nodes.clients import call, CallError
from tap_ros.nodes.node_processes import NodeProcesses
from tap_ros.nodes.topics import LATCHED, SERVICE_QOS, STREAM, to_stamp
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.weights import DEFAULT_PREDICTOR

SERVICE = 'predict_subgoal'
NAMES = ('cup', 'box')
PIXELS = np.array([[[20, 21], [40, 33]], [[30, 12], [44, 50]]], np.float32)  # start, goal
TIMEOUT = 20.0  # s; a call that takes longer counts as lost
MOST_PROCESSES = 4  # of clients


@dataclass(frozen=True)
class Load:
    """
    What many clients got.

    :param clients: how many asked at once.
    :param latencies: (answers,) s, of the calls that were answered with a prediction.
    :param per_second: of these answers.
    :param busy: calls that were told to ask again.
    :param lost: calls that got no answer.
    """

    clients: int
    latencies: np.ndarray
    per_second: float
    busy: int
    lost: int


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param rounds: turns of the service and of the model alone.
    :param calls: in each turn.
    :param clients: how many clients ask at once; without a number, none do.
    :param seconds: how long they ask.
    :param rate: pictures that stream in, per second.
    """

    rounds: int = 6
    calls: int = 100
    clients: list[int] = field(default_factory=lambda: [1, 4, 16, 64])
    seconds: float = 5
    rate: float = 30


def run(args):
    """Print the times of single calls, and what many clients get."""
    with tempfile.TemporaryDirectory() as folder, NodeProcesses(folder) as nodes:
        nodes.start('predictor_node')
        with streaming(args.rate) as stream:
            alone, service = compare_latency(stream, args.rounds, args.calls)
            show_latency(alone, service, args.rate)
            print(f'{"clients":>8}{"answers/s":>11}{"p50, ms":>10}{"p99, ms":>10}'
                  f'{"busy":>7}{"lost":>7}')
            for count in args.clients:
                load = measure_load(count, args.seconds)
                p50, p99 = 1e3 * np.percentile(load.latencies, (50, 99)) if len(
                    load.latencies) else (np.nan, np.nan)
                print(f'{load.clients:>8}{load.per_second:>11.1f}{p50:>10.1f}{p99:>10.1f}'
                      f'{load.busy:>7}{load.lost:>7}', flush=True)
        nodes.check()


def show_latency(alone, service, rate):
    """Print how the times (s) of single calls compare with those of the model alone."""
    bound = 1.2 * np.median(alone) + 1e-3
    for name, times in (('the model alone', alone),
                        (f'/{SERVICE}, {rate:g} pictures/s', service)):
        p50, p99 = 1e3 * np.percentile(times, (50, 99))
        print(f'{name:<40}p50 {p50:6.2f} ms   p99 {p99:6.2f} ms   {len(times)} calls')
    print(f'{"1.2 x the model alone + 1 ms":<40}p50 {1e3 * bound:6.2f} ms: '
          f'{"held" if np.median(service) <= bound else "not held"}', flush=True)


def compare_latency(stream, rounds, calls):
    """
    Time the model alone and the service in turns.

    :param stream: process that publishes; it stands still while the model is alone.
    :param rounds: turns of each.
    :param calls: calls in each turn.
    :return: times of the model and of the service, (rounds * calls,) each, in s.
    """
    predictor = SubgoalPredictor.load(DEFAULT_PREDICTOR)
    start, goal = pictures()
    times = {'alone': [], 'service': []}
    with Client(timeout_s=TIMEOUT) as client:
        request = make_fields()
        client.call('predict', 120, **request)
        for _ in range(rounds):
            os.kill(stream.pid, signal.SIGSTOP)
            times['alone'].append(timed(lambda: predictor.predict(start, goal, *PIXELS), calls))
            os.kill(stream.pid, signal.SIGCONT)
            times['service'].append(timed(lambda: client.call('predict', **request), calls))
    return np.concatenate(times['alone']), np.concatenate(times['service'])


def timed(work, count, warm_up=5):
    """Return the s that each of `count` calls took, after some to warm up."""
    times = []
    for _ in range(count + warm_up):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return times[warm_up:]


def measure_load(clients, seconds, depth=SERVICE_QOS.depth):
    """
    Let many clients ask at once.

    :param clients: how many, each with a client of its own.
    :param seconds: how long they ask.
    :param depth: answers that wait in the queue of a client; the default of ROS is 10.
    :return: a Load.
    """
    count = min(clients, MOST_PROCESSES)
    context = multiprocessing.get_context('spawn')
    barrier, results = context.Barrier(count), context.Queue()
    processes = [context.Process(target=ask_many, daemon=True, args=(
        len(range(i, clients, count)), seconds, depth, barrier, results)) for i in range(count)]
    for process in processes:
        process.start()
    found = [results.get(timeout=300 + seconds) for _ in processes]
    for process in processes:
        process.join()
    latencies = np.concatenate([part[0] for part in found])
    elapsed = max(part[3] for part in found)
    return Load(clients, latencies, len(latencies) / elapsed, sum(part[1] for part in found),
                sum(part[2] for part in found))


def ask_many(clients, seconds, depth, barrier, results):
    """
    Be some of the clients, in a process of their own.

    :param clients: how many.
    :param seconds: how long to ask.
    :param depth: answers that wait in the queue of a client.
    :param barrier: passed when all processes are ready.
    :param results: queue for (latencies, busy, lost, s that it took).
    """
    latencies, busy, lost = [], [], []
    qos = QoSProfile(depth=depth)

    request = PredictSubgoal.Request(**make_fields())

    def ask(client, deadline):
        while (begin := time.monotonic()) < deadline:
            try:
                response = call(client, request, TIMEOUT)
            except CallError as error:
                lost.append(error)
                continue
            if response.success:
                latencies.append(time.monotonic() - begin)
            else:
                busy.append(response.message)

    with Client() as owner:
        each = [owner.node.create_client(PredictSubgoal, SERVICE, qos_profile=qos)
                for _ in range(clients)]
        for client in each:
            call(client, request, 120)
        barrier.wait(300)
        begin = time.monotonic()
        threads = [threading.Thread(target=ask, args=(client, begin + seconds))
                   for client in each]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        results.put((np.array(latencies), len(busy), len(lost), time.monotonic() - begin))


@contextlib.contextmanager
def streaming(rate):
    """Publish pictures and objects in a process of its own; give that process."""
    process = multiprocessing.get_context('spawn').Process(
        target=publish, args=(rate,), daemon=True)
    process.start()
    try:
        yield process
    finally:
        process.kill()
        process.join()


def publish(rate):
    """Publish a start at this rate and a goal once, until killed."""
    with Client() as client:
        image = client.node.create_publisher(Image, 'camera/image_raw', STREAM)
        objects = client.node.create_publisher(ObjectStates, 'objects', STREAM)
        goals = (client.node.create_publisher(Image, 'goal/image', LATCHED),
                 client.node.create_publisher(ObjectStates, 'goal/objects', LATCHED))
        request = make_fields()
        for publisher, name in zip(goals, ('goal', 'goal_objects')):
            publisher.publish(request[name])
        while True:
            stamp = to_stamp(time.time_ns())
            for publisher, name in ((image, 'start'), (objects, 'start_objects')):
                request[name].header.stamp = stamp
                publisher.publish(request[name])
            time.sleep(1 / rate)


def pictures():
    """Return a start and a goal picture, uint8 (2, 64, 64, 3)."""
    return np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), np.uint8)


def make_fields():
    """Return the fields of a request that has all it needs."""
    start, goal = pictures()
    return request_fields(NAMES, start=start, goal=goal, start_objects=PIXELS[0],
                          goal_objects=PIXELS[1])
