// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

// Pictures, and what is drawn over them.

const COLOURS = ['#ffb000', '#648fff', '#dc267f', '#009e73'];  // as in tap_ros/images/drawing.py
const STATES = {  // of an object that is followed
  seen: 'seen', hidden: 'hidden', unsure: 'unsure', lost: 'lost, select it again'};
const STATE_COLOURS = {seen: '#2fbf5b', hidden: '#9aa6b8', unsure: '#ff9f1c', lost: '#e5484d'};
const SHARP = 1024;  // least width (px) to which a picture is drawn, each pixel a square

const $ = (id) => document.getElementById(id);
const fill = (parent, items, make) => parent.replaceChildren(...items.map(make));
let state = null;
const pictures = {};  // kind -> ImageBitmap
const numbers = {};  // kind -> how many have come
let outlines = {};  // name -> outline of an object that is followed, relative to its pixel
let selecting = false;
let clicks = [];  // {name, u, v, outline} of objects to follow
let large = '';  // kind of the picture that somebody wants large
let drag = null;  // {kind, name, u, v} while an object is dragged
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
  if (!bitmap) $(kind).getContext('2d').reset();
  draw(kind);
}

/* The picture that somebody chose is large, else that which is to be clicked, else the robot. */
function showLarge() {
  const wanted = large || (selecting || state.movable === 'camera' ? 'camera' : 'observer');
  const kind = wanted === 'observer' && !state.observer ? 'camera' : wanted;
  for (const figure of document.querySelectorAll('main figure')) {
    figure.classList.toggle('large', figure.querySelector('canvas').id === kind);
  }
}

// Drawing, in pixels of the camera's picture, (0, 0) the centre of the first one

function drawAll() {
  for (const kind of ['camera', 'goal']) draw(kind);
}

function draw(kind) {
  const context = paint(kind);
  if (!context || !state) return;
  if (kind === 'camera' && selecting) {
    clicks.forEach((one, k) => drawOutlined(context, one, COLOURS[k % 4], one.outline));
  } else if (kind === 'camera') {
    for (const one of state.camera.objects) {
      drawOutlined(context, one, colourOf(one.name), outlines[one.name]);
    }
    for (const one of state.camera.targets) cross(context, one, colourOf(one.name));
    if (state.movable === 'camera') drawDragged(context, kind, targets());
  } else if (kind === 'goal') {
    const missing = missingGoals();
    for (const one of goalPlaces()) {
      const known = missing.some(({name}) => name === one.name) ? 'lost' : '';
      drawOutlined(context, {...one, state: known}, colourOf(one.name),
        known && outlines[one.name]);
    }
    drawDragged(context, kind, goalPlaces());
  }
  if (cursor?.kind === kind && document.activeElement === $(kind)) {
    cross(context, cursor, '#fff', 0);
  }
}

function paint(kind) {
  const canvas = $(kind);
  const bitmap = pictures[kind];
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
  const size = kind === 'goal' ? state?.goal : state?.camera;
  const unit = size?.width ? canvas.width / size.width : scale;
  context.setTransform(unit, 0, 0, unit, unit / 2, unit / 2);
  context.lineWidth = 2.5 / unit * (canvas.width / 550);
  return context;
}

function colourOf(name) {
  const names = [...state.camera.objects, ...state.goal.objects].map((place) => place.name);
  return COLOURS[[...new Set(names)].indexOf(name) % 4];
}

function mark(colour) {
  const item = document.createElement('i');
  item.style.background = colour;
  return item;
}

function radius(context) {
  return context.canvas.width / context.getTransform().a * 0.035;
}

/* An outline moves with its object's pixel: it is not turned, and shows no angle. */
function drawOutlined(context, {u, v, state: known}, colour, outline) {
  const r = radius(context);
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

function drawDragged(context, kind, places) {
  const held = drag ?? moved;
  const from = held?.kind === kind && places.find(({name}) => name === held.name);
  if (!from) return;
  drawOutlined(context, held, colourOf(held.name), outlines[held.name]);
  context.beginPath();
  context.moveTo(from.u, from.v);
  context.lineTo(held.u, held.v);
  context.stroke();
  cross(context, held, colourOf(held.name));
}

// Goals

/* Followed objects that have no goal, or were not found in the goal picture. */
function missingGoals() {
  const known = state.goal.objects.filter((one) => one.state !== 'lost').map(({name}) => name);
  return state.camera.objects.filter(({name}) => !known.includes(name));
}

/* What is shown and dragged in the goal picture; what has no goal begins where it is now. */
function goalPlaces() {
  const names = state.goal.objects.map(({name}) => name);
  return [...state.goal.objects,
    ...state.camera.objects.filter(({name}) => !names.includes(name))];
}

/* What can be dragged in the camera's picture: goals, and objects that have none yet. */
function targets() {
  const {objects, targets: goals} = state.camera;
  return objects.map((one) => goals.find(({name}) => name === one.name) ?? one);
}
