// Copyright 2026 The tap_ros authors
// SPDX-License-Identifier: Apache-2.0
'use strict';

// Distances

function drawChart({unit, names, times, values}) {
  const canvas = $('chart');
  const context = canvas.getContext('2d');
  const style = getComputedStyle(document.body);
  const [left, bottom, right, top] = [40, canvas.height - 24, canvas.width - 8, 8];
  const followed = state?.camera.objects.some((one) => one.state);
  const source = followed ? ', as followed'
    : unit === 'cm' && state?.simulator ? ", the simulator's ground truth" : '';
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
