// The live path of two axes: demand and position, in one scale.

import {colour} from "/static/chart.js";
import {el} from "/static/dom.js";
import {t} from "/static/text.js";

const LEAST_MM = 1, MARGIN = 14;

export class LivePath {
  constructor(place, height) {
    this.caption = el("span", {});
    this.canvas = el("canvas", {class: "live-path", height, role: "img"});
    this.figure = el("figure", {class: "chart", hidden: true}, el("figcaption", {}, this.caption), this.canvas);
    place.append(this.figure);
  }

  // plane: two axes, or null for none; of(axis, name) returns {low, high}
  show(plane, of) {
    this.figure.hidden = plane === null;
    if (plane === null) return;
    this.caption.textContent = t("live.path.caption", {across: plane[0], along: plane[1]});
    this.canvas.setAttribute("aria-label", this.caption.textContent);
    const points = (name) => {
      const [x, y] = plane.map((axis) => of(axis, name));
      return x.low.map((low, k) => (low === null || y.low[k] === null ? null : [(low + x.high[k]) / 2, (y.low[k] + y.high[k]) / 2]));
    };
    this.draw([points("demand_mm"), points("position_mm")]);
  }

  draw(lines) {
    const {canvas} = this, ratio = devicePixelRatio;
    const wide = canvas.width = canvas.clientWidth * ratio, tall = canvas.height = canvas.clientHeight * ratio;
    const known = lines.flat().filter(Boolean);
    if (!known.length || !wide) return;
    const ends = [0, 1].map((k) => known.reduce(([low, high], at) => [Math.min(low, at[k]), Math.max(high, at[k])], [Infinity, -Infinity]));
    const margin = MARGIN * ratio;
    const scale = Math.min(...ends.map(([low, high], k) => ([wide, tall][k] - 2 * margin) / Math.max(high - low, LEAST_MM)));
    const middle = ends.map(([low, high]) => (low + high) / 2);
    const at = ([x, y]) => [wide / 2 + (x - middle[0]) * scale, tall / 2 - (y - middle[1]) * scale];
    const pen = canvas.getContext("2d");
    lines.forEach((points, k) => {
      Object.assign(pen, {strokeStyle: colour(k ? "series-1" : "line"), lineWidth: (k ? 1.5 : 5) * ratio});
      pen.beginPath();
      points.forEach((point, n) => { if (point) pen[points[n - 1] ? "lineTo" : "moveTo"](...at(point)); });
      pen.stroke();
    });
    const newest = lines[1].findLast(Boolean);
    if (!newest) return;
    pen.fillStyle = colour("series-2");
    pen.beginPath(); pen.arc(...at(newest), 4 * ratio, 0, 7); pen.fill();
  }
}
