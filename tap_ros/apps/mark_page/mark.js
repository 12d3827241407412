// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

const at = (id) => document.getElementById(id);
const THUMBNAILS = 14;
let state = null;    // what the server knows
let episode = 0;     // which demonstration is shown
let frame = 0;
const seen = [];     // demonstrations shown before
let done = Promise.resolve();  // when the server has all marks

const picture = (t) => `frame/${episode}/${t}`;
const marks = () => state.marks[episode] || [];

function show(t) {
  frame = Math.max(0, Math.min(t, state.lengths[episode] - 1));
  at('now').src = picture(frame);
  at('slider').value = frame;
  draw();
}

function draw() {
  const length = state.lengths[episode];
  at('now').className = marks().includes(frame) ? 'marked' : '';
  at('where').textContent = `frame ${frame} of ${length - 1}`;
  const count = Object.keys(state.marks).length;
  at('title').textContent = `Demonstration ${episode} of 0 to ${state.lengths.length - 1}; ` +
    `marked: ${marks().join(', ') || 'nothing'}. ${count} marked in all.`;
  at('file').textContent = state.file;
  for (const one of at('strip').children) {
    const first = Number(one.dataset.first), last = Number(one.dataset.last);
    const inside = (t) => first <= t && t <= last;
    one.className = (marks().some(inside) ? 'marked ' : '') + (inside(frame) ? 'here' : '');
  }
}

function open(i) {
  episode = i;
  const length = state.lengths[i];
  at('slider').max = length - 1;
  at('number').value = i;
  at('start').src = picture(0);
  at('goal').src = picture(length - 1);
  const count = Math.min(THUMBNAILS, length);
  at('strip').replaceChildren(...Array.from({length: count}, (_, n) => {
    const image = new Image();
    image.dataset.first = Math.ceil(n * length / count);
    image.dataset.last = Math.ceil((n + 1) * length / count) - 1;
    const middle = Math.floor((Number(image.dataset.first) + Number(image.dataset.last)) / 2);
    image.src = picture(middle);
    image.onclick = () => show(middle);
    return image;
  }));
  show(marks()[0] ?? Math.floor(length / 2));
}

async function send() {
  const frames = marks().includes(frame) ? marks().filter((t) => t !== frame)
    : [...marks(), frame].sort((a, b) => a - b);
  try {
    const answer = await fetch('mark', {method: 'POST', body: JSON.stringify({episode, frames})});
    at('error').textContent = answer.ok ? '' : await answer.text();
    if (answer.ok) state = await answer.json();
  } catch {
    at('error').textContent = 'Not marked: the server does not answer. Start it again.';
  }
  draw();
}

const mark = () => (done = done.then(send));
const next = () => done.then(openNext);

function openNext() {
  if (state.next === null) return;
  seen.push(episode);
  // Where the one shown is left unmarked, it would be proposed for ever: take the one after it.
  open(state.next !== episode ? state.next : (episode + 1) % state.lengths.length);
}

function previous() {
  if (seen.length) open(seen.pop());
}

document.addEventListener('keydown', (event) => {
  const step = event.shiftKey ? 5 : 1;
  const action = {ArrowLeft: () => show(frame - step), ArrowRight: () => show(frame + step),
    Enter: mark, n: next, p: previous}[event.key];
  if (!state || !action || event.target === at('number') || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  action();
});
at('slider').oninput = () => show(Number(at('slider').value));
at('now').onclick = at('mark').onclick = mark;
at('next').onclick = next;
at('previous').onclick = previous;
at('number').onchange = () => {
  const i = Number(at('number').value);
  if (Number.isInteger(i) && i >= 0 && i < state.lengths.length) { seen.push(episode); open(i); }
  at('number').blur();
};

(async () => {
  state = await (await fetch('state')).json();
  open(state.next ?? 0);
})();
