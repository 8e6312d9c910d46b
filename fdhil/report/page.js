// Makes the pictures of a report interactive: zoom, readings under the pointer, hidden curves. Each picture contains
// its data in its <metadata>; without this script, and in print, the pictures are static.
"use strict";

const INK = "#1d2733", SOFT = "#5b6876", GRID = "#e6eaee";
const PANEL_PX = 250;

function figures4(value) {
  if (value == null) return "";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-4 || size >= 1e6) ? value.toExponential(3) : String(Number(value.toPrecision(4)));
}

// the range of all visible traces of a panel, including bands, bars and levels
function limits(panel, grids) {
  return (plot) => {
    const { min: from, max: to } = plot.scales.x;
    let low = Infinity, high = -Infinity;
    panel.traces.forEach((trace, k) => {
      if (!plot.series[k + 1].show) return;
      grids[trace.x].forEach((x, i) => {
        if (from != null && (x < from || x > to)) return;
        for (const y of [trace.y[i], trace.low?.[i], trace.high?.[i]]) {
          if (y == null || (panel.log && y <= 0)) continue;
          low = Math.min(low, y); high = Math.max(high, y);
        }
      });
    });
    for (const [, level] of panel.levels) { low = Math.min(low, level); high = Math.max(high, level); }
    if (!(low <= high)) return [null, null];
    if (panel.log) return uPlot.rangeLog(low, high, 10, false);
    const margin = (high - low || Math.abs(high) || 1) * 0.06;
    return [panel.zero ? 0 : low - margin, high + margin];
  };
}

// bands, bars, levels and marks are not series of uPlot: they are drawn over its curves
function drawOverlay(data, panel) {
  return (plot) => {
    const pen = plot.ctx, ratio = devicePixelRatio;
    const { left, top, width, height } = plot.bbox;
    const right = (x) => plot.valToPos(x, "x", true), up = (y) => plot.valToPos(y, "y", true);
    pen.save();
    pen.beginPath(); pen.rect(left, top, width, height); pen.clip();
    panel.traces.forEach((trace, k) => {
      if (!trace.low || !plot.series[k + 1].show) return;
      const grid = data.grids[trace.x];
      pen.strokeStyle = pen.fillStyle = trace.colour; pen.lineWidth = ratio; pen.globalAlpha = trace.style === "points" ? 0.8 : 0.2;
      const known = grid.map((x, i) => i).filter((i) => trace.low[i] != null && trace.high[i] != null);
      pen.beginPath();
      if (trace.style === "points") {
        for (const i of known) { pen.moveTo(right(grid[i]), up(trace.low[i])); pen.lineTo(right(grid[i]), up(trace.high[i])); }
        pen.stroke();
      } else {
        for (const i of known) pen.lineTo(right(grid[i]), up(trace.high[i]));
        for (const i of known.reverse()) pen.lineTo(right(grid[i]), up(trace.low[i]));
        pen.fill();
      }
    });
    pen.globalAlpha = 1; pen.strokeStyle = pen.fillStyle = INK; pen.lineWidth = ratio; pen.font = `${11 * ratio}px system-ui, sans-serif`;
    pen.setLineDash([6 * ratio, 4 * ratio]); pen.textAlign = "right"; pen.textBaseline = "bottom";
    for (const [name, level] of panel.levels) {
      pen.beginPath(); pen.moveTo(left, up(level)); pen.lineTo(left + width, up(level)); pen.stroke();
      pen.fillText(name, left + width - 4 * ratio, up(level) - 2 * ratio);
    }
    pen.setLineDash([2 * ratio, 3 * ratio]); pen.textAlign = "left"; pen.textBaseline = "top";
    for (const [name, at] of data.marks) {
      pen.beginPath(); pen.moveTo(right(at), top); pen.lineTo(right(at), top + height); pen.stroke();
      pen.fillText(name, right(at) + 4 * ratio, top + 2 * ratio);
    }
    pen.restore();
  };
}

// days as month-day; within a day the time, and the date at its begin
function dates(plot, ticks, number, space, step) {
  const data = ticks.map((tick) => new Date(tick * 1e3).toISOString());
  if (step >= 86400) return data.map((date, k) => k && date.slice(0, 4) === data[k - 1].slice(0, 4) ? date.slice(5, 10) : `${date.slice(5, 10)}\n${date.slice(0, 4)}`);
  return data.map((date, k) => k && date.slice(0, 10) === data[k - 1].slice(0, 10) ? date.slice(11, 16) : `${date.slice(11, 16)}\n${date.slice(5, 10)}`);
}

function reading(trace) {
  return (plot, value, series, at) => {
    const grid = plot.data[0];
    if (value == null || at == null || !trace.low) return figures4(value);
    const i = trace.grid.indexOf(grid[at]);
    if (i < 0 || trace.low[i] == null) return figures4(value);
    const half = (trace.high[i] - trace.low[i]) / 2;
    if (!(half > 0)) return figures4(value);
    const places = Math.min(8, Math.max(0, 1 - Math.floor(Math.log10(half))));
    return `${value.toFixed(places)} ±${half.toFixed(places)}`;
  };
}

function chart(picture, data, number) {
  const live = document.createElement("div");
  live.className = "live";
  picture.after(live);
  picture.classList.add("still");
  const sync = uPlot.sync(`chart ${number}`);
  data.panels.forEach((panel, k) => {
    for (const trace of panel.traces) trace.grid = data.grids[trace.x];
    const last = k === data.panels.length - 1;
    const series = panel.traces.map((trace) => ({
      label: trace.label, stroke: trace.colour, value: reading(trace), spanGaps: new Set(panel.traces.map((t) => t.x)).size > 1,
      width: { wide: 4, points: 0 }[trace.style] ?? 1.6, dash: trace.style === "dashed" ? [8, 5] : undefined,
      paths: trace.style === "points" ? () => null : undefined,
      points: trace.style === "points" ? { show: true, size: 6, fill: trace.colour } : { show: trace.grid.length < 2 },
    }));
    const axis = { stroke: SOFT, grid: { stroke: GRID, width: 1 }, ticks: { stroke: GRID, width: 1 }, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif" };
    const numbers = (plot, values) => values.map((value) => value == null ? "" : String(Number(value.toPrecision(6))));
    const plot = new uPlot({
      width: live.clientWidth || 480, height: PANEL_PX * panel.share + (last ? 40 : 0),
      tzDate: (seconds) => uPlot.tzDate(new Date(seconds * 1e3), "Etc/UTC"),
      scales: { x: { time: data.time }, y: { distr: panel.log ? 3 : 1, range: limits(panel, data.grids) } },
      axes: [
        { ...axis, label: last ? data.x : undefined, labelSize: 20, size: last ? 34 : 8, ...(last ? {} : { values: () => [] }), space: 70, ...(last && data.time ? { values: dates } : {}) },
        { ...axis, label: panel.y, labelSize: 20, size: 62, space: panel.share < 1 ? 22 : 34, ...(panel.log ? {} : { values: numbers }) },
      ],
      series: [{ label: data.time ? "time (UTC)" : data.x, value: data.time ? (p, value) => value == null ? "" : new Date(value * 1e3).toISOString().slice(0, 16).replace("T", " ") : (p, value) => figures4(value) }, ...series],
      cursor: { sync: { key: sync.key, setSeries: false }, y: false, drag: { x: true, y: false } },
      hooks: { draw: [drawOverlay(data, panel)] },
    }, uPlot.join(panel.traces.map((trace) => [trace.grid, trace.y])), live);
    panel.traces.forEach((trace, n) => { if (!trace.label) plot.root.querySelectorAll(".u-series")[n + 1].hidden = true; });
    new ResizeObserver(() => plot.setSize({ width: live.clientWidth, height: plot.height })).observe(live);
  });
}

function map(picture, data) {
  const whole = picture.getAttribute("viewBox").split(" ").map(Number);
  const point = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(picture.getScreenCTM().inverse());
  const millimetres = ({ x, y }) => {
    const [left, top, right, bottom] = data.box;
    return [data.x[0] + (x - left) / (right - left) * (data.x[1] - data.x[0]),
            data.y[0] + (bottom - y) / (bottom - top) * (data.y[1] - data.y[0])];
  };
  const note = document.createElement("output");
  const frame = document.createElementNS("http://www.w3.org/2000/svg", "rect");
  frame.setAttribute("class", "frame");
  picture.append(frame);
  picture.after(note);
  let start = null;
  picture.addEventListener("pointerdown", (event) => { start = point(event); picture.setPointerCapture(event.pointerId); event.preventDefault(); });
  picture.addEventListener("pointermove", (event) => {
    const here = point(event);
    if (start) setBox(frame, start, here);
    if (!data.names) return;
    const [x, y] = millimetres(here);
    let text = `${data.names[0]} ${x.toFixed(3)} mm, ${data.names[1]} ${y.toFixed(3)} mm`;
    if (data.at) {
      const near = data.at.reduce((a, b) => Math.hypot(b[0] - x, b[1] - y) < Math.hypot(a[0] - x, a[1] - y) ? b : a);
      text = `${data.names[0]} ${near[0].toFixed(2)} mm, ${data.names[1]} ${near[1].toFixed(2)} mm: ${figures4(near[2])} ${data.unit}`;
    }
    note.textContent = text;
  });
  picture.addEventListener("pointerleave", () => { note.textContent = ""; });
  picture.addEventListener("pointerup", (event) => {
    const here = point(event), wide = Math.abs(here.x - start.x), tall = Math.abs(here.y - start.y);
    if (wide > 4 && tall > 4) {
      picture.setAttribute("viewBox", [Math.min(here.x, start.x), Math.min(here.y, start.y), wide, tall].join(" "));
      picture.classList.add("zoomed");
    }
    start = null;
    setBox(frame, here, here);
  });
  picture.addEventListener("dblclick", () => { picture.setAttribute("viewBox", whole.join(" ")); picture.classList.remove("zoomed"); });
  for (const name of picture.querySelectorAll('[id*="-legend-"]')) {
    const curve = picture.querySelector(`[id="${name.id.replace("-legend-", "-trace-")}"]`);
    name.classList.add("name");
    name.addEventListener("pointerdown", (event) => event.stopPropagation());
    name.addEventListener("click", () => { const off = curve.classList.toggle("off"); name.classList.toggle("faint", off); });
  }
}

function setBox(box, a, b) {
  for (const [name, value] of Object.entries({ x: Math.min(a.x, b.x), y: Math.min(a.y, b.y), width: Math.abs(a.x - b.x), height: Math.abs(a.y - b.y) })) box.setAttribute(name, value);
}

document.querySelectorAll("figure > svg").forEach((picture, number) => {
  const metadata = picture.querySelector(":scope > metadata");
  if (!metadata) return;
  let data;
  try { data = JSON.parse(metadata.textContent); } catch { return; }
  if (data.kind === "chart") chart(picture, data, number);
  else if (data.kind === "map") map(picture, data);
});
