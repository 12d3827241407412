// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

// Pictures, of which one is large, and what is drawn over it.

const COLOURS = ['#ffb000', '#648fff', '#dc267f', '#009e73'];  // as in tap_ros/images/drawing.py
const STATE_COLOURS = {seen: '#2fbf5b', hidden: '#9aa6b8', unsure: '#ff9f1c', lost: '#e5484d'};
const SHARP = 1024;  // least width (px) to which a picture is drawn, each pixel a square
const SMALL = 96;  // px, of the switches
const VIEWS = {  // kind: [name, what is said without a picture: small, large]
  camera: ['now', 'what the camera sees', 'What the camera sees will be here, once it sends a picture.'],
  goal: ['goal', 'what to reach: step 3', 'The goal picture will be here: what the table is to look like.'],
  subgoal: ['subgoal', 'what comes between: step 4', 'The predicted subgoal will be here, after step 4: the picture in '
    + 'between, in which objects of step 2 glow where they are expected.'],
  plan: ['plan', 'paths of the hand: step 5', 'The newest plan will be here, once the arm moves: the paths that were '
    + 'considered, and the one that was chosen.'],
  observer: ['arm', 'the whole arm', 'The whole arm will be here, as the camera would see it.']};

let state = null;
const pictures = {};  // kind -> ImageBitmap
const numbers = {};  // kind -> how many have come
let view = 'camera';  // kind of the large picture
let outlines = {};  // name -> newest outline of an object that is followed, relative to its pixel
let clicks = [];  // {name, u, v, outline} of objects to follow
let drag = null;  // {name, u, v} while an object is dragged
let moved = null;  // the same after it, until the goal changes
let cursor = null;  // {kind, u, v}, moved by keys

async function takePicture(bytes) {
  const end = bytes.indexOf(0);
  const kind = new TextDecoder().decode(bytes.subarray(0, end));
  const content = bytes.subarray(end + 1);  // empty: there is none any more
  const number = numbers[kind] = (numbers[kind] ?? 0) + 1;
  const bitmap = content.length ? await createImageBitmap(new Blob([content])) : null;
  if (number !== numbers[kind]) return;  // a newer one was decoded sooner
  if (pictures[kind]) pictures[kind].close();
  pictures[kind] = bitmap;
  const small = $(`small-${kind}`), context = small.getContext('2d');
  small.hidden = !bitmap;
  context.reset();
  if (bitmap) {
    small.height = Math.round(SMALL * bitmap.height / bitmap.width);
    context.drawImage(bitmap, 0, 0, SMALL, small.height);
  }
  if (state) showState();
}

/* Shows a picture large. */
function look(kind) {
  view = kind;
  $(`view-${kind}`).checked = true;
  drop();
  if (state) showState();
}

for (const [kind, [name, why]] of Object.entries(VIEWS)) {
  $('views').append(made('label', {},
    made('input', {type: 'radio', name: 'view', id: `view-${kind}`, checked: kind === view, onchange: () => { calm(); look(kind); }}),
    made('canvas', {id: `small-${kind}`, width: SMALL, height: SMALL, hidden: true}), made('small', {ariaHidden: 'true'}, why), name));
}

// Drawing, in pixels of the camera's picture, (0, 0) the centre of the first one

function draw() {
  const context = paint();
  $('empty').textContent = context ? '' : VIEWS[view][2];
  if (!context || !state) return;
  if (view === 'camera' && selecting()) {
    clicks.forEach((one, k) => drawOutlined(context, one, COLOURS[k % 4], one.outline));
  } else if (view === 'camera') {
    for (const one of state.camera.objects) drawOutlined(context, one, colourOf(one.name), outlines[one.name]);
    for (const one of state.camera.targets) cross(context, one, colourOf(one.name));
  } else if (view === 'goal') {
    const missing = missingGoals();
    for (const one of goalPlaces()) {
      const known = missing.includes(one.name) ? 'lost' : '';
      drawOutlined(context, {...one, state: known}, colourOf(one.name), known && outlines[one.name]);
    }
  }
  if (movable()) drawDragged(context);
  if (cursor?.kind === view && document.activeElement === $('large')) cross(context, cursor, '#fff', 0);
}

function paint() {
  const canvas = $('large'), bitmap = pictures[view];
  canvas.hidden = !bitmap;
  if (!bitmap) return null;
  const scale = Math.max(1, Math.round(SHARP / bitmap.width));
  if (canvas.width !== bitmap.width * scale || canvas.height !== bitmap.height * scale) {
    canvas.width = bitmap.width * scale;
    canvas.height = bitmap.height * scale;
  }
  const context = canvas.getContext('2d');
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.imageSmoothingEnabled = false;
  context.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  const size = view === 'goal' ? state?.goal : state?.camera;
  const unit = size?.width ? canvas.width / size.width : scale;
  context.setTransform(unit, 0, 0, unit, unit / 2, unit / 2);
  context.lineWidth = 2.5 / unit * (canvas.width / 550);
  return context;
}

function colourOf(name) {
  const names = [...state.camera.objects, ...state.goal.objects].map((place) => place.name);
  return COLOURS[[...new Set(names)].indexOf(name) % 4];
}

const mark = (colour) => made('i', {style: `background: ${colour}`});
const radius = (context) => context.canvas.width / context.getTransform().a * 0.035;

/* Outlines relative to the pixels of their objects, with which they move until newer ones come. */
const relative = (objects) => Object.fromEntries(objects.filter(({outline}) => outline?.length).map(
  ({name, u, v, outline}) => [name, outline.map(([x, y]) => [x - u, y - v])]));

function drawOutlined(context, {name, u, v, state: known}, colour, outline) {
  const r = radius(context);
  context.font = `600 ${r}px system-ui, sans-serif`;
  context.strokeStyle = '#000a';
  context.strokeText(name, u + r, v - r);
  context.fillStyle = colour;
  context.fillText(name, u + r, v - r);
  context.strokeStyle = colour;
  context.setLineDash(known && known !== 'seen' ? [r / 2, r / 2] : []);
  context.beginPath();
  if (outline?.length) {
    for (const [du, dv] of outline) context.lineTo(u + du, v + dv);
    context.closePath();
  } else {
    context.arc(u, v, r, 0, 2 * Math.PI);
  }
  context.stroke();
  context.setLineDash([]);
  if (!known) return;
  context.fillStyle = STATE_COLOURS[known];
  context.beginPath();
  context.arc(u, v, r / 3, 0, 2 * Math.PI);
  context.fill();
}

function cross(context, {u, v}, colour, turn = 1) {
  const r = radius(context) * 0.7;
  context.strokeStyle = colour;
  context.beginPath();
  for (const [x, y] of [[1, turn], [turn, -1]]) {
    context.moveTo(u - r * x, v - r * y);
    context.lineTo(u + r * x, v + r * y);
  }
  context.stroke();
}

function drawDragged(context) {
  const held = drag ?? moved, from = held && draggable().find(({name}) => name === held.name);
  if (!from) return;
  drawOutlined(context, held, colourOf(held.name), outlines[held.name]);
  context.beginPath();
  context.moveTo(from.u, from.v);
  context.lineTo(held.u, held.v);
  context.stroke();
  cross(context, held, colourOf(held.name));
}

// Goals

/* Names of objects that have no goal, or were not found in the goal picture. */
function missingGoals() {
  const known = state.goal.objects.filter((one) => one.state !== 'lost').map(({name}) => name);
  return state.camera.objects.map(({name}) => name).filter((name) => !known.includes(name));
}

/* What is shown and dragged in the goal picture; what has no goal begins where it is now. */
function goalPlaces() {
  const names = state.goal.objects.map(({name}) => name);
  return [...state.goal.objects, ...state.camera.objects.filter(({name}) => !names.includes(name))];
}

/* What can be dragged in the large picture: goals and, where they are seen, objects. */
const draggable = () => view === 'goal' ? goalPlaces() : [...state.camera.targets, ...state.camera.objects];

/* Whether goals can be dragged in the large picture. */
const movable = () => Boolean(state?.movable) && !selecting() && (view === 'goal' ? state.movable === 'goal' : view === 'camera');
