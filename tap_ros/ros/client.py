# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes as one plain class: arrays in, arrays out, no rclpy to know."""

import atexit
from collections.abc import Callable, Mapping, Sequence
import secrets
import threading
import time
from typing import Any, Self

from action_msgs.srv import CancelGoal
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
from rcl_interfaces.srv import GetParameters, SetParameters
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.exceptions import InvalidNamespaceException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool
from tap_msgs.action import ReachGoal
from tap_msgs.srv import PredictSubgoal, ResetScene, SelectObjects, SetGoal, StepScene
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped, listing
from tap_ros.messages.subgoals import Subgoal
from tap_ros.ros.calls import call, CallError, countdown, NotYet, Spinner
from tap_ros.ros.goal_senders import CLIENT
from tap_ros.ros.heartbeat import Liveness
from tap_ros.ros.observations import Observations
from tap_ros.ros.reaching import CANCEL, Goals, Reaching
from tap_ros.ros.requests import (
    by_name,
    make_request,
    pixels_of,
    request_fields,
    seconds_of,
    subgoals_of,
    text_of,
    WAITING,
)
from tap_ros.ros.run import configure_fast_dds
from tap_ros.ros.topics import SERVICE_QOS, to_stamp
from tap_ros.ros.views import observe, View, wait_for_view

SERVICES: dict[str, tuple[Any, str, str]] = {  # type, name, the node that offers it
    'predict': (PredictSubgoal, 'predict_subgoal', 'predictor_node'),
    'reset': (ResetScene, 'sim/reset', 'sim_node'),
    'set_goal': (SetGoal, 'sim/set_goal', 'sim_node'),
    'step': (StepScene, 'sim/step', 'sim_node'),
    'pause': (SetBool, 'sim/pause', 'sim_node'),
    'select': (SelectObjects, 'select_objects', 'tracker_node'),
    'record': (SetBool, 'recorder/record', 'recorder_node'),
    'get': (GetParameters, 'predictor_node/get_parameters', 'predictor_node'),
    'set': (SetParameters, 'predictor_node/set_parameters', 'predictor_node'),
    'set_planner': (SetParameters, 'visual_mpc_node/set_parameters', 'visual_mpc_node'),
    'change': (ChangeState, 'predictor_node/change_state', 'predictor_node'),
    'cancel': (CancelGoal, CANCEL, 'visual_mpc_node')}  # by default all goals
READY = {'sim_node': 'reset', 'predictor_node': 'predict', 'tracker_node': 'select',
         'recorder_node': 'record', 'visual_mpc_node': 'cancel'}
PLANNER = 'visual_mpc_node'


class Client:
    """
    What other programs do with the nodes: predict, reach goals, reset scenes, record, look.

    Each call ends within its time-out, a positive number of seconds; errors name the node that is
    silent, has left the ROS graph or refused. Names, shapes and numbers that cannot be used raise
    ConfigError before anything is sent.

    :param namespace: of the nodes.
    :param timeout_s: most seconds of a call that is given no other time-out.
    :param node: rclpy Node that another thread spins, to use instead of one of its own.
    :ivar answers: callback group of service clients.
    """

    def __init__(self, namespace: str = '', timeout_s: float = 20.0,
                 node: Node | None = None) -> None:
        self.timeout_s = seconds_of(timeout_s)
        self._context: Context | None = None
        if node is None:
            configure_fast_dds()
            self._context = Context()
            rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            try:
                # A name of its own, by which the planner can tell who has sent a goal.
                node = Node(f'{CLIENT}{secrets.token_hex(4)}', namespace=namespace,
                            context=self._context)
            except (InvalidNamespaceException, TypeError, UnicodeError) as error:
                self._context.try_shutdown()
                raise ConfigError(f'namespace {escaped(namespace, 60)}: is no name of a '
                                  'namespace, such as /left') from error
            self._spinner = Spinner(node).__enter__()
        self.node = node
        self._group = ReentrantCallbackGroup()
        self.answers = self._group if self._context is None else self._spinner.answers
        self._lock = threading.RLock()
        self._made: dict[str, Any] = {}  # what was asked for so far
        atexit.register(self.close)  # a goal has an owner, and threads end before Python does

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End, at the latest when Python does; a goal in progress is cancelled."""
        atexit.unregister(self.close)
        if 'goals' in self._made:
            self._made['goals'].close()
        if self._context is not None:
            self._spinner.__exit__()
            self.node.destroy_node()
            self._context.try_shutdown()
            self._context = None

    # Nodes

    def is_ready(self, name: str) -> bool:
        """Return whether a node ('predictor_node', ...) or one of SERVICES is ready."""
        return bool(self._service(READY.get(name, name)).service_is_ready())

    def silence(self, name: str) -> str:
        """Return for how long a node such as 'predictor_node' is silent; '' while it is not."""
        return self._liveness(name).silence

    def wait_until_ready(self, *names: str, timeout_s: float = 90.0) -> None:
        """
        Wait until nodes are ready.

        :param names: of the nodes, such as 'predictor_node'; none: predictor and planner.
        :param timeout_s: most seconds to wait.
        :raises CallError: naming those that are not ready in time.
        """
        deadline = time.monotonic() + seconds_of(timeout_s)
        waiting = names or ('predictor_node', PLANNER)
        while waiting := tuple(name for name in waiting if not self.is_ready(name)):
            if time.monotonic() > deadline:
                raise CallError(f'{", ".join(waiting)}: not ready after {timeout_s:g} s; start '
                                'what is missing, and see its log')
            time.sleep(0.1)

    def call(self, service: str, timeout_s: float | None = None,
             give_up: Callable[[], object] = lambda: False, **fields: Any) -> Any:
        """
        Call a service with messages, as they are in ROS.

        :param service: one of SERVICES.
        :param fields: of its request.
        :return: its response.
        :raises CallError: when it does not answer in time, leaves the ROS graph, or refuses;
            calls.NotYet where it waits for a picture.
        :raises ConfigError: for values that a field cannot hold.
        """
        seconds, client = self._timeout(timeout_s), self._service(service)
        kind, _, server = SERVICES[service]
        response = call(
            client, make_request(kind.Request, fields), seconds, give_up, self._liveness(server))
        if not getattr(response, 'success', True):
            reason = getattr(response, 'message', 'the log of its node says why')
            raise (NotYet if reason.startswith(WAITING) else CallError)(
                f'{client.service_name} refused: {escaped(reason, 1000)}')
        return response

    # Subgoals and goals

    def predict(self, start: np.ndarray | None = None, goal: np.ndarray | None = None,
                start_pixels: np.ndarray | None = None, goal_pixels: np.ndarray | None = None,
                num_samples: int = 1, recursion_depth: int = 1, seed: int = 0, mode: str = '',
                timeout_s: float | None = None) -> list[Subgoal]:
        """
        Ask predictor_node for subgoals.

        :param start: uint8 (H, W, 3) rgb; None: the newest picture of the camera.
        :param goal: uint8 (H, W, 3) rgb; None: the newest goal picture.
        :param start_pixels: (K, 2) (u, v) of objects in the start picture; None: those of the
            topic where the picture is, else no maps.
        :param goal_pixels: (K, 2), of the same objects in the goal picture.
        :param num_samples: how many to draw, 1 to 100; recursion_depth: subgoals in a row, 1 to 8.
        :param seed: of the samples.
        :param mode: 'bidirectional' or 'forward'; '': what the node has weights for.
        :return: list of Subgoal, earliest first, sample after sample; their mass is NaN. Objects
            of topics are in the order of the message.
        :raises CallError: when the node does not answer in time, leaves the ROS graph, or refuses.
        :raises ConfigError: for pictures of another type or shape, and numbers out of range.
        """
        left = countdown('predict', self._timeout(timeout_s))  # encoding takes its time
        fields = request_fields(
            start=start, goal=goal, start_objects=start_pixels, goal_objects=goal_pixels)
        response = self.call(
            'predict', left(), **fields, num_samples=num_samples,
            recursion_depth=recursion_depth, seed=seed, mode=mode)
        return subgoals_of(response)

    def reach(self, goal: np.ndarray | None = None, goal_pixels: Mapping[str, Any] | None = None,
              mode: str = 'subgoal', step_budget: int = 0, recursion_depth: int = 1,
              num_samples: int = 1, seed: int = 0,
              on_feedback: Callable[[ReachGoal.Feedback], object] | None = None,
              timeout_s: float = 600.0) -> Reaching:
        """
        Have the planner move the arm until the objects are where a goal picture shows them.

        :param goal: (H, W, 3) uint8; None: the newest goal picture.
        :param goal_pixels: {object: (u, v)} in the goal picture; None: those of the topic.
        :param mode: 'subgoal', via predicted subgoals, or 'direct'.
        :param step_budget: most commands; 0: the planner's default.
        :param recursion_depth: subgoals in a row.
        :param num_samples: of them to choose from.
        :param on_feedback: called with each feedback by another thread; without it they are
            kept for the iteration over what is returned.
        :param timeout_s: most seconds until the end; whoever waits for longer cancels the goal.
        :return: Reaching, once the goal is accepted; it ends with this client at the latest.
        :raises CallError: when the planner does not answer, or rejects it: it has another goal.
        """
        pixels = by_name(goal_pixels or {})
        request = make_request(ReachGoal.Goal, request_fields(
            tuple(pixels), goal_image=goal, goal_objects=list(pixels.values()) or None) | {
                'mode': mode, 'step_budget': step_budget, 'recursion_depth': recursion_depth,
                'num_samples': num_samples, 'seed': seed})
        return Reaching(self.goals, request, seconds_of(timeout_s), self.timeout_s, on_feedback)

    def weights(self) -> str:
        """Return the predictor's weights, a name or a file."""
        return str(self.call('get', names=['weights']).values[0].string_value)

    def use_weights(self, weights: str) -> None:
        """
        Have the predictor go on with other weights, by name or file of its machine.

        :raises CallError: when it cannot load them; then it has none.
        """
        text_of(weights, 'weights')

        def change(*transitions: int) -> None:
            for transition in transitions:
                self.call('change', transition=Transition(id=transition))

        change(Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP)
        parameter = Parameter('weights', value=weights).to_parameter_msg()
        answer, = self.call('set', parameters=[parameter]).results
        if not answer.successful:
            raise CallError(f'predictor_node, weights {weights}: {escaped(answer.reason, 500)}')
        change(Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)

    # Simulator and recorder

    def reset(self, task: str = 'push2', seed: int = 0, hide_arm: bool = False,
              objects: bool = True) -> tuple[View, View]:
        """
        Start a scene in the simulator.

        :param objects: wait for them, too; not where they are yet to be selected.
        :return: the first view of the camera, and the goal.
        :raises CallError: when the simulator refuses, or shows nothing.
        """
        left = countdown('reset', self.timeout_s)
        scene: dict[str, Any] = {'task': task, 'seed': seed, 'hide_arm': hide_arm}
        make_request(ResetScene.Request, scene)  # raises before anything is waited for
        self._observed('goal')  # before something comes
        before = self.camera(objects=objects, timeout_s=left()).stamp_ns
        self.call('reset', left(), **scene)
        goal = self.goal(before, objects, left())
        return self.camera(goal.stamp_ns - 1, objects, left()), goal

    def select(self, pixels: Mapping[str, Sequence[float]], stamp_ns: int = 0) -> None:
        """
        Have the tracker follow other objects {name: (u, v)}, clicked in the newest picture.

        :param stamp_ns: of the picture that was clicked: none that is older is used.
        :raises CallError: with the reason, such as a click on the robot. The objects that are not
            refused are followed; where all are, those before.
        """
        u, v = pixels_of(list(by_name(pixels).values()), 'pixels').T.tolist()
        answer = self.call('select', names=list(pixels), u=u, v=v, stamp=to_stamp(stamp_ns))
        if len(answer.objects) < len(pixels):
            raise CallError(answer.message)

    def set_goal(self, pixels: Mapping[str, Sequence[float]]) -> None:
        """Have the simulator put the goal of objects {name: (u, v)} elsewhere."""
        self.call('set_goal', **request_fields(
            tuple(by_name(pixels)), objects=list(pixels.values())))

    def pause(self, paused: bool = True) -> None:
        """Pause the simulator, or let it go on."""
        self.call('pause', data=paused)

    def record(self, active: bool = True) -> str:
        """Have recorder_node begin a recording, or end it; return what it says."""
        return str(self.call('record', data=active).message)

    # What is seen

    def camera(self, after_ns: int = -1, objects: bool = True,
               timeout_s: float | None = None) -> View:
        """
        Return the camera's newest picture.

        :param after_ns: wait for one that is stamped later than this.
        :param objects: wait for one with the objects in it.
        :raises CallError: naming the silent topic.
        """
        return wait_for_view(
            self._observed('camera'), 'camera', after_ns, objects, self._timeout(timeout_s))

    def goal(self, after_ns: int = -1, objects: bool = True,
             timeout_s: float | None = None) -> View:
        """
        Return the newest goal picture.

        :param after_ns: wait for one that is stamped later than this.
        :param objects: wait for one with the objects in it.
        :raises CallError: naming the silent topic.
        """
        return wait_for_view(
            self._observed('goal'), 'goal', after_ns, objects, self._timeout(timeout_s))

    def _once(self, name: str, make: Callable[[], Any]) -> Any:
        with self._lock:
            if name not in self._made:
                self._made[name] = make()
            return self._made[name]

    def _service(self, name: str) -> Any:
        if name not in SERVICES:
            raise ConfigError(f'{escaped(name, 60)}: is no node or service; expected one of '
                              f'{listing([*READY, *SERVICES], 50)}')
        kind, topic, server = SERVICES[name]
        self._liveness(server)  # its heartbeat is heard from now on
        return self._once(topic, lambda: self.node.create_client(
            kind, topic, qos_profile=SERVICE_QOS, callback_group=self.answers))

    @property
    def goals(self) -> Goals:
        """What sends goals."""
        return self._once('goals', lambda: Goals(
            self.node, self._liveness(PLANNER), self._group, self.answers))

    def _observed(self, name: str) -> Observations:
        return self._once(name, lambda: observe(self.node, name, self._group))

    def _liveness(self, name: str) -> Liveness:
        return self._once(name, lambda: Liveness(self.node, name, self._group))

    def _timeout(self, timeout_s: float | None) -> float:
        return self.timeout_s if timeout_s is None else seconds_of(timeout_s)
