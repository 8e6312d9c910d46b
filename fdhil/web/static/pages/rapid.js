// One rapid: its verdict and reasons, its signals with the model, spectra; ?with=X/12 compares another.

import {el, faultBox, table} from "/static/dom.js";
import {Drawn} from "/static/pages/rapid_charts.js";
import {at, micrometres, percent, place, verdictOf, way} from "/static/pages/rapids.js";
import {decimal, number, t} from "/static/text.js";

export async function show(main, path, context) {
  const page = new Page(main, context);
  await page.begin(path);
  return () => page.end();
}

const apiOf = (axis, id) => `/api/rapids/${encodeURIComponent(axis)}/${encodeURIComponent(id)}`;
const nameOf = (rapid) => `${rapid.axis}/${rapid.id}`;

class Page {
  constructor(main, context) {
    Object.assign(this, {main, context, drawn: null, over: false});
  }

  async begin(path) {
    const [axis, id] = path.rest;
    const other = path.query.get("with")?.match(/^([A-Z])\/(\d+)$/);
    const asked = [[axis, id], ...(other ? [other.slice(1)] : [])];
    const signals = Promise.all(asked.map((each) => this.context.get(`${apiOf(...each)}/signals`)));
    signals.catch(() => null);  // reported where it is drawn
    const [told, second] = await Promise.all(asked.map((each) => this.context.get(apiOf(...each))));
    if (this.over) return;
    document.title = `${t("rapid.title", told.rapid)} – fdhil`;
    this.main.append(
      el("h1", {}, t("rapid.title", told.rapid)), this.ways(told), this.verdict(told.rapid),
      el("div", {class: "grid beside"}, this.parameters(told, second), this.compareForm(told, other)));
    this.signals(told.rapid, second?.rapid, signals);
  }

  end() {
    this.over = true;
    this.drawn?.end();
  }

  ways({rapid, older_id: older, newer_id: newer}) {
    const link = (id, key) => (id === null ? null : el("a", {href: place({...rapid, id})}, t(key)));
    const save = async () => {
      await this.context.download(`/api/rapids/recordings/${encodeURIComponent(rapid.file)}`, rapid.file);
      this.context.say(t("rapid.download.done", {file: rapid.file}));
    };
    return el("p", {class: "choices"},
      el("a", {href: `/rapids?axis=${rapid.axis}`}, t("rapid.list", rapid)), link(older, "rapid.before"), link(newer, "rapid.after"),
      rapid.kept ? el("button", {type: "button", onclick: () => save().catch((fault) => this.context.say(fault.text))}, t("rapid.download")) : null);
  }

  verdict(rapid) {
    const facts = [t("rapid.facts", {when: at(rapid.time), way: way(rapid)})];
    if (rapid.fit_percent !== null) facts.push(t("rapid.facts.explained", {explained: percent(rapid.fit_percent)}));
    if (rapid.unexplained_um !== null) facts.push(t("rapid.facts.left", {left: micrometres(rapid.unexplained_um)}));
    if (rapid.temperature_celsius !== null) facts.push(t("rapid.facts.temperature", {celsius: number(rapid.temperature_celsius, 4)}));
    if (rapid.nc?.line) facts.push(t("rapid.facts.nc", {line: rapid.nc.line, program: rapid.nc.program ?? t("rapid.unknown")}));
    if (rapid.nc?.override) {
      const [low, high] = rapid.nc.override.map((share) => number(100 * share, 4));
      facts.push(t("rapid.facts.override", {low, high}));
    }
    this.said = {reasons: list("rapid.reasons", rapid.reasons), warnings: list("rapid.warnings", rapid.warnings)};
    this.differs = el("p", {});
    return el("section", {"aria-label": t("rapid.verdict")},
      el("h2", {}, verdictOf(rapid)), el("p", {}, facts.join(" ")), this.said.reasons, this.said.warnings, this.differs);
  }

  // the replay adds the next action, and whether the present configuration changes the verdict
  replayed(rapid, now) {
    for (const name of ["reasons", "warnings"]) {
      const advised = rapid[name].map((said) => ({...said, advice: now[name].find(({code}) => code === said.code)?.advice}));
      const renewed = list(`rapid.${name}`, advised);
      this.said[name].replaceWith(renewed);
      this.said[name] = renewed;
    }
    const near = (one, two) => one === two || (one !== null && two !== null && Math.abs(one - two) <= 0.01 * Math.abs(one));
    if (rapid.accepted === now.accepted && near(rapid.unexplained_um, now.unexplained_um)) return;
    const verdict = t(now.accepted ? "rapids.accepted" : "rapids.refused");
    const figures = {verdict, explained: percent(now.fit_percent), left: micrometres(now.unexplained_um)};
    this.differs.textContent = t("rapid.replay_differs", figures);
  }

  compareForm({rapid, alike_id: alike}, other) {
    const field = el("input", {id: "rapid-with", required: true, pattern: "[A-Za-z]/[0-9]{1,18}", value: other ? other[0] : "", size: "10"});
    const submit = (event) => {
      event.preventDefault();
      this.context.go(`${place(rapid)}?with=${field.value.toUpperCase()}`);
    };
    return el("section", {},
      el("h2", {}, t("rapid.compare")),
      alike === null ? null : el("p", {}, el("a", {href: `${place(rapid)}?with=${rapid.axis}/${alike}`}, t("rapid.compare.alike", {id: alike}))),
      el("form", {class: "choices", onsubmit: submit},
        el("div", {}, el("label", {for: "rapid-with"}, t("rapid.compare.number")), field),
        el("button", {type: "submit"}, t("rapid.compare.go")),
        other ? el("a", {href: place(rapid)}, t("rapid.compare.end")) : null));
  }

  parameters(told, second) {
    const others = new Map((second?.parameters ?? []).map((figure) => [figure.name, figure]));
    const head = ["rapid.parameter", "rapid.unit"].map((key) => t(key));
    const names = [told, second].filter(Boolean).map(({rapid}) => t("rapid.value", {id: nameOf(rapid)}));
    return el("section", {}, table({
      caption: t("rapid.parameters"), stack: Boolean(second),
      head: [head[0], {text: head[1], class: "word"}, ...names, ...(second ? [t("rapid.change")] : [])],
      rows: told.parameters.map((figure) => [
        figure.name, {text: figure.shown_unit, class: "word"}, shown(figure),
        ...(second ? [shown(others.get(figure.name)), change(figure, others.get(figure.name))] : []),
      ]),
    }));
  }

  async signals(rapid, second, asked) {
    const loading = el("p", {class: "soft"}, t("page.loading"));
    const section = el("section", {"aria-busy": "true"}, el("h2", {}, t(second ? "rapid.signals.two" : "rapid.signals")), loading);
    this.main.append(section);
    try {
      const [own, other] = await asked;
      if (this.over) return;
      loading.remove();
      this.replayed(rapid, own.replayed);
      this.drawn = new Drawn(section, {rapid, own}, other ? {rapid: second, own: other} : null);
    } catch (fault) {
      loading.replaceWith(fault.code === "NotKept" ? el("p", {}, t("rapid.gone")) : faultBox(fault));
    }
    section.removeAttribute("aria-busy");
  }
}

function list(key, said) {
  if (!said.length) return el("div");
  return el("div", {}, el("h3", {}, t(key)), el("ul", {}, said.map(({code, text, advice}) => el("li", {},
    el("strong", {}, code), text ? `: ${text}` : "", advice ? ` → ${advice}` : ""))));
}

const shown = (figure) => (figure?.value === null ? {text: figure.reason, class: "long"} : figure?.shown);

function change(figure, other) {
  if (!other?.value || figure.value === null) return "–";
  const share = 100 * (figure.value / other.value - 1);
  return `${share >= 0.05 ? "+" : ""}${decimal(share, 1)} %`;
}
