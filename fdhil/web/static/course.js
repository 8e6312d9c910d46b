// A chart of a report in the browser: the data of fdhil/report/chart.py drawn on the shared chart, with bars and marks.

import {chart, colour} from "/static/chart.js";
import {el} from "/static/dom.js";
import {t} from "/static/text.js";

// course(place, {told, caption}) draws one panel and returns an object with end()
export function course(place, {told, caption, height = 220}) {
  const panel = told.panels[0];
  const traces = panel.traces.map((trace) => ({...trace, grid: told.grids[trace.x]}));
  const columns = traces.flatMap(columnsOf);
  const shown = chart(place, {
    caption, height, series: columns.map((each) => each.series), level: panel.levels.map(([label, value]) => ({label, value})),
    x: told.time ? {time: true} : {label: told.x.replace(/ \(.*\)/, ""), unit: unitOf(told.x)}, unit: unitOf(panel.y),
  });
  shown.plot.hooks.draw.push((plot) => drawBeside(plot, traces, told.marks));
  const [x, ...joined] = uPlot.join(columns.flatMap(({grid, values}) => values.map((each) => [grid, each])));
  shown.set(x, columns.map(({series}) => (series.band ? {low: joined.shift(), high: joined.shift()} : joined.shift())));
  shown.figure.append(el("p", {class: "keys"}, traces.map((trace) => el("span", {},
    el("span", {class: `key colour-${trace.colour}`, "aria-hidden": "true"}, KEYS[trace.style]), ` ${trace.label}`))));
  return shown;
}

const KEYS = {points: "●", line: "━", wide: "━", dashed: "╍"};
const unitOf = (label) => /\(([^()]*)\)$/.exec(label)?.[1] ?? "";

const FAR = 8;  // medians of the others: a longer bar would flatten them and is cut at the edge

function withoutLongest({low, high}) {
  const lengths = low.map((each, i) => high[i] - each);
  const most = FAR * [...lengths].sort((a, b) => a - b)[Math.floor(lengths.length / 2)];
  const kept = (values) => values.map((value, i) => (lengths[i] <= most ? value : null));
  return [kept(low), kept(high)];
}

// a trace as one or two series: its band or the range of its bars, and itself
function columnsOf(trace) {
  const bars = trace.style === "points";
  const series = {label: trace.label, colour: trace.colour, points: bars, dash: trace.style === "dashed" ? [7, 5] : undefined, width: 1.8};
  const own = {grid: trace.grid, values: [trace.y], series};
  if (!trace.low) return [own];
  const reach = {label: t("history.reach"), colour: trace.colour, band: true, bars, width: 0.5};
  return [{grid: trace.grid, values: bars ? withoutLongest(trace) : [trace.low, trace.high], series: reach}, own];
}

// error bars and labelled lines of changes, which the shared chart lacks
function drawBeside(plot, traces, marks) {
  const pen = plot.ctx, ratio = devicePixelRatio;
  const {left, top, width, height} = plot.bbox;
  const right = (x) => plot.valToPos(x, "x", true), up = (y) => plot.valToPos(y, "y", true);
  pen.save();
  pen.beginPath(); pen.rect(left, top, width, height); pen.clip();
  pen.lineWidth = ratio; pen.setLineDash([]); pen.globalAlpha = 0.7;
  for (const trace of traces.filter((each) => each.style === "points" && each.low)) {
    pen.strokeStyle = colour(`series-${trace.colour}`);
    pen.beginPath();
    trace.grid.forEach((x, i) => {
      if (trace.low[i] === null || trace.high[i] === null) return;
      pen.moveTo(right(x), up(trace.low[i])); pen.lineTo(right(x), up(trace.high[i]));
    });
    pen.stroke();
  }
  Object.assign(pen, {globalAlpha: 1, strokeStyle: colour("ink"), fillStyle: colour("ink"), textBaseline: "top", font: `${11 * ratio}px system-ui, sans-serif`});
  pen.setLineDash([2 * ratio, 3 * ratio]);
  for (const [name, at] of marks) {
    pen.beginPath(); pen.moveTo(right(at), top); pen.lineTo(right(at), top + height); pen.stroke();
    const beyond = right(at) + pen.measureText(name).width + 8 * ratio > left + width;
    pen.textAlign = beyond ? "right" : "left";
    pen.fillText(name, right(at) + (beyond ? -4 : 4) * ratio, top + 2 * ratio);
  }
  pen.restore();
}
