// A program's path as a map, coloured by its contour error: pathMap(...) draws one case; several may share a camera.

import {el} from "/static/dom.js";

const SHADES = 8;
const MARGIN = {left: 46, right: 10, top: 10, bottom: 26};
const NEAR_PX = 24;
const LEAST_MM_PER_PX = 2e-6;
const ZOOM_STEP = 1.5;

// one view of a plane for all maps of a page: its centre (mm) and the size of a pixel
export function makeCamera() {
  const changed = new EventTarget();
  const camera = {
    x: 0, y: 0, scale: 1, widest: 1,
    onChange: (f) => changed.addEventListener("change", f),
    set(x, y, scale) {
      Object.assign(camera, {x, y, scale: Math.min(camera.widest, Math.max(LEAST_MM_PER_PX, scale))});
      changed.dispatchEvent(new Event("change"));
    },
    zoom(factor, x = camera.x, y = camera.y) {
      const scale = Math.min(camera.widest, Math.max(LEAST_MM_PER_PX, camera.scale / factor));
      const share = scale / camera.scale;
      camera.set(x + (camera.x - x) * share, y + (camera.y - y) * share, scale);
    },
  };
  return camera;
}

// the shade of an error, of SHADES; compared maps share the scale
export function shadeOf(um, {largest_um: largest, least_um: least}) {
  if (!(largest > 0)) return 0;
  const share = least === null ? um / largest : Math.log(Math.max(um, least) / least) / Math.log(Math.max(largest / least, 10));
  return Math.min(SHADES - 1, Math.max(0, Math.floor(share * SHADES)));
}

// the lower bound of each shade
export function shadeLimits({largest_um: largest, least_um: least}) {
  const span = least === null ? 0 : Math.max(largest / least, 10);
  return Array.from({length: SHADES}, (_, k) => (least === null ? largest * k / SHADES : k ? least * span ** (k / SHADES) : 0));
}

export function shadeKey(scale, words) {
  const limits = shadeLimits(scale);
  return el("ul", {class: "shades", "aria-label": words.title}, limits.map((from, k) => el("li", {},
    el("span", {class: `shade shade-${k}`, "aria-hidden": "true"}), words.text(from, limits[k + 1] ?? null))));
}

// pathMap({camera, label, hint, values, scale, onCursor}): ``values`` names the figure that colours a run
export function pathMap({camera, label, hint, values, table, scale, onCursor, onStep}) {
  const canvas = el("canvas", {
    class: "map", tabindex: "0", role: "application", "aria-label": label, "aria-describedby": hint,
  });
  const pen = canvas.getContext("2d");
  let data = null, places = [], cursor = null, names = ["", ""], width = 0, height = 0;
  let waiting = false;

  const toPx = (x, y) => [
    MARGIN.left + (width - MARGIN.left - MARGIN.right) / 2 + (x - camera.x) / camera.scale,
    MARGIN.top + (height - MARGIN.top - MARGIN.bottom) / 2 - (y - camera.y) / camera.scale];
  const toMm = (px, py) => [
    camera.x + (px - MARGIN.left - (width - MARGIN.left - MARGIN.right) / 2) * camera.scale,
    camera.y - (py - MARGIN.top - (height - MARGIN.top - MARGIN.bottom) / 2) * camera.scale];

  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  }

  function draw() {
    if (!width) return;
    const look = getComputedStyle(canvas);
    const colour = (name) => look.getPropertyValue(name).trim();
    const dots = devicePixelRatio || 1;
    pen.setTransform(dots, 0, 0, dots, 0, 0);
    pen.clearRect(0, 0, width, height);
    drawAxes(colour);
    pen.save();
    pen.beginPath();
    pen.rect(MARGIN.left, MARGIN.top, width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom);
    pen.clip();
    if (data) {
      drawPath(colour);
      if (data.whole) drawTable(colour);
    }
    drawPlaces(colour);
    pen.restore();
  }

  function drawAxes(colour) {
    pen.font = "12px system-ui, sans-serif";
    pen.fillStyle = colour("--soft");
    pen.strokeStyle = colour("--line");
    pen.lineWidth = 1;
    const [left, top] = toMm(MARGIN.left, MARGIN.top);
    const [right, bottom] = toMm(width - MARGIN.right, height - MARGIN.bottom);
    const step = niceStep((right - left) / Math.max(2, width / 110));
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    const shown = (value) => (Math.abs(value) < step / 2 ? "0" : value.toFixed(Math.min(6, digits)));
    pen.beginPath();
    pen.textAlign = "center";
    pen.textBaseline = "top";
    for (let x = Math.ceil(left / step) * step; x <= right; x += step) {
      const [px] = toPx(x, 0);
      pen.moveTo(px, MARGIN.top);
      pen.lineTo(px, height - MARGIN.bottom);
      if (px < width - 72) pen.fillText(shown(x), px, height - MARGIN.bottom + 5);
    }
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    for (let y = Math.ceil(bottom / step) * step; y <= top; y += step) {
      const [, py] = toPx(0, y);
      pen.moveTo(MARGIN.left, py);
      pen.lineTo(width - MARGIN.right, py);
      if (py > MARGIN.top + 18) pen.fillText(shown(y), MARGIN.left - 5, py);
    }
    pen.stroke();
    pen.textBaseline = "top";
    pen.fillText(`${names[0]} (mm)`, width - 4, height - MARGIN.bottom + 5);
    pen.textAlign = "left";
    if (names[1] !== names[0]) pen.fillText(`${names[1]} (mm)`, 4, 3);
  }

  function drawPath(colour) {
    const parts = Array.from({length: SHADES}, () => new Path2D());
    const count = data.runs.reduce((sum, run) => sum + run.row.length, 0);
    for (const run of data.runs) {
      for (let k = 0; k + 1 < run.x_mm.length; k += 1) {
        const part = parts[shadeOf(run[values][k], scale)];
        part.moveTo(...toPx(run.x_mm[k], run.y_mm[k]));
        part.lineTo(...toPx(run.x_mm[k + 1], run.y_mm[k + 1]));
      }
    }
    pen.lineCap = "round";
    parts.forEach((part, k) => {
      pen.lineWidth = data.whole ? 2 + k / 4 : count > 2000 ? 1 + k / 12 : 1.6 + k / 4;
      pen.strokeStyle = colour(`--shade-${k}`);
      pen.stroke(part);
    });
  }

  function drawTable(colour) {
    pen.lineWidth = 1.2;
    pen.strokeStyle = colour("--ink");
    pen.setLineDash([4, 5]);
    for (const run of data.runs) {
      const way = run.table[table];
      pen.beginPath();
      way.x_mm.forEach((x, k) => pen[k ? "lineTo" : "moveTo"](...toPx(x, way.y_mm[k])));
      pen.stroke();
    }
    pen.setLineDash([]);
  }

  function drawPlaces(colour) {
    pen.font = "bold 12px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    for (const {number, x, y} of places) {
      const [px, py] = toPx(x, y);
      pen.beginPath();
      pen.moveTo(px, py);
      pen.lineTo(px + 12, py - 12);
      pen.strokeStyle = colour("--ink");
      pen.lineWidth = 1;
      pen.stroke();
      pen.beginPath();
      pen.arc(px + 18, py - 18, 9, 0, 7);
      pen.fillStyle = colour("--paper");
      pen.fill();
      pen.stroke();
      pen.fillStyle = colour("--ink");
      pen.fillText(String(number), px + 18, py - 17.5);
    }
    if (!cursor) return;
    const [px, py] = toPx(cursor.x, cursor.y);
    for (const [radius, name, thick] of [[8, "--paper", 5], [8, "--focus", 2.5]]) {
      pen.beginPath();
      pen.arc(px, py, radius, 0, 7);
      pen.lineWidth = thick;
      pen.strokeStyle = colour(name);
      pen.stroke();
    }
  }

  // the point of the path nearest to a pixel, null without one nearby
  function nearest(px, py, within = NEAR_PX) {
    let best = null, least = within;
    for (const run of data?.runs ?? []) {
      for (let k = 0; k < run.x_mm.length; k += 1) {
        const [x, y] = toPx(run.x_mm[k], run.y_mm[k]);
        const away = Math.hypot(x - px, y - py);
        if (away < least) { least = away; best = {run, k}; }
      }
    }
    return best;
  }

  const resized = new ResizeObserver(() => {
    width = canvas.clientWidth;
    height = canvas.clientHeight;
    const dots = devicePixelRatio || 1;
    canvas.width = Math.round(width * dots);
    canvas.height = Math.round(height * dots);
    draw();
  });
  resized.observe(canvas);
  camera.onChange(redraw);
  const scheme = matchMedia("(prefers-color-scheme: dark)");
  scheme.addEventListener("change", redraw);
  listen(canvas, camera, {toMm, nearest, onCursor, onStep});

  return {
    node: canvas,
    show(view, plane) { data = view; names = plane; redraw(); },
    mark(told) { places = told; redraw(); },
    point(at) { cursor = at; redraw(); },
    size: () => [Math.max(40, width - MARGIN.left - MARGIN.right), Math.max(40, height - MARGIN.top - MARGIN.bottom)],
    end() { resized.disconnect(); scheme.removeEventListener("change", redraw); },
  };
}

function niceStep(rough) {
  const decade = 10 ** Math.floor(Math.log10(Math.max(rough, 1e-9)));
  return decade * [1, 2, 5, 10].find((step) => step * decade >= rough);
}

// wheel, drag, pinch and keys all move the same camera
function listen(canvas, camera, {toMm, nearest, onCursor, onStep}) {
  const fingers = new Map();
  const place = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  let moved = 0;
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...toMm(...place(event)));
  }, {passive: false});
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, place(event));
    canvas.setPointerCapture(event.pointerId);
    moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) {
      const found = event.pointerType === "mouse" ? nearest(...place(event)) : null;
      if (found) onCursor(found, false);
      return;
    }
    const now = place(event);
    moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
    const others = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    if (others.length) {
      const [fixed] = others;
      const grown = Math.hypot(now[0] - fixed[0], now[1] - fixed[1]) / Math.max(1, Math.hypot(before[0] - fixed[0], before[1] - fixed[1]));
      camera.zoom(grown, ...toMm(...fixed));
    } else {
      camera.set(camera.x - (now[0] - before[0]) * camera.scale, camera.y + (now[1] - before[1]) * camera.scale, camera.scale);
    }
    fingers.set(event.pointerId, now);
  });
  const lifted = (event) => {
    if (event.type === "pointerup" && moved < 5 && fingers.size === 1) {
      const found = nearest(...place(event), 60);
      if (found) onCursor(found, true);
    }
    fingers.delete(event.pointerId);
  };
  canvas.addEventListener("pointerup", lifted);
  canvas.addEventListener("pointercancel", lifted);
  canvas.addEventListener("dblclick", (event) => camera.zoom(3, ...toMm(...place(event))));
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const pan = 60 * camera.scale;
    const moves = {ArrowLeft: [-pan, 0], ArrowRight: [pan, 0], ArrowUp: [0, pan], ArrowDown: [0, -pan]};
    if (moves[event.key] && event.shiftKey) {
      camera.set(camera.x + moves[event.key][0], camera.y + moves[event.key][1], camera.scale);
    } else if (moves[event.key]) onStep(event.key);
    else if (event.key === "+" || event.key === "=") onStep("in");
    else if (event.key === "-") onStep("out");
    else if (event.key === "0") onStep("whole");
    else return;
    event.preventDefault();
  });
}

export const zoomStep = ZOOM_STEP;
