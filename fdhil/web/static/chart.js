// A chart over time or another variable, on the bundled uPlot: page colours in light and dark mode, envelopes,
// a cursor with its values as text, zoom by dragging, keyboard and touchpad pinch.
//
//   const shown = chart(place, {caption, unit, series: [{label, colour: 1, band: true}], x: {label: "time", unit: "s"}});
//   shown.set(xs, [ys, {low, high}, ...]);   // null is a gap; a series with band has two of them
//   shown.see(from, to);                     // shows this section; see(null) everything
//   shown.end();
//
// onZoom({from, to} | null) receives requested sections; without it the chart zooms itself. onCursor(place | null) receives
// the position under the cursor. Charts with the same ``sync`` share their cursor. A series may have ``dash``, ``points`` or
// ``width``; ``steady`` keeps the scale of moving data steady, ``zero`` keeps 0 visible, ``log`` uses powers
// of ten, ``span`` is the least range of the scale, ``time`` is for seconds since 1970, ``level`` [{label, value}] are lines across; of a series with ``band`` and
// ``bars`` only the range is kept.

import {el} from "/static/dom.js";
import {language, number, t} from "/static/text.js";
import {typeset} from "/static/typeset.js";

const FONT = "12px system-ui, \"Segoe UI\", \"DejaVu Sans\", sans-serif";
const charts = new Set();
let colours = {};
let count = 0;

export function colour(name) {
  return colours[name] ??= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  colours = {};
  for (const each of charts) each.plot?.redraw();
});

export function chart(place, options) {
  const told = {height: 180, x: {}, series: [], level: [], steady: false, zero: false, ...options};
  const reading = el("output", {class: "reading", "aria-live": "off"});  // announced when it is moved by the keyboard
  const field = el("div", {
    class: "plot", tabindex: "0", role: "group", "aria-label": t("chart.label", {caption: told.caption}), id: `chart-${++count}`,
  });
  const figure = el("figure", {class: "chart"}, el("figcaption", {}, el("span", {}, told.caption, told.unit ? ` (${told.unit})` : ""), reading), field);
  place.append(figure);
  const self = {figure, plot: null, set, see, end, show};
  let data = {x: [], values: told.series.map((each) => (each.band ? {low: [], high: []} : []))};
  let range = null;
  let at = null;  // the position under the cursor
  self.plot = new uPlot({...plan(told, self), hooks: {setCursor: [read], setSelect: [selected], draw: [drawLevels]}}, flat(), field);
  charts.add(self);
  const sized = new ResizeObserver(() => self.plot.setSize({width: Math.max(80, field.clientWidth), height: told.height}));
  sized.observe(field);
  field.addEventListener("keydown", pressed);
  field.addEventListener("wheel", wheeled, {passive: false});
  return self;

  function flat() {
    const parts = data.values.flatMap((each, i) => (told.series[i].band ? [each.low, each.high] : [each]));
    return [data.x, ...parts];
  }

  function set(x, values) {
    hold(() => {
      data = {x, values};
      self.plot.setData(flat(), range === null);
      if (range) scale();
    });
    read(self.plot);
  }

  function show(index, visible) {
    told.series[index].hidden = !visible;
    let k = 1;
    told.series.forEach((each, i) => {
      for (let n = each.band ? 2 : 1; n; n--, k++) if (i === index) self.plot.setSeries(k, {show: visible});
    });
  }

  function see(from, to) {
    range = from === null ? null : {from, to};
    hold(scale);
  }

  function scale() {
    const [first, last] = [data.x[0], data.x[data.x.length - 1]];
    if (first !== undefined) self.plot.setScale("x", range ? {min: range.from, max: range.to} : {min: first, max: last});
  }

  // changes the plot; the cursor keeps its position, which may then be another sample and elsewhere on the screen
  function hold(act) {
    const held = at;
    reading.setAttribute("aria-live", "off");
    self.plot.batch(act);
    if (held === null) return;
    const index = self.plot.valToIdx(held);
    if (index !== self.plot.cursor.idx) put(index);
  }

  function end() {
    charts.delete(self);
    sized.disconnect();
    self.plot.destroy();
    figure.remove();
  }

  function wish(stretch) {
    if (told.onZoom) told.onZoom(stretch);
    else if (stretch) see(stretch.from, stretch.to);
    else see(null);
  }

  function selected(plot) {
    const {left, width} = plot.select;
    if (width < 4) return;
    const [from, to] = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    plot.setSelect({left: 0, top: 0, width: 0, height: 0}, false);
    wish({from, to});
  }

  function read(plot) {
    const {idx, left} = plot.cursor;
    at = idx === null || idx === undefined || left < 0 ? null : data.x[idx] ?? null;
    reading.textContent = typeset(at === null ? "" : `${placeOf(told, at)}: ${valuesAt(told, data.values, idx)}`);
    told.onCursor?.(at);
  }

  function zoom(factor) {
    const {min, max} = self.plot.scales.x;
    const fixed = at ?? (min + max) / 2;
    wish({from: fixed - (fixed - min) * factor, to: fixed + (max - fixed) * factor});
  }

  function pressed(event) {
    const step = event.shiftKey ? 10 : 1;
    const acts = {
      ArrowLeft: () => move(-step), ArrowRight: () => move(step), "+": () => zoom(0.5), "=": () => zoom(0.5),
      "-": () => zoom(2), Home: () => wish(null), Escape: () => { self.plot.setCursor({left: -10, top: -10}); },
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
  }

  function inside(x) {
    const {min, max} = self.plot.scales.x;
    return x >= min && x <= max;
  }

  function move(step) {
    const held = self.plot.cursor.idx;
    const now = inside(data.x[held]) ? held : data.x.findLastIndex(inside);
    const next = Math.min(data.x.length - 1, Math.max(0, now + step));
    if (!inside(data.x[next])) return;
    reading.setAttribute("aria-live", "polite");
    put(next, true);
  }

  // moves the cursor, also of synchronised charts, to a sample; none if it is out of sight
  function put(index, shared = false) {
    const left = inside(data.x[index]) ? self.plot.valToPos(data.x[index], "x") : -10;
    self.plot.setCursor({left, top: self.plot.over.clientHeight / 2}, true, shared);
  }

  function wheeled(event) {
    if (!event.ctrlKey) return;  // touchpad pinch; the plain wheel scrolls the page
    event.preventDefault();
    zoom(event.deltaY < 0 ? 0.8 : 1.25);
  }

  function drawLevels(plot) {
    const pen = plot.ctx, {left, top, width, height} = plot.bbox;
    pen.save();
    pen.beginPath(); pen.rect(left, top, width, height); pen.clip();
    Object.assign(pen, {strokeStyle: colour("bad"), fillStyle: colour("ink"), lineWidth: devicePixelRatio, textAlign: "right", textBaseline: "bottom"});
    pen.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    pen.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
    for (const {label, value} of told.level) {
      const y = plot.valToPos(value, "y", true);
      pen.beginPath(); pen.moveTo(left, y); pen.lineTo(left + width, y); pen.stroke();
      pen.fillText(label, left + width - 4 * devicePixelRatio, y - 2 * devicePixelRatio);
    }
    pen.restore();
  }
}

function plan(told) {
  const axis = {
    stroke: () => colour("soft"), grid: {stroke: () => colour("line"), width: 1}, ticks: {stroke: () => colour("line"), width: 1},
    font: FONT, labelFont: FONT,
  };
  const series = [{}];
  const bands = [];
  for (const each of told.series) {
    const stroke = () => colour(`series-${each.colour ?? 1}`);
    const line = {
      label: each.label, stroke, width: each.width ?? 1.4, dash: each.dash, show: !each.hidden, paths: each.points || each.bars ? () => null : undefined,
      points: {show: Boolean(each.points), size: 6, stroke, fill: stroke},
    };
    if (each.band && !each.bars) bands.push({series: [series.length + 1, series.length], fill: () => `color-mix(in srgb, ${stroke()} 40%, transparent)`});
    series.push(...(each.band ? [{...line, width: 1}, {...line, width: 1}] : [line]));
  }
  const label = told.x.label && typeset(told.x.unit ? `${told.x.label} (${told.x.unit})` : told.x.label);
  return {
    width: 320, height: told.height, series, bands, legend: {show: false},
    scales: {x: {time: Boolean(told.x.time)}, y: told.log ? {distr: 3, range: decades} : {range: limits(told)}},
    axes: [
      {...axis, label, labelSize: 18, size: 28, space: 60, ...(told.x.time ? {values: dates, size: 48} : {})},
      {...axis, size: 58, space: 26, ...(told.log ? {splits: tens} : {}), values: (plot, values) => values.map((value) => (value === null ? "" : number(value, 5)))},
    ],
    cursor: {y: false, sync: told.sync ? {key: told.sync, setSeries: false} : undefined, drag: {x: true, y: false, setScale: false}, points: {show: false}},
  };
}

// days as month-day; within days the time, and the date at the start of a day
function dates(plot, ticks, index, space, step) {
  const two = (value) => String(value).padStart(2, "0");
  const told = ticks.map((tick) => new Date(tick * 1e3)).map((at) => ({
    year: String(at.getFullYear()), day: `${two(at.getMonth() + 1)}-${two(at.getDate())}`, time: `${two(at.getHours())}:${two(at.getMinutes())}`,
  }));
  const [coarse, fine] = step >= 86400 ? ["year", "day"] : ["day", "time"];
  return told.map((at, k) => (k && at[coarse] === told[k - 1][coarse] ? at[fine] : `${at[fine]}\n${at[coarse]}`));
}

// a millionth of the largest is rounding noise
function decades(plot, low, high) {
  return high > 0 ? uPlot.rangeLog(Math.max(low || 0, high * 1e-6), high, 10, true) : [0.1, 1];
}

// powers of ten, at most six
function tens(plot, index, low, high) {
  const [first, last] = [Math.ceil(Math.log10(low) - 1e-9), Math.floor(Math.log10(high) + 1e-9)];
  const step = Math.ceil((last - first + 1) / 6);
  return Array.from({length: Math.floor((last - first) / step) + 1}, (_, k) => 10 ** (first + k * step));
}

function limits(told) {
  let held = null;
  return (plot, low, high) => {
    const levels = told.level.map((each) => each.value);
    const known = [low, high, ...levels].filter((value) => Number.isFinite(value));
    if (told.zero) known.push(0);
    if (!known.length) return held ?? [0, 1];
    const [least, most] = [Math.min(...known), Math.max(...known)];
    const wider = Math.max(0, ((told.span ?? 0) - (most - least)) / 2);
    const margin = wider || (most - least || Math.abs(most) || 1) * 0.06;
    const wanted = [least - margin, most + margin];
    const fits = held && wanted[0] >= held[0] && wanted[1] <= held[1] && wanted[1] - wanted[0] > 0.4 * (held[1] - held[0]);
    if (!told.steady || !fits) held = wanted;
    return held;
  };
}

function placeOf(told, at) {
  if (told.x.time) return new Date(at * 1e3).toLocaleString(language);
  return `${number(at, 6)}${told.x.unit ? ` ${told.x.unit}` : ""}`;
}

// "X 1.2, Y 3.4 to 3.6 V"
function valuesAt(told, values, index) {
  const words = told.series.map((each, i) => {
    if (each.hidden) return null;
    const [low, high] = each.band ? [values[i].low[index], values[i].high[index]] : [values[i][index], values[i][index]];
    if (low === null || low === undefined) return null;
    return `${each.label} ${low === high ? number(low) : t("chart.between", {low: number(low), high: number(high)})}`;
  }).filter(Boolean);
  return words.length ? `${words.join(", ")}${told.unit ? ` ${told.unit}` : ""}` : t("chart.nothing");
}
