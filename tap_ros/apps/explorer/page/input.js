// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

// What pointer and keys do to the large picture: objects to follow, and their goals.

const NEAR = 0.08;  // share of the picture's width within which a press takes an object
const STEP = 0.005, LEAP = 0.05;  // shares by which an arrow key moves the cursor

let selections = null;  // number of the newest selection that came
let asked = false;  // for proposals
let anew = false;  // others than those that are followed are wanted
let listed = false;  // whether the list is of clicks

// Objects to follow

const selecting = () => Boolean(state) && state.tracker && !state.run.running && (anew || !state.camera.objects.length);

function takeSelection({count, followed, objects}) {
  const fresh = selections !== null && count !== selections;
  selections = count;
  if (followed) {
    outlines = relative(objects);
    if (fresh) select(false);
  } else if (fresh && asked) {
    asked = false;
    const near = NEAR * state.camera.width;  // what was clicked already stays
    for (const one of objects) {
      if (clicks.every(({u, v}) => Math.hypot(u - one.u, v - one.v) > near)) addClick({...one, outline: relative([one])[one.name]});
    }
  }
  if (state) showState();
}

/* Begins with no click; `again`: although objects are followed. */
function select(again) {
  anew = again;
  clicks = [];
  showClicks();
  if (again) look('camera');
}

function showClicks() {
  listed = false;
  if (state) showState();
}

/* Lists clicks, whose names somebody may be writing, when they have changed; else what is seen. */
function listObjects() {
  if (selecting() && listed) return;
  listed = selecting();
  fill($('clicks'), listed ? clicks : state.camera.objects, (one, k) => made('li', {}, ...listed ? [mark(COLOURS[k % 4]),
    made('input', {value: one.name, maxLength: 40, ariaLabel: `name of object ${k + 1}`,
      oninput: (event) => { one.name = event.target.value.trim(); draw(); }}),
    Object.assign(button('✕', () => {
      clicks.splice(k, 1);
      calm();
      showClicks();
      $('large').focus({preventScroll: true});
    }), {title: 'leave this one out', ariaLabel: `leave out ${one.name}`})]
    : [mark(colourOf(one.name)), one.name, ...one.state ? [': ', mark(STATE_COLOURS[one.state]), `${one.state}, ${Math.round(100 * one.confidence)}%`] : []]));
}

function addClick({u, v, outline}) {
  const names = clicks.map(({name}) => name);
  let k = 0;
  while (names.includes(`object_${k}`)) k += 1;
  clicks.push({name: `object_${k}`, u, v, outline});
  showClicks();
}

// Pointer and keys

function press(at) {
  calm();
  if (view === 'camera' && selecting()) {
    addClick(at);
  } else if (movable()) {
    let best = NEAR * state[view].width;
    for (const {name, u, v} of draggable()) {
      const away = Math.hypot(u - at.u, v - at.v);
      if (away < best) {
        best = away;
        drag = {name, ...at};
      }
    }
    draw();
  }
}

function shift(at) {
  if (drag) Object.assign(drag, at);
  draw();
}

function release() {
  const {name, u, v} = drag;
  send({do: 'move', name, u, v});
  moved = {...drag, until: JSON.stringify(state.goal.objects)};
  drop();
}

function drop() {
  drag = null;
  draw();
}

{
  const canvas = $('large');
  const pixelOf = (event) => {
    const box = canvas.getBoundingClientRect(), {width, height} = state[view];
    return {u: (event.clientX - box.left) / box.width * width - 0.5,
            v: (event.clientY - box.top) / box.height * height - 0.5};
  };
  canvas.addEventListener('pointerdown', (event) => {
    if (!state?.[view]?.width) return;
    press(pixelOf(event));
    if (drag) canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener('pointermove', (event) => drag && shift(pixelOf(event)));
  canvas.addEventListener('pointerup', () => drag && release());
  canvas.addEventListener('pointercancel', drop);
  canvas.addEventListener('blur', draw);
  canvas.addEventListener('keydown', (event) => {
    const size = state?.[view];
    if (!size?.width) return;
    if (cursor?.kind !== view) cursor = {kind: view, u: size.width / 2, v: size.height / 2};
    const arrow = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[event.key];
    if (arrow) {
      const step = (event.shiftKey ? LEAP : STEP) * size.width;
      cursor.u = Math.min(Math.max(cursor.u + step * arrow[0], 0), size.width - 1);
      cursor.v = Math.min(Math.max(cursor.v + step * arrow[1], 0), size.height - 1);
      shift({u: cursor.u, v: cursor.v});
    } else if (event.key === 'Enter' && drag) {
      release();
    } else if (event.key === 'Enter') {
      press({u: cursor.u, v: cursor.v});
    } else {
      return;
    }
    event.preventDefault();
    draw();
  });
}
