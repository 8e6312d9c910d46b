// The page live: the selected signals of the axes and their path, frozen and zoomed down to single samples.

import {chart} from "/static/chart.js";
import {el, table} from "/static/dom.js";
import {Columns, decode} from "/static/pages/live_columns.js";
import {LivePath} from "/static/pages/live_path.js";

const SECONDS = [1, 2, 5, 10, 20, 60];
const MOST_COLUMNS = 800, FEWEST_COLUMNS = 150;
const RETRY_MS = [500, 1000, 2000, 5000];
const TABLE_MS = 500;
const NOTE_MS = 5000;
// in the order of the page: the least range of a chart, so that noise at standstill looks like noise
const SPANS = {
  position_mm: 0.1, demand_mm: 0.1, speed_rad_s: 2, following_error_um: 2, current_a: 1, voltage_v: 2, offset_um: 2, temperature_c: 1,
};
const FIRST = ["position_mm", "speed_rad_s", "following_error_um", "current_a", "path"];
const TALL = 240;

export async function show(main, path, context) {
  const page = new Live(main, path, context);
  page.connect();
  return () => page.end();
}

class Live {
  constructor(main, path, context) {
    Object.assign(this, {context, main, t: context.t, charts: [], columns: null, frozen: null, tries: 0, over: false, at: null});
    this.wanted = path.query.get("axis")?.split(",") ?? null;
    this.chosen = new Set(path.query.get("signals")?.split(",") ?? FIRST);
    this.seconds = SECONDS.includes(Number(path.query.get("seconds"))) ? Number(path.query.get("seconds")) : 10;
    this.draw();
  }

  draw() {
    const {t} = this;
    const button = (key, act) => el("button", {type: "button", onclick: act}, t(key));
    this.state = el("p", {role: "status"}, t("live.connecting"));
    this.note = el("p", {role: "status"});
    this.axes = el("fieldset", {class: "choices"}, el("legend", {}, t("live.axes")));
    this.signals = el("fieldset", {class: "choices"}, el("legend", {}, t("live.charts")));
    this.select = el("select", {id: "live-seconds", onchange: () => this.look(Number(this.select.value))},
      SECONDS.map((value) => el("option", {value, selected: value === this.seconds}, t("live.seconds.value", {seconds: value}))));
    this.freezing = button("live.freeze", () => (this.frozen ? this.go() : this.freeze()));
    this.moving = [
      button("live.zoom_in", () => this.zoom(0.5)), button("live.zoom_out", () => this.zoom(2)),
      button("live.back", () => this.shift(-0.5)), button("live.forward", () => this.shift(0.5)), button("live.whole", () => this.see(null)),
    ];
    this.values = el("div");
    this.field = el("div", {class: "charts"});
    this.main.append(
      el("h1", {}, t("nav.live")),
      el("section", {"aria-label": t("live.controls")},
        el("div", {class: "choices"}, this.axes, this.signals, el("span", {}, el("label", {for: "live-seconds"}, t("live.seconds")), this.select)),
        el("div", {class: "actions"}, this.freezing, this.moving),
        this.state, this.note),
      el("section", {}, this.values),
      el("section", {"aria-label": t("live.charts")}, el("p", {class: "soft"}, t("live.hint")), this.field));
    this.enable();
    this.timer = setInterval(() => this.tell(), TABLE_MS);
  }

  // the stream -----------------------------------------------------------------------------------------------------

  connect() {
    const wide = Math.round(Math.min(MOST_COLUMNS, Math.max(FEWEST_COLUMNS, this.field.clientWidth / (this.field.clientWidth > 700 ? 2 : 1))));
    const socket = this.context.socket(`/api/live/stream?seconds=${this.seconds}&columns=${wide}`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.addEventListener("message", ({data}) => (typeof data === "string" ? this.begin(JSON.parse(data)) : this.take(decode(data), socket)));
    socket.addEventListener("close", (event) => { if (this.socket === socket && !this.over) this.lost(event); });
  }

  lost({reason}) {
    this.state.textContent = reason ? this.t("live.closed", {text: reason}) : this.t("live.lost");
    this.context.lookNow();  // which also detects an ended login
    this.retry = setTimeout(() => this.connect(), RETRY_MS[Math.min(this.tries++, RETRY_MS.length - 1)]);
  }

  begin(begin) {
    this.tries = 0;
    this.begun = begin;
    this.columns = new Columns(begin, Math.floor(Math.round(this.seconds / begin.sync_period_s) / begin.ticks_per_column));
    if (!this.charts.length) this.drawCharts(begin);
  }

  take(header, socket) {
    this.columns.take(header);
    this.header = header;
    this.warn(header);
    requestAnimationFrame(() => {
      if (this.over || this.socket !== socket) return;
      if (!this.frozen) this.fill(this.columns);
      if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({drawn: header.number}));
    });
  }

  warn(header) {
    const width = Math.max(0, ...header.parts.map((part) => part.per_column));
    const skipped = Math.max(0, ...header.parts.map((part) => part.skipped_ticks));
    const {t} = this;
    const note = skipped ? t("live.skipped", {seconds: this.context.number(skipped * this.begun.sync_period_s, 2)})
      : header.skipped_lines > (this.skippedLines ?? 0) ? t("live.server_skipped", {lines: header.skipped_lines - this.skippedLines})
      : width > this.begun.ticks_per_column ? t("live.coarser", {factor: width / this.begun.ticks_per_column}) : null;
    this.skippedLines = header.skipped_lines;
    if (note) this.remark(note);
  }

  // shows a message next to the state for some seconds
  remark(note) {
    this.note.textContent = note;
    clearTimeout(this.forget);
    this.forget = setTimeout(() => { this.note.textContent = ""; }, NOTE_MS);
  }

  // the charts -----------------------------------------------------------------------------------------------------

  drawCharts(begin) {
    const chosen = begin.axes.filter((axis) => !this.wanted || this.wanted.includes(axis));
    this.shown = new Set(chosen.length ? chosen : begin.axes);
    for (const axis of begin.axes) {
      const box = el("input", {type: "checkbox", checked: this.shown.has(axis), onchange: () => this.choose(axis, box.checked)});
      this.axes.append(el("label", {class: `choice series-${begin.axes.indexOf(axis) % 6 + 1}`}, box, ` ${axis}`));
    }
    this.place = Object.fromEntries(begin.signals.map(({name}, s) => [name, s]));
    this.units = Object.fromEntries(begin.signals.map(({name, unit}) => [name, name === "speed_rad_s" ? "mm/s" : unit]));
    this.names = Object.keys(SPANS).filter((name) => name in this.place);
    this.charts = this.names.map((name) => chart(this.field, {
      caption: this.t(`live.${name}`), unit: this.units[name], sync: "live", steady: true, height: TALL, span: SPANS[name],
      x: {label: this.t("live.time"), unit: "s"},
      series: begin.axes.map((axis, k) => ({label: axis, colour: k % 6 + 1, band: true, hidden: !this.shown.has(axis)})),
      onZoom: (stretch) => this.see(stretch), onCursor: (at) => { this.at = at; },
    }));
    this.path = new LivePath(this.field, TALL);
    for (const name of [...this.names, ...(begin.axes.length > 1 ? ["path"] : [])]) {
      const box = el("input", {type: "checkbox", checked: this.chosen.has(name), onchange: () => this.chooseSignal(name, box.checked)});
      this.signals.append(el("label", {class: "choice"}, box, ` ${this.t(`live.${name}`)}`));
    }
  }

  chooseSignal(name, wanted) {
    if (wanted) this.chosen.add(name); else this.chosen.delete(name);
    this.remember();
    if (this.frozen?.samples) this.fetch(this.frozen);
    else if (this.columns) this.fill(this.frozen?.columns ?? this.columns);
    this.tell();
  }

  // a signal as displayed: the speed is that of the table
  shownAs(name, axis, {low, high}) {
    if (name !== "speed_rad_s") return {low, high};
    const scaled = (values) => values.map((value) => (value === null ? null : value * this.begun.mm_per_rad[axis]));
    return {low: scaled(low), high: scaled(high)};
  }

  choose(axis, wanted) {
    if (wanted) this.shown.add(axis); else this.shown.delete(axis);
    for (const each of this.charts) each.show(this.begun.axes.indexOf(axis), wanted);
    this.remember();
    this.tell();
  }

  look(seconds) {
    this.seconds = seconds;
    this.remember();
    if (this.frozen) this.go();
    const old = this.socket;
    clearTimeout(this.retry);
    this.connect();
    old.close();
  }

  remember() {
    const all = this.shown.size === this.begun.axes.length;
    const same = FIRST.length === this.chosen.size && FIRST.every((name) => this.chosen.has(name));
    const query = new URLSearchParams({
      ...(all ? {} : {axis: [...this.shown].join(",")}), ...(same ? {} : {signals: [...this.chosen].join(",")}), seconds: this.seconds,
    });
    history.replaceState({}, "", `/live?${query}`);
  }

  fill(columns) {
    this.drawSignals(columns.x, (axis, name) => columns.of(axis, this.place[name]));
  }

  // draws the selection; ``of`` returns {low, high} of an axis' signal
  drawSignals(x, of) {
    this.charts.forEach((each, n) => {
      const name = this.names[n];
      each.figure.hidden = !this.chosen.has(name);
      if (each.figure.hidden) return;
      const values = this.begun.axes.map((axis) => this.shownAs(name, axis, of(axis, name)));
      each.set(x, values);
    });
    const plane = this.begun.axes.filter((axis) => this.shown.has(axis)).slice(0, 2);
    this.path.show(this.chosen.has("path") && plane.length === 2 && "position_mm" in this.place ? plane : null, of);
  }

  // frozen ---------------------------------------------------------------------------------------------------------

  freeze() {
    if (!this.columns?.end_tick) return;
    this.frozen = {columns: this.columns.copy(), stretch: null, samples: null};
    this.enable();
    this.fill(this.frozen.columns);
  }

  go() {
    this.asking?.abort();
    this.frozen = null;
    for (const each of this.charts) each.see(null);
    this.enable();
    if (this.columns) this.fill(this.columns);
  }

  enable() {
    this.freezing.textContent = this.t(this.frozen ? "live.go" : "live.freeze");
    for (const each of this.moving.slice(1)) each.disabled = !this.frozen;
    this.tell();
  }

  // around the cursor if it is visible, else around the middle
  zoom(factor) {
    const {from, to} = this.stretch();
    const fixed = this.at !== null && this.at > from && this.at < to ? this.at : (from + to) / 2;
    this.see({from: fixed - (fixed - from) * factor, to: fixed + (to - fixed) * factor});
  }

  shift(part) {
    const {from, to} = this.stretch();
    this.see({from: from + part * (to - from), to: to + part * (to - from)});
  }

  stretch() {
    return this.frozen?.stretch ?? {from: -this.seconds, to: 0};
  }

  // shows a section of the frozen data at full resolution; null shows all of it
  async see(stretch) {
    if (!this.frozen) this.freeze();
    const {frozen} = this;
    if (!frozen) return;
    frozen.stretch = stretch && this.within(stretch);
    this.asking?.abort();
    if (!frozen.stretch) this.drawFrozen(frozen);
    for (const each of this.charts) each.see(frozen.stretch?.from ?? null, frozen.stretch?.to);
    this.enable();
    if (frozen.stretch) await this.fetch(frozen);
  }

  within({from, to}) {
    const wide = Math.min(this.begun.kept_s, Math.max(to - from, 4 * this.begun.sync_period_s));
    const end = Math.min(0, Math.max(to, wide - this.begun.kept_s));
    return {from: end - wide, to: end};
  }

  async fetch(frozen) {
    const {sync_period_s: dt, axes} = this.begun;
    const end = frozen.columns.end_tick, {from, to} = frozen.stretch;
    this.asking = new AbortController();
    const query = new URLSearchParams({
      first_tick: Math.max(0, Math.floor(end + from / dt) - 1), end_tick: Math.ceil(end + to / dt) + 2, columns: MOST_COLUMNS,
    });
    try {
      const told = await this.context.get(`/api/live/samples?${query}`, {signal: this.asking.signal});
      if (this.frozen !== frozen || this.over) return;
      frozen.samples = told;
      const width = told.ticks_per_column;
      const length = told.axes[axes[0]].current_a.low.length;
      if (!axes.some((axis) => told.axes[axis].current_a.low.some((value) => value !== null))) this.remark(this.t("live.none"));
      const x = Array.from({length}, (_, k) => (told.first_tick + (k + 0.5) * width - 0.5 - end) * dt);
      this.drawSignals(x, (axis, name) => told.axes[axis][name]);
      this.tell();
    } catch (fault) {
      if (fault.name === "AbortError" || this.frozen !== frozen || this.over) return;
      this.drawFrozen(frozen);
      this.remark(`${fault.text}; ${fault.advice}`);
    }
  }

  // the columns at the time of freezing
  drawFrozen(frozen) {
    frozen.samples = null;
    this.fill(frozen.columns);
    this.tell();
  }

  // text -------------------------------------------------------------------------------------------------------

  tell() {
    const {t, begun, columns, frozen, header} = this;
    if (!begun || !this.names) return;
    const text = (words) => { if (this.state.textContent !== words) this.state.textContent = words; };
    const width_ms = (ticks) => this.context.number(ticks * begun.sync_period_s * 1e3, 3);
    if (frozen?.samples) {
      const width = frozen.samples.ticks_per_column;
      text(t(width === 1 ? "live.frozen.single" : "live.frozen.columns", {milliseconds: width_ms(width)}));
    } else if (frozen) text(t("live.frozen"));
    else if (this.socket.readyState === WebSocket.OPEN && header) {
      const still = columns.end === null || !begun.axes.some((axis) => columns.newest(axis, 1) !== null);
      if (header.trouble) text(t("live.trouble", {text: header.trouble}));
      else if (still) text(t("live.waiting"));
      else text(t(begun.ticks_per_column === 1 ? "live.single" : "live.running", {milliseconds: width_ms(begun.ticks_per_column)}));
    }
    this.drawValues();
  }

  drawValues() {
    const {t, begun, context: {number}} = this;
    const names = this.names.filter((name) => this.chosen.has(name));
    const columns = this.frozen?.columns ?? this.columns;
    const held = document.activeElement?.closest?.(".scroll") && this.values.contains(document.activeElement);
    const place = this.at === null ? null : this.indexAt(this.at);
    this.values.replaceChildren(table({
      caption: place === null ? t("live.values") : t("live.values.at", {at: number(-this.at, 5)}),
      head: [t("live.axis"), ...names.map((name) => `${t(`live.${name}`)} (${this.units[name]})`)],
      rows: begun.axes.filter((axis) => this.shown.has(axis)).map((axis) => [axis, ...names.map((name) => {
        if (place === null) {
          const value = columns.newest(axis, this.place[name]);
          return value === null ? "–" : this.fixed(name, this.shownAs(name, axis, {low: [value], high: [value]}).low[0]);
        }
        const [low, high] = this.valueAt(axis, name, place).map((value) => (value === null ? null : this.fixed(name, value)));
        return low === null ? "–" : low === high ? low : t("chart.between", {low, high});
      })]),
    }));
    if (held) this.values.querySelector(".scroll").focus();
  }

  indexAt(at) {
    const plot = this.charts.find((each) => !each.figure.hidden)?.plot;
    const index = plot ? plot.valToIdx(at) : null;
    return index === undefined ? null : index;
  }

  // the same decimals for every value of a signal, so that digits do not jump
  fixed(name, value) {
    return this.context.decimal(value, name.endsWith("_mm") ? 3 : name === "current_a" ? 2 : 1);
  }

  valueAt(axis, name, index) {
    const plot = this.charts[this.names.indexOf(name)].plot, k = 1 + 2 * this.begun.axes.indexOf(axis);
    return [plot.data[k][index] ?? null, plot.data[k + 1][index] ?? null];
  }

  end() {
    this.over = true;
    clearInterval(this.timer);
    clearTimeout(this.retry);
    clearTimeout(this.forget);
    this.asking?.abort();
    this.socket?.close();
    for (const each of this.charts) each.end();
  }
}
