// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

// What pointer and keys do to the pictures: objects to follow, and their goals.

const NEAR = 0.08;  // share of the picture's width within which a press takes an object
const STEP = 0.005, LEAP = 0.05;  // shares by which an arrow key moves the cursor

let selections = null;  // number of the newest selection that came
let asked = false;  // for proposals

// Objects to follow

function takeSelection({count, followed, objects}) {
  const fresh = selections !== null && count !== selections;
  selections = count;
  if (followed) {
    outlines = Object.fromEntries(objects.map(({name, outline}) => [name, outline]));
    if (fresh && count) choose(false);
  } else if (fresh && asked) {
    asked = false;
    const near = NEAR * state.camera.width;  // what was clicked already stays
    for (const one of objects) {
      if (clicks.every(({u, v}) => Math.hypot(u - one.u, v - one.v) > near)) addClick(one);
    }
    if (!objects.length) showError('Nothing differs from the goal picture; click each object.');
  }
  if (state) drawAll();
}

function choose(on) {
  if (on === selecting) return;
  selecting = on;
  clicks = [];
  large = '';
  $('select').setAttribute('aria-pressed', on);
  $('selection').hidden = !on;
  showClicks();
  if (state) showState();
}

function propose() {
  asked = true;
  send({do: 'propose'});
}

function follow() {
  if (clicks.length) {
    send({do: 'select', objects: clicks.map(({name, u, v}) => ({name, u, v}))});
  } else {
    showError('Click each object in the camera picture first.');
  }
}

function showClicks() {
  fill($('clicks'), clicks, (one, k) => {
    const item = document.createElement('li');
    const name = document.createElement('input');
    name.value = one.name;
    name.maxLength = 40;
    name.setAttribute('aria-label', `name of object ${k + 1}`);
    name.addEventListener('input', () => { one.name = name.value.trim(); });
    const remove = document.createElement('button');
    remove.type = 'button';
    remove.textContent = '✕';
    remove.title = 'do not follow this one';
    remove.addEventListener('click', () => {
      clicks.splice(k, 1);
      showClicks();
    });
    item.append(mark(COLOURS[k % 4]), name, remove);
    return item;
  });
  if (state) draw('camera');
}

function addClick({u, v, outline}) {
  const names = clicks.map(({name}) => name);
  let k = 0;
  while (names.includes(`object_${k}`)) k += 1;
  clicks.push({name: `object_${k}`, u, v, outline});
  showClicks();
}

// Pointer and keys

function press(kind, at) {
  if (kind === 'camera' && selecting) {
    addClick(at);
  } else if (state?.movable === kind && pictures[kind]) {
    let best = NEAR * state[kind].width;
    for (const {name, u, v} of kind === 'goal' ? goalPlaces() : targets()) {
      const away = Math.hypot(u - at.u, v - at.v);
      if (away < best) {
        best = away;
        drag = {kind, name, ...at};
      }
    }
    draw(kind);
  }
}

function shift(kind, at) {
  if (drag) {
    Object.assign(drag, at);
    draw(kind);
  }
}

function release(kind) {
  const {name, u, v} = drag;
  send({do: 'move', name, u, v});
  moved = {...drag, until: JSON.stringify(state.goal.objects)};
  drop();
}

function drop() {
  drag = null;
  drawAll();
}

for (const kind of ['camera', 'goal']) {
  const canvas = $(kind);
  const pixelOf = (event) => {
    const box = canvas.getBoundingClientRect();
    return {u: (event.clientX - box.left) / box.width * state[kind].width - 0.5,
            v: (event.clientY - box.top) / box.height * state[kind].height - 0.5};
  };
  canvas.addEventListener('pointerdown', (event) => {
    if (!state?.[kind].width) return;
    press(kind, pixelOf(event));
    if (drag) canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener('pointermove', (event) => drag && shift(kind, pixelOf(event)));
  canvas.addEventListener('pointerup', () => drag && release(kind));
  canvas.addEventListener('pointercancel', drop);
  canvas.addEventListener('blur', () => draw(kind));
  canvas.addEventListener('keydown', (event) => {
    const size = state?.[kind];
    if (!size?.width) return;
    if (cursor?.kind !== kind) cursor = {kind, u: size.width / 2, v: size.height / 2};
    const arrow = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[
      event.key];
    if (arrow) {
      const step = (event.shiftKey ? LEAP : STEP) * size.width;
      cursor.u = Math.min(Math.max(cursor.u + step * arrow[0], 0), size.width - 1);
      cursor.v = Math.min(Math.max(cursor.v + step * arrow[1], 0), size.height - 1);
      shift(kind, {u: cursor.u, v: cursor.v});
    } else if (event.key === 'Enter' && drag) {
      release(kind);
    } else if (event.key === 'Enter') {
      press(kind, {u: cursor.u, v: cursor.v});
    } else {
      return;
    }
    event.preventDefault();
    draw(kind);
  });
}
for (const button of document.querySelectorAll('figcaption button')) {
  const kind = button.closest('figure').querySelector('canvas').id;
  button.addEventListener('click', () => {
    large = large === kind ? '' : kind;
    if (state) showLarge();
  });
}
