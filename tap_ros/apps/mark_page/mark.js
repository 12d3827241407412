// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

const THUMBNAILS = 14;
const ASK_AGAIN_MS = 1500;  // while labels are being found
const LABELLING = 3;  // marked demonstrations, from which on others are labelled
const BESIDE_S = 0.5;  // between a label and where the hand moves, which is taken for it
let state = null;    // what the server knows
let about = null;    // of the demonstration that is shown: seconds of its frames, moves of its gripper
let episode = 0;     // which one is shown
let frame = 0;
let draft = [];      // its frames by name, null where not yet marked; without names in order of time
let playing = false;
let asking = false;
const seen = [];     // demonstrations shown before
const passed = new Set();  // shown and left unmarked
let done = Promise.resolve();  // when the server has all marks

const SILENT = 'The server does not answer: start mark again, then load this page again.';
const names = () => state.names;
const say = (text, good = false) => { $('said').textContent = text; $('said').className = good ? 'good' : 'bad'; };
const second = (t) => `${about.seconds[t].toFixed(1)} s`;
const nameOf = (k) => names()[k] || (draft.length > 1 || !names().length ? `mark ${k + 1}` : '');
const isSaved = () => String(draft) === String(state.marks[episode] || []);
const given = () => draft.filter((t) => t !== null);
const labels = () => state.marks[episode] ? [] : state.labels[episode] || [];

// A frame for each name: that of its label, or where the hand moves beside it; without labels where a gripper closes or opens.
function proposed() {
  const guess = labels().map(([t]) => t), moves = about.moves.filter(([, closes]) => closes !== null || guess.length).map(([t]) => t);
  const first = Math.max(0, about.moves.findIndex(([, closes]) => closes));  // it closes before it opens
  const others = Object.values(state.marks).map((frames) => frames.length);
  const count = names().length || others[0] || guess.length || moves.length - first;
  if (!guess.length || guess.length !== count) {
    return moves.length < count ? moves : moves.slice(Math.min(first, moves.length - count)).slice(0, count);
  }
  const off = (t, wanted) => Math.abs(about.seconds[t] - about.seconds[wanted]);
  const found = guess.map((wanted) => moves.filter((t) => off(t, wanted) <= BESIDE_S)
    .sort((a, b) => off(a, wanted) - off(b, wanted))[0] ?? wanted);
  return found.every((t, k) => !k || t > found[k - 1]) ? found : guess;
}

// What the key a makes of the draft: what is marked stays.
function accepted() {
  if (!names().length) return draft.length ? draft : proposed();
  const offer = proposed(), frames = draft.map((t, k) => t ?? offer[k] ?? null), set = frames.filter((t) => t !== null);
  return set.every((t, k) => !k || t > set[k - 1]) ? frames : draft;
}

// Why a frame is proposed as a mark: what moves there, and the label.
function reasons(t, k) {
  return [...about.moves.filter(([at]) => at === t).map(([, closes]) => closes === null ? 'hand moves' : moveOf(closes)),
    ...(labels().length === proposed().length ? labels().slice(k, k + 1) : []).map(([at, sure]) => `label ${second(at)}, confidence ${Math.round(100 * sure)}%`)];
}

const moveOf = (closes) => closes === null ? 'hand' : `gripper ${closes ? 'closes' : 'opens'}`;
const added = () => accepted().map((t, k) => [t, k]).filter(([t, k]) => t !== (draft[k] ?? null));

function show(t) {
  const last = state.lengths[episode] - 1;
  frame = Math.max(0, Math.min(t, last));
  $('now').src = `frame/${episode}/${frame}`;
  $('slider').value = frame;
  $('slider').ariaValueText = second(frame);
  draw();
}

function go(t) {
  playing = false;
  say('');
  show(t);
}

function draw() {
  const last = state.lengths[episode] - 1, count = Object.keys(state.marks).length;
  $('now').classList.toggle('marked', draft.includes(frame));
  $('where').textContent = `${second(frame)} of ${second(last)}, frame ${frame} of ${last}`;
  $('count').textContent = count < state.enough ? `${count} of ${state.enough} marked` : `${count} marked: enough`;
  $('count').className = count < state.enough ? '' : 'good';
  $('busy').textContent = state.busy && count >= LABELLING ? 'finding labels …' : '';
  $('play').textContent = playing ? 'Stop' : 'Play';
  const listed = draft.map((t, k) => t === null ? `${nameOf(k)} not yet` : `${nameOf(k)} ${second(t)}`);
  const offer = added(), offered = ([t, k]) => `${nameOf(k)} ${second(t)}`.trim();
  const guess = offer.map(([t, k]) => `${offered([t, k])} (${reasons(t, k).join('; ')})`);
  $('title').textContent = `Demonstration ${episode} (0 to ${state.lengths.length - 1}): ` +
    (given().length ? listed.join(', ') + (isSaved() ? '' : ' (not saved)') : 'nothing marked') + (guess.length ? `; proposed: ${guess.join(', ')}` : '');
  $('file').textContent = `saved ${names().length > 1 ? 'once each name is marked' : 'at once'}, in ${state.file}`;
  drawTicks(last);
  for (const one of $('strip').children) {
    const inside = (t) => Number(one.dataset.first) <= t && t <= Number(one.dataset.last);
    one.className = (draft.some((t) => t !== null && inside(t)) ? 'marked ' : labels().some(([t]) => inside(t)) ? 'labelled ' : '') +
      (inside(frame) ? 'here' : '');
  }
  // The main button is what comes next: to accept, to mark (as Enter does), or the next demonstration.
  const named = names().length > 0;
  const wanted = named ? names().length : Object.values(state.marks)[0]?.length || 1;
  const free = offer.length || given().length >= wanted ? -1 : Math.max(0, draft.indexOf(null));
  fill($('names'), named ? names() : ['this moment'], (name, k) => Object.assign(
    button(` ${name}${named ? ` (${k + 1})` : ''}`, () => mark(named ? k : null)), {className: k === free ? 'main' : ''}));
  [...$('names').children].forEach((one, k) => one.prepend(  // of one width, so that nothing moves
    made('span', {}, (named ? draft[k] === frame : draft.includes(frame)) ? 'undo' : 'mark')));
  $('next').className = free < 0 && !offer.length ? 'main' : '';
  $('previous').disabled = !seen.length;
  $('accept').hidden = !offer.length;
  $('accept').textContent = `accept ${offer.map(offered).join(', ')} (a)`;
  fill($('list'), Object.entries(state.marks), ([i, frames]) => made('li', {className: Number(i) === episode ? 'here' : ''},
    button(`${i}: ${state.seconds[i].map((s) => `${s.toFixed(1)} s`).join(', ')}`, () => { visit(Number(i), frames[0]); })));
  if (!count) $('list').append(made('li', {className: 'soft'}, 'What you mark is listed here.'));
  document.body.classList.toggle('enough', state.commands.length > 0);
  fill($('commands'), state.commands, (words) => made('pre', {}, words));
  if (state.commands.length) $('commands').prepend(
    made('p', {}, 'Enough to begin with. In a terminal, label all demonstrations, or train on the marks:'));
}

// The ticks of a demonstration: [frame, kind, text]; a label until its mark is there.
function ticks() {
  return [...about.moves.map(([t, closes]) => [t, 'move', moveOf(closes)]),
    ...labels().map(([t], k) => [t, 'label', `${names()[k] || 'label'}?`]).filter((_, k) => (draft[k] ?? null) === null),
    ...draft.flatMap((t, k) => t === null ? [] : [[t, isSaved() ? 'mark' : 'draft', nameOf(k)]])];
}

// Moves in a row of their own; a text that would lie over the one before is left to its tick's title.
function drawTicks(last) {
  const ends = {}, width = $('ticks').clientWidth;
  fill($('ticks'), ticks().sort(([one], [other]) => one - other), ([t, kind, text]) => {
    const row = kind === 'move', half = 4 * text.length, middle = width * t / last, room = middle - half > (ends[row] ?? -half);
    if (room) ends[row] = middle + half;
    return Object.assign(button(room ? text : '', () => go(t)),
      {className: kind, title: `${text}, ${second(t)}`, ariaLabel: `${text}, ${second(t)}`, style: `left: ${100 * t / last}%`});
  });
}

async function open(i, wanted) {
  const answer = await fetch(`about/${i}`).catch(() => null);
  if (!answer || !answer.ok) { say(SILENT); return; }
  about = await answer.json();
  episode = i;
  playing = false;
  say('');
  takeMarks();
  const length = state.lengths[i];
  $('slider').max = length - 1;
  $('number').value = i;
  $('start').src = `frame/${i}/0`;
  $('goal').src = `frame/${i}/${length - 1}`;
  const count = Math.min(THUMBNAILS, length);
  $('strip').replaceChildren(...Array.from({length: count}, (_, n) => {
    const image = new Image();
    image.dataset.first = Math.ceil(n * length / count);
    image.dataset.last = Math.ceil((n + 1) * length / count) - 1;
    const middle = Math.floor((Number(image.dataset.first) + Number(image.dataset.last)) / 2);
    image.src = `small/${i}/${middle}`;
    image.onclick = () => go(middle);
    return image;
  }));
  show(wanted ?? given()[0] ?? (labels().length ? proposed()[0] : 0));
}

function takeMarks() {
  const known = state.marks[episode] || [];
  draft = names().length && known.length !== names().length ? names().map(() => null) : [...known];
}

// Takes the newest state; asks again while labels are being found.
function take(answer) {
  state = answer;
  if (!state.busy || asking) return;
  asking = true;
  setTimeout(async () => {
    asking = false;
    try { take(await (await fetch('state')).json()); draw(); } catch { /* who marks is told */ }
  }, ASK_AGAIN_MS);
}

// Marks the frame shown: by the number of a name, or as the next one; again takes it back.
function mark(k = null) {
  playing = false;
  say('');
  if (!names().length) {
    send(draft.includes(frame) ? draft.filter((t) => t !== frame) : [...draft, frame].sort((a, b) => a - b));
    return;
  }
  const same = draft.indexOf(frame), free = draft.indexOf(null);
  k ??= same >= 0 ? same : Math.max(0, free);
  if (k >= names().length) return;
  send(draft.map((t, other) => other !== k ? t : t === frame ? null : frame));
}

// Sends marks that are complete; what is not yet stays here, and nothing of it in the file.
function send(frames) {
  draft = frames;
  const missing = names().filter((_, k) => frames[k] === null || frames[k] === undefined);
  const sent = missing.length ? [] : frames, i = episode;
  draw();
  if (missing.length && !state.marks[i]) return;
  done = done.then(async () => {
    let text = `Not marked. ${SILENT}`;
    try {
      const answer = await fetch('mark', {method: 'POST', body: JSON.stringify({episode: i, frames: sent})});
      if (answer.ok) { take(await answer.json()); text = ''; } else text = `Not saved: ${await answer.text()}`;
    } catch { /* said above */ }
    if (i === episode) {
      if (!text && !missing.length) takeMarks();
      if (text) say(text);
    }
    draw();
  });
}

function accept() {
  playing = false;
  say('');
  const [[first] = []] = added();
  if (first === undefined) { say('Nothing is proposed here.'); return; }
  send(accepted());
  show(first);
}

async function next() {
  await done;
  if (!state.marks[episode]) passed.add(episode);
  const left = state.order.filter((i) => i !== episode);
  let fresh = left.filter((i) => !passed.has(i)), text = '';
  if (!fresh.length && left.length) {
    text = 'All that are not marked were shown; from the beginning.';
    passed.clear();
    fresh = left;
  }
  if (!fresh.length) { say(state.order.length ? 'This is the only one that is not marked.' : 'All are marked.', true); return; }
  await visit(fresh[0]);
  if (text) say(text, true);
}

async function visit(i, wanted) {
  if (i !== episode) seen.push(episode);
  await open(i, wanted);
  $($('said').textContent ? 'said' : 'shown').scrollIntoView({block: 'nearest'});
}

function previous() {
  say('');
  if (seen.length) open(seen.pop());
}

function fromTickToTick(step) {
  const frames = ticks().map(([t]) => t).filter((t) => step > 0 ? t > frame : t < frame);
  if (frames.length) go(step > 0 ? Math.min(...frames) : Math.max(...frames));
}

async function play() {
  if (playing) { playing = false; draw(); return; }
  const last = state.lengths[episode] - 1, i = episode;
  say('');
  if (frame === last) show(0);
  playing = true;
  const begin = performance.now() / 1000 - about.seconds[frame];
  while (playing && i === episode && frame < last) {
    await new Promise((go) => { requestAnimationFrame(go); });
    const now = performance.now() / 1000 - begin;
    if (!playing || about.seconds[frame + 1] > now) continue;
    const later = about.seconds.findIndex((s) => s > now);
    show(later < 0 ? last : later - 1);
    await $('now').decode().catch(() => {});
  }
  if (i === episode) { playing = false; draw(); }
}

document.addEventListener('keydown', (event) => {
  const step = event.shiftKey ? 5 : 1, key = event.key;
  const action = {ArrowLeft: () => go(frame - step), ArrowRight: () => go(frame + step),
    ArrowUp: () => fromTickToTick(-1), ArrowDown: () => fromTickToTick(1),
    Enter: () => mark(), n: next, p: previous, a: accept, ' ': play}[key] ||
    (/^[1-9]$/.test(key) && (() => mark(Number(key) - 1)));
  if (!about || !action || event.target === $('number') || event.ctrlKey || event.altKey || event.metaKey) return;
  if ([' ', 'Enter'].includes(key) && event.target.matches('button, summary')) return;  // somebody came there by keys
  event.preventDefault();
  action();
});
document.addEventListener('click', (event) => { if (event.detail) document.activeElement.blur(); });  // of a pointer
$('slider').oninput = () => go(Number($('slider').value));
$('now').onclick = () => mark();
$('now').onerror = () => say('This picture could not be loaded: does mark still run?');
$('now').onload = () => $('now').classList.toggle('small', $('now').naturalWidth < 200);
$('next').onclick = next;
$('previous').onclick = previous;
$('play').onclick = play;
$('accept').onclick = accept;
$('back').onclick = () => go(frame - 1);
$('on').onclick = () => go(frame + 1);
$('number').onchange = () => {
  const i = Number($('number').value), count = state.lengths.length;
  $('number').blur();
  if (Number.isInteger(i) && i >= 0 && i < count) visit(i);
  else { say(`There are demonstrations 0 to ${count - 1}.`); $('number').value = episode; }
};

(async () => {
  take(await (await fetch('state')).json());
  await open(state.order[0] ?? 0);
})();
