# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Benchmark of /predict_subgoal: its time beside that of the model alone, and many clients at once.

The time is taken by a client in this process, while another one publishes pictures and objects as
a camera would; the model alone runs in turns with it, with the same inputs and number of threads,
while nothing else does. Answers per second are those of clients that ask again as soon as they
are answered, each with a queue of its own, spread over a few processes.
"""

from collections import Counter
import contextlib
from dataclasses import dataclass, field
from functools import partial
import multiprocessing
import os
from pathlib import Path
from queue import SimpleQueue
import signal
import tempfile
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
from experiments.bench.rows import Row
import numpy as np
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.apps.node_processes import NodeProcesses
from tap_ros.nodes.predictor.requests import MAX_TOGETHER as TOGETHER
from tap_ros.prediction.protocol import Request
from tap_ros.ros.calls import call, CallError
from tap_ros.ros.client import Client
from tap_ros.ros.requests import request_fields
from tap_ros.ros.topics import SERVICE_QOS, STREAM, to_stamp
from tap_ros.weights import DEFAULT_PREDICTOR

PIXELS = np.array([[[20, 21], [40, 33]], [[30, 12], [44, 50]]], np.float32)  # start, goal
TIMEOUT = 20.0  # s; a call that takes longer counts as lost
MOST_PROCESSES = 4  # of clients


@dataclass(frozen=True)
class Latency:
    """What one client saw, in turns with the model alone; all in s."""

    alone: np.ndarray  # (rounds * calls,), the model alone
    together: np.ndarray  # (rounds * calls / TOGETHER,), it with TOGETHER requests in a batch
    service: np.ndarray  # (rounds * calls,), from the call to the answer
    inside: np.ndarray  # of these, in the model
    node: float  # of these, in the node, after a request was decoded: median


@dataclass(frozen=True)
class Load:
    """What many clients got."""

    latencies: np.ndarray  # (answers,) s, of the calls that were answered with a prediction
    per_second: float  # of these answers
    counts: Counter  # of other ends: 'busy' (told to ask again), 'refused', 'lost' (no answer)
    cpu_s: float  # CPU time of the clients, for one answer


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
    """Time single calls, and count what many clients get."""
    with tempfile.TemporaryDirectory() as folder, NodeProcesses(folder) as nodes:
        nodes.start('predictor_node', weights=cut_weights(folder))
        with streaming(args.rate) as stream:
            found = compare_latency(stream, args.rounds, args.calls)
            alone, service, inside = (1e3 * np.median(times) for times in (
                found.alone, found.service, found.inside))
            node = 1e3 * found.node
            yield Row(
                'answer of `/predict_subgoal`', f'{service:.1f} ms, 99th percentile '
                f'{1e3 * np.percentile(found.service, 99):.1f} ms', service / alone,
                f'the model alone, {alone:.1f} ms', 'at most 1.2 times the model alone and 1 ms',
                service <= 1.2 * alone + 1, f'the model there {inside:.1f} ms, what else the node '
                f'does {node - inside:.1f} ms, DDS and client {service - node:.1f} ms')
            small, large = (1e3 * np.median(times) for times in compare_sizes(
                args.rounds, args.calls))
            yield Row(
                'answer to pictures of 640x480, as large as their cut', f'{large:.1f} ms',
                large / small, f'one to those of 64x64, {small:.1f} ms', 'at most 10 ms more',
                large <= small + 10, 'messages of 2.5 MB there and back')
            gain = TOGETHER * np.median(found.alone) / np.median(found.together)
            first = None
            for count in args.clients:
                spent = nodes.cpu_s('predictor_node')
                load = measure_load(count, args.seconds)
                spent = (nodes.cpu_s('predictor_node') - spent) / max(len(load.latencies), 1)
                first = first or load.per_second
                yield Row(
                    f'answers to {count} clients', f'{load.per_second:.0f} a second, '
                    f'{load.counts["busy"]} told to come later, {load.counts["lost"]} lost',
                    load.per_second / first, f'{args.clients[0]} client',
                    *(('at least 3 times', load.per_second >= 3 * first) if count == 16 else ()),
                    limit=f'{TOGETHER} in a batch: {gain:.1f} x the model alone; CPU time of an '
                    f'answer: node {1e3 * spent:.1f} ms, clients {1e3 * load.cpu_s:.1f} ms'
                    if count == 16 else '')
        nodes.check()


def compare_latency(stream, rounds, calls):
    """Time the model alone and the service in turns, so many calls in a turn."""
    from tap_ros.prediction.predictor import SubgoalPredictor  # here: clients begin without torch
    predictor = SubgoalPredictor.load(DEFAULT_PREDICTOR)
    alike = Request(*pictures(), *PIXELS)
    alone, together, service, inside = [], [], [], []
    with Client() as client:
        ask, request = make_client(client, SERVICE_QOS.depth), make_request()
        node = SimpleQueue()  # of what /diagnostics tells
        client.node.create_subscription(DiagnosticArray, '/diagnostics', node.put, 10)
        call(ask, request, 120)
        for _ in range(rounds):
            os.kill(stream.pid, signal.SIGSTOP)
            alone += timed(lambda: predictor.predict_together([alike]), calls)
            together += timed(lambda: predictor.predict_together([alike] * TOGETHER),
                              -(-calls // TOGETHER))
            os.kill(stream.pid, signal.SIGCONT)
            service += timed(lambda: inside.append(
                call(ask, request, TIMEOUT).model_time_ms / 1e3), calls)
        while not node.empty():
            node.get()
        values = {one.key: one.value for one in node.get(timeout=TIMEOUT).status[0].values}
    return Latency(*map(np.array, (alone, together, service, inside)),
                   float(values['predict_subgoal p50_ms']) / 1e3)


def compare_sizes(rounds, calls):
    """Time answers to pictures of the network's size and of 640x480 in turns; return both, s."""
    sizes = [(64, 64), (480, 640)]
    with Client() as client:
        ask, found = make_client(client, SERVICE_QOS.depth), [[] for _ in sizes]
        requests = [make_request(size) for size in sizes]
        for _ in range(rounds):
            for request, times in zip(requests, found):
                times += timed(partial(call, ask, request, TIMEOUT), calls)
        sides = [call(ask, request, TIMEOUT).subgoals[0].image.height for request in requests]
    if sides != [64, 480]:
        raise RuntimeError(f'answers have {sides} rows')
    return found


def timed(work, count, warm_up=5):
    """Return the s that each of `count` calls took, after some to warm up."""
    times = []
    for _ in range(count + warm_up):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return times[warm_up:]


def measure_load(clients, seconds, depth=SERVICE_QOS.depth):
    """Let many clients ask at once for so many seconds, each with a queue of depth answers."""
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
    return Load(latencies, len(latencies) / max(part[2] for part in found),
                sum((part[1] for part in found), Counter()),
                sum(part[3] for part in found) / max(len(latencies), 1))


def ask_many(clients, seconds, depth, barrier, results):
    """
    Be some of the clients, in a process of their own, from the barrier on.

    :param results: queue for (latencies, counts of other ends, s that it took, s of CPU time).
    """
    latencies, others = [], []

    def ask(client, deadline):
        request = make_request()
        while (begin := time.monotonic()) < deadline:
            try:
                response = call(client, request, TIMEOUT)
            except CallError:
                others.append('lost')
                continue
            if response.success:
                latencies.append(time.monotonic() - begin)
            else:
                others.append('busy' if 'busy' in response.message else 'refused')
                time.sleep(0.05)  # as a client does that is told to come later

    with Client() as client:
        each = [make_client(client, depth) for _ in range(clients)]
        for one in each:
            call(one, make_request(), 120)
        barrier.wait(300)
        begin, spent = time.monotonic(), time.process_time()
        threads = [threading.Thread(target=ask, args=(one, begin + seconds)) for one in each]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        results.put((np.array(latencies), Counter(others), time.monotonic() - begin,
                     time.process_time() - spent))


def make_client(client, depth):
    """Return a further rclpy client of the predictor, with a queue of its own."""
    return client.node.create_client(
        PredictSubgoal, 'predict_subgoal', qos_profile=QoSProfile(depth=depth),
        callback_group=client.answers)


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
    """Publish a start at this rate, until killed."""
    with Client() as client:
        image = client.node.create_publisher(Image, 'camera/image_raw', STREAM)
        objects = client.node.create_publisher(ObjectStates, 'objects', STREAM)
        request = make_request()
        while True:
            stamp = to_stamp(time.time_ns())
            for publisher, message in ((image, request.start), (objects, request.start_objects)):
                message.header.stamp = stamp
                publisher.publish(message)
            time.sleep(1 / rate)


def cut_weights(folder):
    """Write the usual weights, as if of the middle of pictures of 640x480; return the file."""
    from tap_ros.prediction.predictor import load_network  # here, as above
    from tap_ros.weights.weights import save_weights
    network, _ = load_network(DEFAULT_PREDICTOR)
    file = Path(folder, 'predictor.safetensors')
    save_weights(file, network, 'predictor', network.config, {
        'settings': {'crop': 'centre', 'size': 64}, 'camera_size': [480, 640]})
    return file


def pictures(size=(64, 64)):
    """Return a start and a goal picture, uint8 (2, *size, 3)."""
    return np.random.default_rng(0).integers(0, 256, (2, *size, 3), np.uint8)


def make_request(size=(64, 64)):
    """Return a request that has all it needs."""
    (start, goal), places = pictures(size), PIXELS * (size[0] / 64) + (
        (size[1] - size[0]) / 2, 0)  # in the middle of wide ones
    return PredictSubgoal.Request(**request_fields(
        ('cup', 'box'), start=start, goal=goal, start_objects=places[0], goal_objects=places[1]))
