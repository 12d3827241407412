# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What browsers may ask for, as JSON checked field by field, and how the other nodes do it."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
import json
import threading
import time
from typing import Any

from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.node import Node
from rclpy.qos import qos_profile_action_status_default
from tap_msgs.action import ReachGoal
from tap_ros.apps.explorer.display import Display, GoalByHand, simulated
from tap_ros.apps.explorer.words import clicks_named, plain, renamed
from tap_ros.base.contract import step_budget
from tap_ros.base.errors import TapError
from tap_ros.base.text import escaped
from tap_ros.messages.objects import MAX_NAME, MAX_OBJECTS
from tap_ros.ros.calls import CallError, reason
from tap_ros.ros.client import Client
from tap_ros.ros.heartbeat import Presence, publishers_present
from tap_ros.ros.reaching import Reaching, STATUS
from tap_ros.weights import PREDICTORS

TIMEOUT_S = 20.0  # of a service
GOAL_TIMEOUT_S = 600.0  # of a goal: 75 steps take half a minute
STEP_BUDGET = 80  # of a goal in the simulator; for a real arm the usual limit holds
END_S = 6.0  # that a cancel may take when the node ends
LARGEST = 1e6  # of a pixel
UNDER_WAY = (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING, GoalStatus.STATUS_CANCELING)


class CommandError(TapError):
    """A browser asked for what cannot be done."""


_TEXT = (f'a text of at most {MAX_NAME} characters that print', lambda value: (
    isinstance(value, str) and len(value) <= MAX_NAME and value.isprintable()))
_PIXEL = ('a number', lambda value: type(value) in (int, float) and abs(value) < LARGEST)
_PLACE = {'name': _TEXT, 'u': _PIXEL, 'v': _PIXEL}
_SEED = ('a whole number, 0 or more', lambda value: type(value) is int and 0 <= value <= 2**62)
COMMANDS: dict[str, dict[str, tuple[str, Callable[[Any], bool]]]] = {  # do: {field: what is valid}
    'reset': {'task': _TEXT, 'seed': _SEED},  # an empty task is that of now
    'predict': {},
    'reach': {'mode': ("'direct' or 'subgoal'", lambda value: value in ('direct', 'subgoal'))},
    'cancel': {},
    'select': {'objects': (
        f'1 to {MAX_OBJECTS} objects, each with name, u and v', lambda value: (
            isinstance(value, list) and 0 < len(value) <= MAX_OBJECTS and all(
                isinstance(one, dict) and _PLACE.keys() == one.keys()
                and all(valid(one[field]) for field, (_, valid) in _PLACE.items())
                for one in value)))},  # to follow, by a click on each in the camera's picture
    'propose': {},  # objects to follow
    'move': _PLACE,  # an object's goal, in the picture where the page drags them
    'photograph': {}}  # take the camera's newest picture as the goal
REFUSED = {  # of each, when it could not be done
    'reset': 'no new scene', 'predict': 'no subgoal', 'reach': 'the arm stopped',
    'cancel': 'not cancelled', 'select': 'not taken', 'propose': 'nothing found',
    'move': 'the goal was not moved', 'photograph': 'no goal picture'}


def parse_command(text: str | bytes) -> tuple[str, dict[str, Any]]:
    """
    Read what a browser sent.

    :param text: JSON such as {"do": "reach", "mode": "direct"}.
    :return: one of COMMANDS and its fields.
    :raises CommandError: if it is none; the message names the field and what would be right.
    """
    try:
        sent = json.loads(text)
    except (ValueError, RecursionError):
        sent = None
    if not isinstance(sent, dict):
        raise CommandError('a command is a JSON object')
    do = sent.get('do')
    if not isinstance(do, str) or do not in COMMANDS:
        raise CommandError(
            f'do: expected one of {", ".join(COMMANDS)}, got {escaped(do, 40)!r}')
    for field, (expected, valid) in COMMANDS[do].items():
        if not valid(sent.get(field)):
            raise CommandError(
                f'{field}: expected {expected}, got {escaped(sent.get(field), 40)!r}')
    return do, {field: sent[field] for field in COMMANDS[do]}


class ExplorerCalls:
    """
    Carries out the commands of browsers, each in a thread of its own; one goal at a time.

    :param node: rclpy Node that another thread spins.
    :param display: that shows what happens.
    :param on_error: called with what went wrong for which nobody but us is to blame.
    :param on_selected: called when other objects are followed.
    :ivar end: how the last goal of a browser ended, in words; whether it was reached, or stopped
        because its steps were spent; its mode, '' without one.
    :ivar to_subgoal: whether it is under way, to its subgoal.
    """

    def __init__(self, node: Node, display: Display, on_error: Callable[[str], object],
                 on_selected: Callable[[], object]) -> None:
        self._node, self._display = node, display
        self._on_error, self._on_selected = on_error, on_selected
        self._by_hand = GoalByHand(node)
        self._client = Client(node=node, timeout_s=TIMEOUT_S)
        self._lock = threading.Lock()
        self._goal: Reaching | None = None
        self._asked = self._cancelled = self._ending = False  # asked: by a browser, for a goal
        self._ours = False  # the goal under way was asked for by a browser
        self._stage, self._most = '', 0  # most steps of the goal
        self.to_subgoal = False
        self.forget_end()
        self._under_way = False  # a goal, whoever sent it
        self._planner: Presence | None = None  # that said so
        node.create_subscription(GoalStatusArray, STATUS, self._on_status,
                                 qos_profile_action_status_default)
        self._pool = ThreadPoolExecutor(4, 'explorer')
        self._cancelling = ThreadPoolExecutor(1, 'cancel')  # not behind what waits for its answer

    def offered(self, service: str) -> bool:
        """Return whether a node offers a service, such as 'reset', 'set_goal' and 'select'."""
        return self._client.is_ready(service)

    @property
    def running(self) -> bool:
        """Whether a goal is in progress, whoever sent it."""
        return self._asked or (
            self._under_way and self._planner is not None and not self._planner.gone)

    @property
    def stage(self) -> str:
        """What the goal in progress is doing."""
        return self._client.silence('visual_mpc_node') or (
            'cancelling' if self._cancelled else self._stage or (
                'ending' if self._ours else "another client's goal"))

    def forget_end(self, said: str = '', reached: bool = False, spent: bool = False,
                   mode: str = '') -> None:
        """Forget how the last goal ended: there is another one, or it ended in another way."""
        self.end: dict[str, Any] = {
            'end': said, 'reached': reached, 'spent': spent, 'mode': mode}

    def do(self, text: str | bytes) -> None:
        """
        Begin what a browser asks for.

        :raises CommandError: when it makes no sense, or cannot begin now.
        """
        do, fields = parse_command(text)
        with self._lock:
            if do == 'cancel':
                if not self.running:
                    raise CommandError('nothing is in progress that could be cancelled')
                self._cancelled = True  # also one that is about to begin
                if self._goal is not None:
                    self._goal.cancel()
                    return
                if not self._under_way:
                    return
            if do == 'reach':
                if self.running:
                    raise CommandError('a goal is in progress; cancel it or wait for its end')
                self._asked, self._ours, self._cancelled = True, True, False
        pool = self._cancelling if do == 'cancel' else self._pool
        pool.submit(self._carry_out, do, fields)

    def close(self) -> None:
        """Cancel the goal that a browser began, and end; in the thread that spins the node."""
        self._ending = self._cancelled = True
        closing, executor = self._cancelling.submit(self._client.close), self._node.executor
        deadline = time.monotonic() + END_S
        while executor is not None and time.monotonic() < deadline and (
                self._asked or not closing.done()):
            executor.spin_once(timeout_sec=0.05)  # nobody else does any more
        for pool in (self._pool, self._cancelling):
            pool.shutdown(wait=False, cancel_futures=True)

    def _on_status(self, message: GoalStatusArray) -> None:
        with self._lock:
            self._under_way = any(one.status in UNDER_WAY for one in message.status_list)
            self._forget_goal()
        self._planner = publishers_present(self._node, STATUS) if self._under_way else None

    def _forget_goal(self) -> None:
        """Forget whose goal it was once none is in progress."""
        if not (self._under_way or self._asked):
            self._ours = self._cancelled = False

    # In the threads of the pool

    def _carry_out(self, do: str, fields: dict[str, Any]) -> None:
        try:
            getattr(self, f'_{do}')(**fields)
        except Exception as error:
            if do == 'cancel':
                self._cancelled = False
            if isinstance(error, TapError) or not self._ending:  # else it is being taken down
                text = escaped(reason(self._node, do, error), 1000)
                said = f'{REFUSED[do]}: {plain(text)}'
                self._display.events.add(said, problem=True)
                if do == 'reach':
                    self.forget_end(said, **fields)
                if isinstance(error, TapError):
                    self._node.get_logger().info(f'{do}: {text}')
                else:
                    self._on_error(text)
        finally:
            if do == 'reach':
                with self._lock:
                    self._asked, self._goal, self._stage = False, None, ''
                    self.to_subgoal = False
                    self._forget_goal()

    def _call(self, service: str, **fields: Any) -> Any:
        return self._client.call(service, give_up=lambda: self._ending, **fields)

    def _reset(self, task: str, seed: int) -> None:
        self._call('reset', task=task, seed=seed)
        if task in PREDICTORS and self._client.is_ready('predict'):
            weights = self._client.weights()
            if weights not in PREDICTORS:
                self._display.events.add(
                    f'the predictor keeps {escaped(weights)}, which may not know {task}')
            elif weights != task and not weights.startswith(f'{task}_'):
                self._client.use_weights(task)
                self._display.events.add(f'the predictor has the weights of {task} now')

    def _select(self, objects: list[dict[str, Any]]) -> None:
        try:
            response = self._call('select', names=[one['name'] for one in objects],
                                  u=[float(one['u']) for one in objects],
                                  v=[float(one['v']) for one in objects])
        except CallError as error:
            raise CallError(clicks_named(str(error), objects)) from error
        self._on_selected()
        self._display.select(response, followed=True)
        self._display.events.add(clicks_named(escaped(response.message, 1000), objects),
                                 problem=len(response.objects) < len(objects))

    def _propose(self) -> None:
        response = self._call('select', propose=True)
        self._display.select(response, followed=False)
        self._display.events.add(
            f'found {len(response.objects)}, which the goal shows elsewhere')

    def _move(self, name: str, u: float, v: float) -> None:
        display = self._display
        goals = display.places('goal_objects')
        truth = display.places('true_goals') or goals
        their = simulated(goals, truth, display.size('goal')['width']) if (
            self.offered('set_goal')) else {}
        size, to = display.size('goal' if 'goal' in display.newest else 'camera'), (u, v)
        if name in their:
            du, dv = (there - here for there, here in zip(truth[their[name]], goals[name]))
            to = u + du, v + dv
        if size['width'] and not all(-0.5 <= one <= most - 0.5
                                     for one, most in zip(to, size.values())):
            raise CallError(f'{escaped(name)} would be outside the picture')
        if name in their:
            try:
                self._client.set_goal({their[name]: to})
            except CallError as error:
                raise CallError(renamed(str(error), dict.fromkeys(
                    truth, 'an object that is not followed') | {
                        each: here for here, each in their.items()})) from error
        else:
            self._by_hand.place(name, to, {
                kind: message for kind, (message, _) in display.newest.copy().items()})
        display.events.add(f'goal: {escaped(name)} to pixel {u:.0f}, {v:.0f}', 'goal')

    def _photograph(self) -> None:
        if self.offered('reset'):
            raise CallError('the simulator takes its goal pictures itself')
        self._by_hand.photograph(
            self._display.newest.get('camera'), followed=self.offered('select'))
        self._display.events.add('goal: what the camera sees now', 'goal')

    def _cancel(self) -> None:
        self._call('cancel')
        self._display.events.add('cancel: the planner ends its goal, whoever sent it')

    def _predict(self) -> None:
        response = self._call('predict')
        self._display.events.add(f'predicted in {response.model_time_ms:.0f} ms: '
                                 f'{escaped(response.message, 300)}', 'subgoal')

    def _reach(self, mode: str) -> None:
        words = 'via subgoal' if mode == 'subgoal' else 'direct'
        self._stage = f'{words}: waiting for the planner'
        self.to_subgoal = False
        self.forget_end(mode=mode)
        cancelled = self._cancelled
        if cancelled:
            raise CallError(f'{words}: cancelled before it began')
        self._most = STEP_BUDGET if self.offered('reset') else step_budget(
            len(self._display.places('objects')))
        goal = self._client.reach(
            mode=mode, step_budget=self._most,
            on_feedback=self._on_feedback, timeout_s=GOAL_TIMEOUT_S)
        with self._lock:
            self._goal, cancelled = goal, self._cancelled
        if cancelled:  # meanwhile
            goal.cancel()
        self._display.events.add(f'{words}: begun')
        result = goal.result()
        end = 'cancelled' if result.end == 'cancelled' else plain(escaped(result.message, 1000))
        spent = result.end == 'succeeded' and not result.success
        end = f'{words}: {end}' + ('' if spent else f' ({result.steps} steps)')
        self.forget_end(end, result.success, spent, mode)
        self._display.events.add(end)

    def _on_feedback(self, feedback: ReachGoal.Feedback) -> None:
        self.to_subgoal = feedback.stage.startswith('subgoal')
        self._stage = (
            f'step {feedback.step} of at most {self._most}, to the {escaped(feedback.stage, 60)}, '
            f'plan in {feedback.planning_ms:.0f} ms with {feedback.plan_samples} samples')
