// The page rapids: the recorded ones with their verdicts; /rapids/X/12 is one of them.

import {el, faultBox, lamp, table} from "/static/dom.js";
import {decimal, number, t, when} from "/static/text.js";

const MOST_COMPARED = 2;
const PAGE = {wide: 25, narrow: 10};

export async function show(main, path, context) {
  dress();
  const place = main.appendChild(el("div"));  // answers that arrive after a page change are ignored
  if (path.rest.length === 2) return (await import("/static/pages/rapid.js")).show(place, path, context);
  const list = new List(place, context);
  await list.begin(path);
  return () => list.end();
}

const LOOK = "/static/pages/rapids.css";
function dress() {
  if (!document.querySelector(`link[href="${LOOK}"]`)) document.head.append(el("link", {rel: "stylesheet", href: LOOK}));
}

// "2026-11-20T13:20:19+00:00" as every page formats times
export const at = (time) => when(Date.parse(time) / 1000);
export const way = (rapid) => `${rapid.direction > 0 ? "+" : "−"}${rapid.axis}`;
export const place = (rapid) => `/rapids/${rapid.axis}/${rapid.id}`;
export const percent = (value) => (value === null ? "–" : `${decimal(value, 2)} %`);
export const micrometres = (value) => (value === null ? "–" : `${value < 10 ? decimal(value, 2) : number(value, 3)} µm`);

export function verdictOf(told) {
  if (!told.accepted) return lamp("bad", t("rapids.refused"));
  return told.warnings.length ? lamp("warn", t("rapids.warned")) : lamp("good", t("rapids.accepted"));
}

class List {
  constructor(main, context) {
    Object.assign(this, {context, marked: [], asking: null});
    this.counts = el("p", {});
    this.form = el("form", {class: "choices", onsubmit: (event) => event.preventDefault(), "aria-label": t("rapids.filter")});
    this.result = el("div");
    main.append(el("h1", {}, t("nav.rapids")), el("p", {}, t("rapids.lead"), " ", t("rapids.columns")), this.counts, el("section", {}, this.form, this.result));
  }

  async begin(path) {
    this.query = new URLSearchParams(path.query);
    const [counts] = await Promise.all([this.context.get(this.address("/api/rapids/counts", ["axis"])), this.fetch()]);
    this.drawForm(counts);
  }

  end() {
    this.asking?.abort();
  }

  address(base, names) {
    const wanted = new URLSearchParams(names.filter((name) => this.query.get(name)).map((name) => [name, this.query.get(name)]));
    return wanted.size ? `${base}?${wanted}` : base;
  }

  drawForm(counts) {
    this.drawCounts(counts);
    const choice = (name, options) => {
      const now = this.query.get(name) ?? "";
      const select = el("select", {id: `rapids-${name}`, onchange: () => this.choose(name, select.value)},
        [["", t("rapids.all")], ...options].map(([value, text]) => el("option", {value, selected: value === now}, text)));
      return el("div", {}, el("label", {for: `rapids-${name}`}, t(`rapids.${name === "code" ? "reason" : name}`)), select);
    };
    this.form.replaceChildren(
      choice("axis", counts.axes.map((axis) => [axis, axis])),
      choice("verdict", ["accepted", "refused"].map((value) => [value, t(`rapids.${value}`)])),
      choice("code", counts.by_reason.map(({code, rapids}) => [code, `${code} (${rapids})`])));
  }

  drawCounts(counts) {
    const told = {searched: number(counts.searched, 9), accepted: number(counts.accepted, 9), refused: number(counts.refused, 9)};
    this.counts.textContent = t(counts.searched ? "rapids.counts" : "rapids.none_yet", told);
  }

  async choose(name, value) {
    if (value) this.query.set(name, value); else this.query.delete(name);
    this.query.delete("before");
    if (name === "axis") this.drawCounts(await this.context.get(this.address("/api/rapids/counts", ["axis"])));
    this.turnTo(true);
  }

  async turnTo(replace) {
    const names = ["axis", "verdict", "code", "before"];
    history[replace ? "replaceState" : "pushState"]({}, "", this.address("/rapids", names));
    const count = await this.fetch();
    if (count !== null) this.context.say(t("rapids.shown", {count}));
  }

  // returns the number of rapids; null if another request was sent meanwhile
  async fetch() {
    this.asking?.abort();
    const asking = this.asking = new AbortController();
    try {
      const limit = PAGE[matchMedia("(max-width: 40rem)").matches ? "narrow" : "wide"];
      const address = this.address("/api/rapids", ["axis", "verdict", "code", "before"]);
      const told = await this.context.get(`${address}${address.includes("?") ? "&" : "?"}limit=${limit}`, {signal: asking.signal});
      this.draw(told);
      return told.rapids.length;
    } catch (fault) {
      if (fault.name === "AbortError") return null;
      this.result.replaceChildren(faultBox(fault));
      return null;
    }
  }

  draw({rapids, older_before: older}) {
    this.marked = [];
    this.compare = el("button", {type: "button", disabled: true, onclick: () => this.goCompare()}, t("rapids.compare.marked"));
    const turn = (key, before) => el("button", {type: "button", onclick: () => {
      if (before === null) this.query.delete("before"); else this.query.set("before", before);
      this.turnTo(false);
    }}, t(key));
    this.result.replaceChildren(
      rapids.length ? this.table(rapids) : el("p", {}, t("rapids.none")),
      el("p", {class: "actions"},
        this.query.has("before") ? turn("rapids.newest", null) : null,
        older === null ? null : turn("rapids.older", older),
        rapids.length > 1 ? this.compare : null));
  }

  table(rapids) {
    const told = {
      rapid: {of: (rapid) => el("a", {href: place(rapid)}, `${rapid.axis}/${rapid.id}`)},
      compare: {of: (rapid) => this.mark(rapid)},
      when: {of: (rapid) => at(rapid.time), class: "word"},
      verdict: {of: verdictOf, class: "word"},
      way: {of: way},
      explained: {of: (rapid) => percent(rapid.fit_percent)},
      left: {of: (rapid) => micrometres(rapid.unexplained_um)},
      temperature: {of: (rapid) => celsius(rapid), known: (rapid) => rapid.temperature_celsius !== null},
      line: {of: (rapid) => lineOf(rapid.nc), known: (rapid) => rapid.nc, class: "word"},
      why: {of: (rapid) => [...rapid.reasons, ...rapid.warnings].map((said) => said.code).join(", ") || "–", class: "long"},
    };
    const columns = Object.entries(told).filter(([, {known}]) => !known || rapids.some(known));
    return table({
      caption: t("rapids.caption"), stack: true, class: "stack rapids",
      head: columns.map(([name, column]) => ({text: t(`rapids.${name}`), class: column.class})),
      rows: rapids.map((rapid) => columns.map(([, column]) => ({text: column.of(rapid), class: column.class}))),
    });
  }

  mark(rapid) {
    const box = el("input", {type: "checkbox", "aria-label": t("rapids.compare.mark", {id: `${rapid.axis}/${rapid.id}`})});
    box.addEventListener("change", () => {
      this.marked = this.marked.filter((each) => each.box !== box);
      if (box.checked) this.marked.push({box, rapid});
      while (this.marked.length > MOST_COMPARED) this.marked.shift().box.checked = false;
      this.compare.disabled = this.marked.length < MOST_COMPARED;
    });
    return box;
  }

  goCompare() {
    const [one, other] = this.marked.map(({rapid}) => rapid);
    this.context.go(`${place(one)}?with=${other.axis}/${other.id}`);
  }
}

const celsius = (rapid) => (rapid.temperature_celsius === null ? "–" : `${decimal(rapid.temperature_celsius, 1)} °C`);

function lineOf(nc) {
  if (!nc || nc.line === null) return "–";
  return nc.program ? `${nc.program}:${nc.line}` : String(nc.line);
}
