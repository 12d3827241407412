// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

// The connection, and the steps that lead from a scene to an arm that moves.

const RECONNECT_MS = 1000;
const SEARCH_MS = 4000;  // that the tracker may take for a goal picture
const STEPS = ['scene', 'objects', 'goal', 'predict', 'go'];
const VIEW = {scene: 'camera', objects: 'camera', goal: 'goal', predict: 'goal', go: 'subgoal'};  // which a step begins with

let socket = null;
let events = [];  // what happened
let waiting = -1;  // for an answer: how many events there were before it
let step = '';  // that is to be done
let sought = 0;  // until when objects are looked for in the goal picture, ms

function connect() {
  socket = new WebSocket(
    `${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/socket${location.search}`);
  socket.binaryType = 'arraybuffer';
  socket.onclose = () => {
    showRun('no connection: see the terminal of the explorer', 'bad');
    document.body.classList.add('off');
    if (state) showState();
    setTimeout(connect, RECONNECT_MS);
  };
  socket.onmessage = ({data}) => {
    if (typeof data === 'string') take(JSON.parse(data));
    else takePicture(new Uint8Array(data));
  };
}

const untracked = () => !state.tracker && !state.camera.objects.length;  // nobody tells where objects are
/* Whether the tracker still searches the goal picture: it tells of each object, found or not. */
function searching() {
  const known = state.goal.objects.map(({name}) => name);
  if (!(state.tracker && state.goal.pictured && missingGoals().some((name) => !known.includes(name)))) sought = 0;
  else if (!sought) {
    sought = Date.now() + SEARCH_MS;
    setTimeout(() => showState(), SEARCH_MS + 10);
  }
  return Date.now() < sought;
}

const objectCount = (count) => `${count} ${count === 1 ? 'object' : 'objects'}`;
const connected = () => socket.readyState === WebSocket.OPEN;

function take(message) {
  if (message.kind === 'state') {
    const before = state;
    state = message;
    Object.assign(outlines, relative(state.camera.objects));
    if (before?.scene !== state.scene) {
      $('seed').value = state.seed ?? '';
      if (state.task) $('task').value = state.task;
      step = '';
      select(false);
    }
    if (before && state.problem.count > before.problem.count) showError(state.problem.text);
    else if (before && state.events !== before.events) $('error').textContent = '';  // it went on
    if (moved && JSON.stringify(state.goal.objects) !== moved.until) moved = null;
    showState();
  } else if (message.kind === 'selection') {
    takeSelection(message);
  } else if (message.kind === 'events') {
    events = message.events;
    showEvents();
  } else if (message.kind === 'error') {
    showError(message.text);
  }
}

/* Takes back what was said of the last try: somebody goes on. */
function calm() {
  $('error').textContent = '';
}

function send(command) {
  calm();
  if (!connected()) {
    showError('There is no connection; a goal in progress goes on until its end.');
    return;
  }
  socket.send(JSON.stringify(command));
  waiting = command.do === 'cancel' ? -1 : state?.events;
  if (state) showState();
}

function showError(text) {
  $('error').textContent = text;
  waiting = -1;
  moved = null;
  asked = false;
  if (state) showState();
}

function showRun(text, mark) {
  $('run').textContent = $('run').title = text;
  $('run').className = mark;
}

/* How far each step is: [whether it is done, that in words, why it cannot be done yet]. */
function progress() {
  const {camera, goal, run, tracker, simulator} = state;
  const count = camera.objects.length, missing = missingGoals();
  const camera_why = !camera.width ? 'waits for the camera' : camera.note && `the camera ${camera.note}`;
  const goal_why = goal.pictured ? '' : 'needs a goal picture: step 3';
  const place_why = missing.length ? `needs the goal of ${missing.join(', ')}: step 3` : '';
  const predict_why = camera_why || goal_why || place_why || (!state.predictor && 'needs the predictor, which does not run');
  const go_why = !state.plans ? `the planner cannot grasp: for ${state.task} only subgoals are predicted`
    : camera_why || (!count && 'needs objects: step 2') || place_why
    || (!state.planner && 'needs the planner, which does not run');
  const known = !simulator || Boolean(state.task);  // what scene it is
  const clicked = clicks.length ? `${objectCount(clicks.length)} so far` : 'waits for objects: click on them';
  const unsure = camera.objects.filter((one) => ['unsure', 'lost'].includes(one.state)).map(({name}) => name);
  return {
    scene: [!camera_why && known, camera_why || (!known ? '' : !simulator ? `${camera.width}x${camera.height} pixels`
      : state.seed === null ? state.task : `${state.task}, seed ${state.seed}`), camera_why],
    objects: [count > 0 && !anew, selecting() ? clicked : !count ? untracked() ? 'waits for objects: start tracker_node' : 'waits for objects'
      : camera.objects_note ? `${tracker ? 'the tracker' : 'what tells their places'} ${camera.objects_note}` : unsure.length ? `not sure of ${unsure.join(', ')}` : `${objectCount(count)} known`, camera_why],
    goal: [count > 0 && !missing.length, !goal.pictured && !goal.objects.length
      ? `waits for a goal: ${simulator ? 'start a scene' : `photograph it${count ? ', or drag the objects' : ''}`}`
      : count && missing.length ? searching() ? `looking for ${missing.join(', ')}`
        : `drag ${missing.join(', ')} to ${missing.length > 1 ? 'their goals' : 'its goal'}` : goal.pictured ? 'the picture is there' : 'placed by hand',
    camera_why],
    predict: [pictures.subgoal && !state.passed, pictures.subgoal && !state.passed ? state.subgoal
      : predict_why || (pictures.subgoal ? 'the subgoal is of an earlier picture' : 'can be predicted now'), predict_why],
    go: [run.reached, run.running ? run.stage : go_why || run.end || 'the arm can go now', go_why]};
}

function showState() {
  const {run, goal} = state, done = progress(), on = connected();
  if (on && run.running) showRun(run.stage.split(', plan')[0] || 'starting', 'busy');
  else if (on) showRun(done.scene[2] || (state.planner ? 'the arm stands still' : 'no planner runs'), done.scene[2] || !state.planner ? '' : 'good');
  document.body.classList.toggle('running', on && run.running);
  document.body.classList.toggle('off', !on);
  const moves = !anew && (run.running || run.end);
  lead(moves ? 'go' : STEPS.find((one) => !done[one][0] && done[one][1]) ?? 'go', moves);
  for (const one of STEPS) {
    const item = $(`step-${one}`);
    item.classList.toggle('done', Boolean(done[one][0]));
    item.querySelector('span').textContent = done[one][1];
  }
  if (state.tasks.join() !== [...$('task').options].map((one) => one.value).join()) {
    fill($('task'), state.tasks, (task) => new Option(task, task));
    $('task').value = '';
  }
  if (!$('task').value) $('task').value = state.task;
  // What cannot work yet cannot be pressed.
  const busy = !on ? 'there is no connection' : run.running ? 'the arm moves: wait for its end, or cancel' : '';
  for (const id of ['task', 'seed']) allow(id, busy);
  allow('another', busy || (!$('task').value && 'choose a task'));
  allow('start', busy || (!($('task').value && /^\d+$/.test($('seed').value)) && 'choose a task, and a whole number as seed'));
  allow('propose', busy || done.objects[2] || (!goal.pictured && 'needs a goal picture'),
    'what differs between the picture of now and the goal');
  allow('follow', busy || done.objects[2] || (!clicks.length && 'click on the objects first'), 'they are followed from now on');
  allow('again', busy);
  allow('photograph', busy || done.goal[2]);
  allow('predict', busy || done.predict[2]);
  allow('direct', busy || done.go[2], 'to the goal at once');
  allow('subgoal-run', busy || done.go[2] || done.predict[2], 'first to a predicted subgoal');
  $('subgoal-run').classList.toggle('main', run.mode !== 'direct');  // main is what was done last
  $('direct').classList.toggle('main', run.mode === 'direct');
  $('subgoal-run').textContent = `go ${run.spent ? 'on ' : ''}via the subgoal`;
  $('direct').textContent = `go ${run.spent ? 'on ' : ''}directly`;
  $('scene').hidden = !state.simulator;
  $('photograph').hidden = state.simulator;
  $('propose').hidden = $('follow').hidden = !selecting();
  $('again').hidden = !state.tracker || (selecting() && !anew);
  $('again').textContent = anew ? 'keep the old objects' : 'choose other objects';
  $('follow').textContent = clicks.length === 1 ? 'use this object' : `use these ${clicks.length || ''} objects`.replace('  ', ' ');
  $('view-observer').parentElement.hidden = !state.observer;
  listObjects();
  const [wrong, waits] = ['wrong', 'waits'].map((how) => state.nodes.filter((one) => one.state === how).length);
  $('nodes').className = wrong ? 'wrong' : '';
  $('nodes').querySelector('span').textContent = !on || !state.nodes.length ? 'none known' : wrong ? `${wrong} of ${state.nodes.length} with a problem`
    : waits ? `${waits} of ${state.nodes.length} waiting` : 'all work';
  fill($('nodes').querySelector('tbody'), state.nodes, (one) => made('tr', {className: one.state},
    made('td', {textContent: one.name}), made('td', {textContent: one.text})));
  $('large').className = view === 'camera' && selecting() ? 'click' : movable() ? 'drag' : '';
  $('large').ariaLabel = `${VIEWS[view][0]}${$('large').className && '; arrow keys move a cross, Enter '}`
    + {click: 'marks an object', drag: 'takes and drops an object'}[$('large').className];
  $('hint').textContent = state.events === waiting ? 'Asked; the answer will come.' : pictures[view] ? hint() : '';
  draw();
}

/* Goes to the step that is to be done, once, and once its picture is there; moves: whether the arm moves there, or has. */
function lead(now, moves) {
  const at = `${now} ${moves ? `moves: ${moves}` : Boolean(pictures[VIEW[now]])}`;
  if (at === step) return;
  step = at;
  for (const one of STEPS) {
    if (one === now) $(`step-${one}`).ariaCurrent = 'step';
    else $(`step-${one}`).removeAttribute('aria-current');
  }
  open(now, moves);
}

/* Shows a step's controls, where there is no room for all, and the picture that it is about. */
function open(one, moves = state.run.end) {
  for (const other of STEPS) $(`step-${other}`).classList.toggle('open', other === one);
  look((moves && one === 'go') || !pictures[VIEW[one]] ? 'camera' : VIEW[one]);
}

function hint() {
  if (view === 'camera' && selecting()) {
    return clicks.length ? `Click the middle of the next object; if there is none, press "${$('follow').textContent}".`
      : state.simulator || state.goal.pictured ? 'Click the middle of each object that is to be moved.'
        : 'Photograph the objects where they are to be, put them back, then click the middle of each.';
  }
  const missing = missingGoals(), moves = movable(), undecided = state.subgoal.startsWith('undecided');
  return {
    camera: untracked() ? 'Start tracker_node to click on objects here.'
      : state.run.to_subgoal ? `Outlines: where objects are. ${state.camera.targets.length ? 'Crosses: where they go first, by the subgoal.' : 'They go to the subgoal first.'}`
      : state.run.reached && moves ? `Reached. Drag ${state.movable === 'goal' ? 'goals in the goal picture' : 'objects'} elsewhere and go again, or choose another scene or other objects.` : `Outlines: where objects are. Crosses: where they should be${moves ? '; drag one elsewhere to change the goal.' : '.'}`,
    goal: missing.length && searching() ? `Looking for ${missing.join(', ')} in this picture.`
      : moves && missing.length ? `${missing.every((name) => state.goal.objects.some((one) => one.name === name)) ? 'Not found in this picture' : 'No goal known yet for'}: ${missing.join(', ')}. Drag each to its place here.`
      : `What the table is to look like.${moves ? ' Drag an object to change that.' : ''}`,
    subgoal: undecided ? `The predictor is ${state.subgoal}: that glows at several places. Go directly, or drag its goal nearer.`
      : 'The predicted picture in between' + (state.camera.objects.length ? ': each object glows where it is expected then.' : '.'),
    plan: 'Paths of the fingertips that the planner considered; bold: the chosen one.',
    observer: "The camera's view, with the whole arm."}[view];
}

function showEvents() {
  if (!events.length) return;
  fill($('log'), [...events].reverse(), ({text, time, picture, problem}) => made('li', {},
    ...picture ? [made('img', {src: picture, alt: ''})] : [],
    made('div', {}, made('time', {textContent: new Date(1000 * time).toLocaleTimeString()}),
      made('p', {className: problem ? 'bad' : '', textContent: text}))));
  $('log').scrollTop = 0;
}

// Buttons and keys

function begin() {
  send({do: 'reset', task: $('task').value, seed: Number($('seed').value)});
}

function on(id, command) {
  $(id).addEventListener('click', () => send(command));
}

$('scene').addEventListener('submit', (event) => {
  event.preventDefault();
  begin();
});
$('scene').addEventListener('input', () => state && showState());
$('another').addEventListener('click', () => {
  $('seed').value = Math.floor(1e6 * Math.random());
  begin();
});
$('propose').addEventListener('click', () => {
  send({do: 'propose'});
  asked = true;
});
$('selection').addEventListener('submit', (event) => {
  event.preventDefault();
  send({do: 'select', objects: clicks.map(({name, u, v}) => ({name, u, v}))});
});
$('again').addEventListener('click', () => select(!anew));
on('photograph', {do: 'photograph'});
on('predict', {do: 'predict'});
on('direct', {do: 'reach', mode: 'direct'});
on('subgoal-run', {do: 'reach', mode: 'subgoal'});
on('cancel', {do: 'cancel'});
for (const one of STEPS) {
  $(`step-${one}`).addEventListener('click', ({target}) => { if (state && target.isConnected && !target.closest('.row')) open(one); });
}
document.addEventListener('keydown', (event) => {
  if (event.key !== 'Escape' || !state) return;
  if (drag) {
    drop();
  } else if (state.run.running) {
    send({do: 'cancel'});
  } else if (anew) {
    select(false);
  }
});

$('log').append(made('li', {className: 'soft'}, 'Nothing yet: each step leaves its time, its words and a picture here.'));
for (const one of document.querySelectorAll('#side .row button')) one.disabled = true;
connect();
