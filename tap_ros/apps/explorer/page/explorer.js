// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

const LEVELS = ['OK', 'WARN', 'ERROR', 'STALE'];
const RECONNECT_MS = 1000;

let socket = null;
let problems = null;  // how many this page has shown

function connect() {
  socket = new WebSocket(
    `${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/socket${location.search}`);
  socket.binaryType = 'arraybuffer';
  socket.onopen = () => show('link', 'connected', 'good');
  socket.onclose = () => {
    show('link', 'no connection; trying again', 'bad');
    enable(false);
    setTimeout(connect, RECONNECT_MS);
  };
  socket.onmessage = ({data}) => {
    if (typeof data === 'string') {
      take(JSON.parse(data));
    } else {
      takePicture(new Uint8Array(data));
    }
  };
}

function take(message) {
  if (message.kind === 'state') {
    state = message;
    if (problems !== null && message.problem.count > problems) showError(message.problem.text);
    problems = message.problem.count;
    if (moved && JSON.stringify(state.goal.objects) !== moved.until) moved = null;
    showState();
  } else if (message.kind === 'selection') {
    takeSelection(message);
  } else if (message.kind === 'error') {
    showError(message.text);
  }
}

function send(command) {
  $('error').textContent = '';
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(command));
}

function showError(text) {
  $('error').textContent = text;
  moved = null;
  drawAll();
}

function show(id, text, mark = '') {
  $(id).textContent = text;
  $(id).className = `pill ${mark}`;
}

function enable(connected) {
  const running = !connected || state.run.running;
  for (const id of ['predict', 'photograph', 'select', 'propose', 'follow']) {
    $(id).disabled = !connected;
  }
  $('direct').disabled = running || !state.plans;
  $('subgoal-run').disabled = running || !state.plans || !state.goal.pictured;
  $('scene').querySelector('button').disabled = running || !state.simulator;
  $('cancel').disabled = !connected || !state.run.running;
}

function showState() {
  const {run, goal, camera} = state;
  show('run', run.running ? run.stage || 'starting' : 'idle', run.running ? 'busy' : '');
  enable(true);
  $('camera-note').textContent = camera.note;
  $('goal-note').textContent = goal.pictured ? '' : 'none yet';
  $('scene').hidden = !state.simulator;
  $('photograph').hidden = state.simulator;
  $('select').hidden = !state.tracker;
  if (!state.tracker) choose(false);
  $('observer-figure').hidden = !state.observer;
  showLarge();
  for (const kind of ['camera', 'goal']) {
    $(kind).className = kind === 'camera' && selecting ? 'click'
      : state.movable === kind ? 'drag' : '';
  }
  $('camera-hint').textContent = cameraHint();
  $('goal-hint').textContent = goalHint();
  $('plan-hint').textContent = state.plans
    ? 'Ways of the fingertips that the planner considered; bold: the chosen one.'
    : `Nothing plans how to grasp: for ${state.task} subgoals are predicted only.`;
  if (state.tasks.join() !== [...$('task').options].map((o) => o.value).join()) {
    $('task').replaceChildren(...state.tasks.map((task) => new Option(task, task)));
    $('task').value = '';
  }
  if (!$('task').value) $('task').value = state.task || state.tasks[0];
  const known = camera.objects.filter((one) => one.state);
  $('states').hidden = !known.length;
  fill($('states'), known, (one) => {
    const item = document.createElement('li');
    item.className = one.state;
    item.append(mark(colourOf(one.name)), `${one.name}: ${STATES[one.state]}, `
      + `${Math.round(100 * one.confidence)} %`);
    return item;
  });
  fill($('diagnostics'), byNode(state.diagnostics), ([name, parts]) => {
    const row = document.createElement('tr');
    const level = Math.max(...parts.map((part) => part.level));
    const wrong = parts.filter((part) => part.level > 0)
      .map((part) => `${part.what}: ${part.message}`);
    for (const text of [name, LEVELS[level] ?? '?', wrong.join('; ')]) {
      row.insertCell().textContent = text;
    }
    return row;
  });
  fill($('log'), [...state.log].reverse(), (text) => {
    const line = document.createElement('li');
    line.textContent = text;
    return line;
  });
  $('log').start = state.log_count;
  drawAll();
}

function cameraHint() {
  if (selecting) return 'Click the middle of each object, name it below, then press follow.';
  if (state.movable === 'camera') return 'Drag each object to where it should be.';
  if (state.tracker && !state.camera.objects.length) {
    return 'Nothing is followed yet: press "select objects" and click each one.';
  }
  return 'Circles: where objects are. Crosses: where they should be.';
}

function goalHint() {
  if (!state.goal.pictured) {
    return state.simulator ? 'No goal picture yet.'
      : 'Arrange the objects and press "photograph the goal"'
        + (state.tracker ? ', or drag them in the camera picture.' : '.');
  }
  const missing = missingGoals().map(({name}) => name);
  if (missing.length && state.movable) {
    return `Not found here: ${missing.join(', ')}. Drag each to where this picture shows it.`;
  }
  return state.movable === 'goal'
    ? 'Drag an object to where it should be.' : 'The goal of the planner.';
}

function byNode(diagnostics) {
  const nodes = new Map();
  for (const {name, level, message} of diagnostics) {
    const [node, what] = name.split(': ', 2);
    if (!nodes.has(node)) nodes.set(node, []);
    nodes.get(node).push({what, level, message});
  }
  return [...nodes];
}

// Buttons and keys

$('scene').addEventListener('submit', (event) => {
  event.preventDefault();
  send({do: 'reset', task: $('task').value, seed: Math.max(0, Math.round(Number($('seed').value)))});
});
$('predict').addEventListener('click', () => send({do: 'predict'}));
$('direct').addEventListener('click', () => send({do: 'reach', mode: 'direct'}));
$('subgoal-run').addEventListener('click', () => send({do: 'reach', mode: 'subgoal'}));
$('cancel').addEventListener('click', () => send({do: 'cancel'}));
$('photograph').addEventListener('click', () => send({do: 'photograph'}));
$('select').addEventListener('click', () => choose(!selecting));
$('propose').addEventListener('click', () => propose());
$('selection').addEventListener('submit', (event) => {
  event.preventDefault();
  follow();
});
document.addEventListener('keydown', (event) => {
  if (event.key !== 'Escape' || !state) return;
  if (drag) {
    drop();
  } else if (state.run.running) {
    send({do: 'cancel'});
  } else {
    choose(false);
  }
});

connect();
