// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

const COLOURS = ['#ffb000', '#648fff', '#dc267f', '#009e73'];  // as in tap_ros/pictures.py
const LEVELS = ['OK', 'WARN', 'ERROR', 'STALE'];
const RECONNECT_MS = 1000;
const NEAR = 0.08;  // share of the picture's width within which a press takes an object

const $ = (id) => document.getElementById(id);
const pictures = {};  // kind -> ImageBitmap
const numbers = {};  // kind -> how many have come
let state = null;
let socket = null;
let drag = null;  // {name, u, v} while an object is dragged
let moved = null;  // the same after it, until the goal shows it
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
    if (problems !== null && message.problem.count > problems) complain(message.problem.text);
    problems = message.problem.count;
    if (moved) {
      const place = state.goal.objects.find(({name}) => name === moved.name);
      if (place && Math.hypot(place.u - moved.u, place.v - moved.v) < 1) moved = null;
    }
    showState();
  } else if (message.kind === 'history') {
    drawChart(message);
  } else if (message.kind === 'error') {
    complain(message.text);
  }
}

async function takePicture(bytes) {
  const end = bytes.indexOf(0);
  const kind = new TextDecoder().decode(bytes.subarray(0, end));
  const content = bytes.subarray(end + 1);  // empty: there is none any more
  const number = numbers[kind] = (numbers[kind] ?? 0) + 1;
  const bitmap = content.length ? await createImageBitmap(new Blob([content])) : null;
  if (number !== numbers[kind]) return;  // a newer one was decoded sooner
  if (pictures[kind]) pictures[kind].close();
  pictures[kind] = bitmap;
  if (!bitmap) $(kind).getContext('2d').reset();
  draw(kind);
}

function send(command) {
  $('error').textContent = '';
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(command));
}

function complain(text) {
  $('error').textContent = text;
  moved = null;
  drawGoal();
}

function show(id, text, mark = '') {
  $(id).textContent = text;
  $(id).className = `pill ${mark}`;
}

function enable(connected) {
  const running = !connected || state.run.running;
  for (const id of ['predict', 'photograph']) $(id).disabled = !connected;
  for (const id of ['direct', 'subgoal-run']) $(id).disabled = running || !state.plans;
  $('scene').querySelector('button').disabled = running || !state.simulator;
  $('cancel').disabled = !connected || !state.run.running;
}

function showState() {
  const {run, goal, camera} = state;
  show('run', run.text, run.running ? 'busy' : '');
  enable(true);
  $('camera-note').textContent = camera.note;
  $('goal-note').textContent = goal.note;
  $('subgoal-note').textContent = state.subgoal_note;
  $('scene').hidden = !state.simulator;
  $('photograph').hidden = state.simulator;
  $('goal').classList.toggle('fixed', !state.movable);
  $('goal-hint').textContent = state.movable
    ? 'Drag an object to where it should be.' : 'The goal of the planner.';
  $('plan-hint').textContent = state.plans
    ? 'Ways of the fingertips that the planner considered; bold: the chosen one.'
    : `Nothing plans how to grasp: for ${state.task} subgoals are predicted only.`;
  if (state.tasks.join() !== [...$('task').options].map((o) => o.value).join()) {
    $('task').replaceChildren(...state.tasks.map((task) => new Option(task, task)));
    $('task').value = '';
  }
  if (!$('task').value) $('task').value = state.task || state.tasks[0];
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
  draw('camera');
  draw('goal');
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

function fill(parent, items, make) {
  parent.replaceChildren(...items.map(make));
}

// Pictures

function draw(kind) {
  if (kind === 'goal') {
    drawGoal();
  } else if (kind === 'camera') {
    const context = paint('camera');
    if (!context || !state) return;
    for (const place of state.camera.objects) circle(context, place, colourOf(place.name));
    for (const place of state.camera.targets) cross(context, place, colourOf(place.name));
  } else if ($(kind)) {
    paint(kind);
  }
}

function paint(kind) {
  const canvas = $(kind);
  const bitmap = pictures[kind];
  if (!bitmap) return null;
  const scale = Math.max(1, Math.round(512 / bitmap.width));
  if (canvas.width !== bitmap.width * scale || canvas.height !== bitmap.height * scale) {
    canvas.width = bitmap.width * scale;
    canvas.height = bitmap.height * scale;
  }
  const context = canvas.getContext('2d');
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.imageSmoothingEnabled = false;
  context.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  // From here on in pixels of the camera's picture, (0, 0) the centre of the first one.
  const size = kind === 'goal' ? state?.goal : state?.camera;
  const unit = size?.width ? canvas.width / size.width : scale;
  context.setTransform(unit, 0, 0, unit, unit / 2, unit / 2);
  context.lineWidth = 2.5 / unit * (canvas.width / 400);
  return context;
}

function colourOf(name) {
  const names = [...state.camera.objects, ...state.goal.objects].map((place) => place.name);
  return COLOURS[[...new Set(names)].indexOf(name) % 4];
}

function radius(context) {
  return context.canvas.width / context.getTransform().a * 0.035;
}

function circle(context, {u, v}, colour) {
  context.strokeStyle = colour;
  context.beginPath();
  context.arc(u, v, radius(context), 0, 2 * Math.PI);
  context.stroke();
}

function cross(context, {u, v}, colour) {
  const r = radius(context) * 0.7;
  context.strokeStyle = colour;
  context.beginPath();
  context.moveTo(u - r, v - r);
  context.lineTo(u + r, v + r);
  context.moveTo(u + r, v - r);
  context.lineTo(u - r, v + r);
  context.stroke();
}

function drawGoal() {
  const context = paint('goal');
  if (!context || !state) return;
  const held = drag ?? moved;
  for (const place of state.goal.objects) {
    const colour = colourOf(place.name);
    circle(context, place, colour);
    if (held && held.name === place.name) {
      context.strokeStyle = colour;
      context.beginPath();
      context.moveTo(place.u, place.v);
      context.lineTo(held.u, held.v);
      context.stroke();
      cross(context, held, colour);
    }
  }
}

function pixelOf(event) {
  const box = $('goal').getBoundingClientRect();
  return {u: (event.clientX - box.left) / box.width * state.goal.width - 0.5,
          v: (event.clientY - box.top) / box.height * state.goal.height - 0.5};
}

$('goal').addEventListener('pointerdown', (event) => {
  if (!state || !state.movable || !pictures.goal) return;
  const at = pixelOf(event);
  let best = NEAR * state.goal.width;
  for (const {name, u, v} of state.goal.objects) {
    const away = Math.hypot(u - at.u, v - at.v);
    if (away < best) {
      best = away;
      drag = {name, ...at};
    }
  }
  if (drag) {
    $('goal').setPointerCapture(event.pointerId);
    drawGoal();
  }
});
$('goal').addEventListener('pointermove', (event) => {
  if (drag) {
    Object.assign(drag, pixelOf(event));
    drawGoal();
  }
});
$('goal').addEventListener('pointerup', () => {
  if (drag) {
    send({do: 'move', ...drag});
    moved = drag;
    drag = null;
    drawGoal();
  }
});
$('goal').addEventListener('pointercancel', () => {
  drag = null;
  drawGoal();
});

// Distances

function drawChart({unit, names, times, values}) {
  const canvas = $('chart');
  const context = canvas.getContext('2d');
  const style = getComputedStyle(document.body);
  const [left, bottom, right, top] = [40, canvas.height - 24, canvas.width - 8, 8];
  const source = unit === 'cm' && state?.simulator ? ", the simulator's ground truth" : '';
  $('unit').textContent = unit ? `in ${unit}${source}` : '';
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.font = '12px system-ui, sans-serif';
  context.fillStyle = style.color;
  context.lineWidth = 1;
  if (!times.length) {
    context.fillText('No objects and goal objects were seen yet.', left, 40);
    $('legend').replaceChildren();
    return;
  }
  const most = Math.max(1e-6, ...values.flat()) * 1.1;
  const span = Math.max(1, times.at(-1) - times[0]);
  const x = (time) => left + (time - times[0]) / span * (right - left);
  const y = (value) => bottom - value / most * (bottom - top);
  const step = niceStep(most / 4);
  context.textAlign = 'right';
  for (let value = 0; value < most; value += step) {
    context.strokeStyle = 'rgba(128, 128, 128, .3)';
    context.beginPath();
    context.moveTo(left, y(value));
    context.lineTo(right, y(value));
    context.stroke();
    context.fillText(String(+value.toFixed(3)), left - 6, y(value) + 4);
  }
  context.textAlign = 'center';
  context.fillText('0 s', left, canvas.height - 6);
  context.textAlign = 'right';
  context.fillText(`${span.toFixed(0)} s`, right, canvas.height - 6);
  values.forEach((line, k) => {
    context.strokeStyle = state ? colourOf(names[k]) : COLOURS[k % 4];
    context.lineWidth = 2;
    context.beginPath();
    line.forEach((value, i) => context.lineTo(x(times[i]), y(value)));
    context.stroke();
  });
  fill($('legend'), names.map((name, k) => [name, values[k].at(-1), k]), ([name, value, k]) => {
    const item = document.createElement('li');
    const mark = document.createElement('i');
    mark.style.background = state ? colourOf(name) : COLOURS[k % 4];
    item.append(mark, `${name}: ${value.toFixed(1)} ${unit}`);
    return item;
  });
}

function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((m) => m * power).find((s) => s >= least);
}

// Buttons

const choices = () => ({
  samples: Number($('samples').value), levels: Number($('levels').value), seed: 0});

for (const id of ['samples', 'levels']) {
  $(id).addEventListener('input', () => {
    document.querySelector(`output[for=${id}]`).value = $(id).value;
  });
}
$('scene').addEventListener('submit', (event) => {
  event.preventDefault();
  send({do: 'reset', task: $('task').value, seed: Math.max(0, Math.round(Number($('seed').value)))});
});
$('predict').addEventListener('click', () => send({do: 'predict', ...choices()}));
$('direct').addEventListener('click', () => send({do: 'reach', mode: 'direct', ...choices()}));
$('subgoal-run').addEventListener('click', () => send({do: 'reach', mode: 'subgoal', ...choices()}));
$('cancel').addEventListener('click', () => send({do: 'cancel'}));
$('photograph').addEventListener('click', () => send({do: 'photograph'}));

connect();
