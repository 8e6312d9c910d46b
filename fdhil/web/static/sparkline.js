// Small charts for tiles: a parameter within its maintenance band, and a signal of the last seconds.

import {colour} from "/static/chart.js";

const WIDE = 120, HIGH = 40, EDGE = 4;

export function svg(tag, attributes, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

// band({label, course, low, high, least, most}): the course and the newest interval, scaled to the band from least to most
export function band({label, course, low, high, least, most}) {
  const shown = [least, most, ...course, low, high].filter(Number.isFinite);
  const [bottom, top] = [Math.min(...shown), Math.max(...shown)];
  const y = (value) => EDGE + (HIGH - 2 * EDGE) * (top > bottom ? (top - value) / (top - bottom) : 0.5);
  const x = (k) => EDGE + (WIDE - 3 * EDGE) * (course.length > 1 ? k / (course.length - 1) : 1);
  const parts = [];
  if (least !== null) parts.push(svg("rect", {class: "band", x: 0, width: WIDE, y: y(most), height: y(least) - y(most)}));
  parts.push(svg("polyline", {points: course.map((value, k) => `${x(k)},${y(value)}`).join(" ")}));
  const at = x(course.length - 1);
  if (low !== null) parts.push(svg("line", {x1: at, x2: at, y1: y(low), y2: y(high)}));
  if (course.length) parts.push(svg("circle", {cx: at, cy: y(course.at(-1)), r: 3}));
  return svg("svg", {class: "sparkline", viewBox: `0 0 ${WIDE} ${HIGH}`, role: "img", "aria-label": label}, ...parts);
}

// draws minimum and maximum of each column on a canvas; scaled to the data, but at least to ``span``
export function drawTrace(canvas, {low, high}, colourName, span) {
  const ratio = devicePixelRatio, wide = canvas.width = canvas.clientWidth * ratio, tall = canvas.height = canvas.clientHeight * ratio;
  const known = [...low, ...high].filter((value) => value !== null);
  const pen = canvas.getContext("2d");
  if (!known.length || !wide) return;
  const [least, most] = [Math.min(...known), Math.max(...known)], middle = (least + most) / 2, half = Math.max(most - least, span) / 2;
  const y = (value) => tall * (0.5 - 0.45 * (value - middle) / half);
  pen.strokeStyle = pen.fillStyle = colour(colourName);
  low.forEach((value, k) => {
    if (value !== null) pen.fillRect(k * wide / low.length, y(high[k]) - ratio / 2, Math.ceil(wide / low.length), y(value) - y(high[k]) + ratio);
  });
}
