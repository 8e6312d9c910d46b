// The axes of the tile: state, position, speed and following error now, and the following error of the last ten seconds.

import {el, lamp} from "/static/dom.js";
import {decimal, t} from "/static/text.js";
import {drawTrace} from "/static/sparkline.js";
import {Columns, decode} from "/static/pages/live_columns.js";

const SECONDS = 10, COLUMNS = 100, RETRY_MS = 3000, LEAST_UM = 2;
const FIGURES = [["position_mm", 3], ["speed_rad_s", 1], ["following_error_um", 1]];

export class AxisTraces {
  constructor(context) {
    Object.assign(this, {context, rows: new Map(), columns: null, over: false});
    this.node = el("ul", {class: "axis-rows"});
    this.connect();
  }

  // lights: {X: {light, text}} from /api/machine
  update(lights) {
    for (const axis of this.rows.keys()) if (!(axis in lights)) { this.rows.get(axis).row.remove(); this.rows.delete(axis); }
    for (const [axis, {light, text}] of Object.entries(lights)) {
      const {state} = this.rows.get(axis) ?? this.add(axis);
      if (state.dataset.text === light + text) continue;
      state.dataset.text = light + text;
      state.replaceChildren(lamp(light, t(`light.${light}`)), light === "good" ? "" : ` ${text}`);
    }
  }

  add(axis) {
    const state = el("p", {}), figures = FIGURES.map(() => el("dd", {}, "–"));
    const canvas = el("canvas", {class: "trace", role: "img", "aria-label": t("machine.trace", {axis})});
    const row = el("li", {},
      el("div", {class: "axis-head"}, el("a", {href: `/machine/${axis}`}, axis), state),
      el("dl", {class: "figures"}, FIGURES.map(([name], k) => el("div", {}, el("dt", {}, t(`machine.now.${name}`)), figures[k]))), canvas);
    this.node.append(row);
    const made = {row, state, figures, canvas};
    this.rows.set(axis, made);
    return made;
  }

  connect() {
    const socket = this.socket = this.context.socket(`/api/live/stream?seconds=${SECONDS}&columns=${COLUMNS}`);
    socket.binaryType = "arraybuffer";
    socket.addEventListener("message", ({data}) => {
      if (typeof data === "string") {
        this.begun = JSON.parse(data);
        this.columns = new Columns(this.begun, Math.floor(Math.round(SECONDS / this.begun.sync_period_s) / this.begun.ticks_per_column));
        return;
      }
      const header = decode(data);
      this.columns.take(header);
      requestAnimationFrame(() => {
        if (this.over || this.socket !== socket) return;
        this.draw();
        if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({drawn: header.number}));
      });
    });
    socket.addEventListener("close", () => { if (!this.over) this.retry = setTimeout(() => this.connect(), RETRY_MS); });
  }

  draw() {
    const place = Object.fromEntries(this.begun.signals.map(({name}, s) => [name, s]));
    this.begun.axes.forEach((axis, k) => {
      const row = this.rows.get(axis);
      if (!row) return;
      FIGURES.forEach(([name, places], n) => {
        const value = this.columns.newest(axis, place[name]);
        const shown = value === null ? "–" : decimal(name === "speed_rad_s" ? value * this.begun.mm_per_rad[axis] : value, places);
        if (row.figures[n].textContent !== shown) row.figures[n].textContent = shown;
      });
      drawTrace(row.canvas, this.columns.of(axis, place.following_error_um), `series-${k % 6 + 1}`, LEAST_UM);
    });
  }

  end() {
    this.over = true;
    clearTimeout(this.retry);
    this.socket.close();
  }
}
