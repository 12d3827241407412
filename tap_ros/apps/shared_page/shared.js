// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

// What the pages of this package share; their colours and buttons are in shared.css.

const $ = (id) => document.getElementById(id);
const fill = (parent, items, make) => parent.replaceChildren(...items.map(make));

/* An element with its properties, and what is in it. */
function made(kind, properties = {}, ...inside) {
  const element = Object.assign(document.createElement(kind), properties);
  element.append(...inside);
  return element;
}

const button = (text, onclick) => made('button', {type: 'button', textContent: text, onclick});

/* Lets a button be pressed, or tells by its title why not. */
function allow(id, why, title = '') {
  $(id).disabled = Boolean(why);
  $(id).title = why || title;
}
