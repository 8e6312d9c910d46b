// The page live: the signals of the axes as they pass, frozen and enlarged down to single samples.

import {chart} from "/static/chart.js";
import {el, table} from "/static/dom.js";
import {Columns, decode} from "/static/pages/live_columns.js";

const SECONDS = [1, 2, 5, 10, 20, 60];
const MOST_COLUMNS = 800, FEWEST_COLUMNS = 150;
const RETRY_MS = [500, 1000, 2000, 5000];
const TABLE_MS = 500;
const NOTE_MS = 5000;

export async function show(main, path, context) {
  const page = new Live(main, path, context);
  page.connect();
  return () => page.end();
}

class Live {
  constructor(main, path, context) {
    Object.assign(this, {context, main, t: context.t, charts: [], columns: null, frozen: null, tries: 0, over: false, at: null});
    this.wanted = path.query.get("axis")?.split(",") ?? null;
    this.seconds = SECONDS.includes(Number(path.query.get("seconds"))) ? Number(path.query.get("seconds")) : 10;
    this.draw();
  }

  draw() {
    const {t} = this;
    const button = (key, act) => el("button", {type: "button", onclick: act}, t(key));
    this.state = el("p", {role: "status"}, t("live.connecting"));
    this.note = el("p", {role: "status"});
    this.axes = el("fieldset", {class: "choices"}, el("legend", {}, t("live.axes")));
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
        el("div", {class: "choices"}, this.axes, el("span", {}, el("label", {for: "live-seconds"}, t("live.seconds")), this.select)),
        el("div", {class: "actions"}, this.freezing, this.moving),
        this.state, this.note),
      el("section", {}, this.values),
      el("section", {}, el("h2", {}, t("live.charts")), el("p", {class: "soft"}, t("live.hint")), this.field));
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
    this.context.lookNow();  // which also finds out whether the login has ended
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

  // says something beside the state for some seconds
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
    this.charts = begin.signals.map(({name, unit}) => chart(this.field, {
      caption: this.t(`live.${name}`), unit, sync: "live", steady: true, height: 170, x: {label: this.t("live.time"), unit: "s"},
      series: begin.axes.map((axis, k) => ({label: axis, colour: k % 6 + 1, band: true, hidden: !this.shown.has(axis)})),
      onZoom: (stretch) => this.see(stretch), onCursor: (at) => { this.at = at; },
    }));
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
    const query = new URLSearchParams({...(all ? {} : {axis: [...this.shown].join(",")}), seconds: this.seconds});
    history.replaceState({}, "", `/live?${query}`);
  }

  fill(columns) {
    this.charts.forEach((each, s) => {
      const values = this.begun.axes.map((axis) => columns.of(axis, s));
      each.figure.hidden = !values.some(({low}) => low.some((value) => value !== null));
      each.set(columns.x, values);
    });
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

  // around the cursor where it is in sight, else around the middle
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

  // shows a stretch of what is frozen with all that is kept of it; null shows all of it again
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
      const names = this.begun.signals.map(({name}) => name);
      const length = told.axes[axes[0]][names[0]].low.length;
      if (!axes.some((axis) => told.axes[axis].current_a.low.some((value) => value !== null))) this.remark(this.t("live.none"));
      const x = Array.from({length}, (_, k) => (told.first_tick + (k + 0.5) * width - 0.5 - end) * dt);
      this.charts.forEach((each, s) => each.set(x, axes.map((axis) => told.axes[axis][names[s]])));
      this.tell();
    } catch (fault) {
      if (fault.name === "AbortError" || this.frozen !== frozen || this.over) return;
      this.drawFrozen(frozen);
      this.remark(`${fault.text}; ${fault.advice}`);
    }
  }

  // the columns as they were when it was frozen
  drawFrozen(frozen) {
    frozen.samples = null;
    this.fill(frozen.columns);
    this.tell();
  }

  // in words -------------------------------------------------------------------------------------------------------

  tell() {
    const {t, begun, columns, frozen, header} = this;
    if (!begun) return;
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
    const columns = this.frozen?.columns ?? this.columns;
    const held = document.activeElement?.closest?.(".scroll") && this.values.contains(document.activeElement);
    const place = this.at === null ? null : this.indexAt(this.at);
    this.values.replaceChildren(table({
      caption: place === null ? t("live.values") : t("live.values.at", {at: number(-this.at, 5)}),
      head: [t("live.axis"), ...begun.signals.map(({name, unit}) => `${t(`live.${name}`)} (${unit})`)],
      rows: begun.axes.filter((axis) => this.shown.has(axis)).map((axis) => [axis, ...begun.signals.map((_, s) => {
        if (place === null) return number(columns.newest(axis, s));
        const [low, high] = this.valueAt(axis, s, place);
        return low === high ? number(low) : t("chart.between", {low: number(low), high: number(high)});
      })]),
    }));
    if (held) this.values.querySelector(".scroll").focus();
  }

  indexAt(at) {
    const plot = this.charts[0]?.plot;
    const index = plot ? plot.valToIdx(at) : null;
    return index === undefined ? null : index;
  }

  valueAt(axis, s, index) {
    const plot = this.charts[s].plot, k = 1 + 2 * this.begun.axes.indexOf(axis);
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
