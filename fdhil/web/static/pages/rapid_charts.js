// The charts of a rapid: each signal with its model and below it the residual, or with another rapid and below it
// their difference; then spectra. Tables and sentences contain the same.

import {chart} from "/static/chart.js";
import {el, table} from "/static/dom.js";
import {number, t} from "/static/text.js";

const DASH = [7, 4];
const nameOf = (rapid) => `${rapid.axis}/${rapid.id}`;
const title = (signal) => t(`rapid.${signal.name}`);
const unitOf = (signal) => signal.shown_unit;
const most = (values) => values.reduce((largest, value) => (value === null ? largest : Math.max(largest, Math.abs(value))), 0);
const less = (a, b) => a.map((value, k) => (value === null || b[k] === null ? null : value - b[k]));

export class Drawn {
  constructor(place, one, other) {
    Object.assign(this, {charts: [], spectra: []});
    const {own} = one;
    this.stretches = el("p", {class: "actions", role: "group", "aria-label": t("rapid.stretch")});
    const field = el("div", {class: "charts"});
    place.append(
      ...(other ? [el("p", {}, t("rapid.compared", other.rapid), ". ", own.direction === other.own.direction ? "" : t("rapid.compared.mirrored"))] : []),
      el("p", {class: "soft"}, t("rapid.hint"), own.every > 1 ? ` ${t("rapid.every", own)}` : ""), key(one, other), this.stretches, field);
    if (other) this.drawTwo(field, one, other); else this.drawOne(field, own);
    this.drawStretches(own, other ? own.move_begin_s : 0);
    place.append(el("div", {class: "numbers"}, other ? numbersOfTwo(one, other) : numbers(own)));
    const spectra = el("section");
    place.after(spectra);
    this.drawSpectra(spectra, one, other);
  }

  end() {
    for (const each of [...this.charts, ...this.spectra]) each.end();
  }

  see(charts, stretch) {
    for (const each of charts) if (stretch) each.see(stretch.from, stretch.to); else each.see(null);
  }

  draw(field, caption, unit, series, x, values, more = {}) {
    const shown = chart(field, {
      caption, unit, series, x: {label: t("rapid.time"), unit: "s"}, sync: "rapid", height: 190,
      onZoom: (stretch) => this.see(this.charts, stretch), ...more,
    });
    shown.set(x, values);
    this.charts.push(shown);
  }

  drawOne(field, own) {
    for (const signal of own.signals) {
      const pair = el("div", {class: "pair"});
      field.append(pair);
      const series = [{label: t("rapid.measured"), colour: 1}, {label: t("rapid.model"), colour: 2, dash: DASH}];
      const known = signal.modelled !== null;
      this.draw(pair, title(signal), unitOf(signal), known ? series : series.slice(0, 1), own.time_s, known ? [signal.measured, signal.modelled] : [signal.measured]);
      if (!known) continue;
      const left = [{label: t("rapid.left_over"), colour: 4}];
      this.draw(pair, t("rapid.residual", {name: title(signal)}), unitOf(signal), left, own.time_s, [signal.residual], {height: 130});
    }
  }

  drawTwo(field, one, other) {
    const {own} = one;
    const x = own.time_s.map((time) => time - own.move_begin_s);
    const label = t("rapid.time.aligned");
    for (const signal of own.signals) {
      const second = other.own.signals.find(({name}) => name === signal.name);
      if (!second) continue;
      const pair = el("div", {class: "pair"});
      field.append(pair);
      const laid = laidOver(one.own, other.own, second.measured);
      const series = [one, other].map(({rapid}, k) => ({label: nameOf(rapid), colour: k ? 3 : 1, dash: k ? DASH : undefined}));
      this.draw(pair, title(signal), unitOf(signal), series, x, [signal.measured, laid], {x: {label, unit: "s"}});
      const apart = [{label: t("rapid.difference", {id: nameOf(one.rapid), other: nameOf(other.rapid)}), colour: 4}];
      const caption = t("rapid.apart", {name: title(signal)});
      this.draw(pair, caption, unitOf(signal), apart, x, [less(signal.measured, laid)], {x: {label, unit: "s"}, height: 130});
    }
  }

  drawStretches(own, zero) {
    const button = (text, stretch) => el("button", {type: "button", onclick: () => this.see(this.charts, stretch)}, text);
    this.stretches.append(button(t("rapid.whole"), null), ...own.stages.map(({name, begin_s: begin, end_s: end}) => (
      button(t(`rapid.${name}`), {from: begin - zero, to: end - zero}))));
  }

  drawSpectra(place, {rapid, own}, other) {
    const field = el("div", {class: "charts"});
    const whole = el("button", {type: "button", onclick: () => this.see(this.spectra, null)}, t("rapid.whole"));
    place.append(el("h2", {}, t("rapid.spectra")), el("p", {}, t("rapid.spectra.lead", {turns: number(own.turns_hz, 4)})), el("p", {}, whole), field);
    for (const signal of own.signals) {
      const pair = el("div", {class: "pair"});
      field.append(pair);
      const second = other?.own.signals.find(({name}) => name === signal.name);
      const lines = [[{label: other ? nameOf(rapid) : t("rapid.measured"), colour: 1}, signal.measured_spectrum]];
      if (second) lines.push([{label: nameOf(other.rapid), colour: 3, dash: DASH}, between(own.frequency_hz, other.own.frequency_hz, second.measured_spectrum)]);
      else if (signal.residual_spectrum) lines.push([{label: t("rapid.left_over"), colour: 4}, signal.residual_spectrum]);
      const shown = chart(pair, {
        caption: t("rapid.spectrum", {name: title(signal)}), unit: unitOf(signal), series: lines.map(([told]) => told), log: true, height: 190,
        x: {label: t("rapid.frequency"), unit: "Hz"}, sync: "rapid-spectrum", onZoom: (stretch) => this.see(this.spectra, stretch),
      });
      shown.set(own.frequency_hz, lines.map(([, values]) => values));
      this.spectra.push(shown);
      if (!other) pair.append(peak(signal, own));
    }
  }
}

function key({rapid}, other) {
  const lines = other
    ? [["", nameOf(rapid)], ["three", nameOf(other.rapid)], ["four", t("rapid.difference", {id: nameOf(rapid), other: nameOf(other.rapid)})]]
    : [["", t("rapid.measured")], ["two", t("rapid.model")], ["four", t("rapid.left_over")]];
  return el("ul", {class: "key", "aria-label": t("rapid.key")}, lines.map(([name, text]) => el("li", {class: name}, text)));
}

function numbers(own) {
  return table({
    caption: t("rapid.numbers"), stack: true,
    head: [t("rapid.signal"), t("rapid.most"), t("rapid.left_rms"), t("rapid.share"), {text: t("rapid.made_by"), class: "word"}],
    rows: own.signals.map((signal) => {
      const largest = most(signal.measured), left = signal.residual_rms, unit = unitOf(signal);
      return [
        title(signal), `${number(largest)} ${unit}`, left === null ? "–" : `${number(left, 3)} ${unit}`,
        left === null || !largest ? "–" : `${number(100 * left / largest, 2)} %`, {text: t(`rapid.by.${signal.model ?? "none"}`), class: "word"},
      ];
    }),
  });
}

function peak(signal, own) {
  if (!signal.residual_spectrum) return "";
  const largest = most(signal.residual_spectrum), at = signal.residual_spectrum.indexOf(largest);
  return el("p", {class: "soft"}, t("rapid.peak", {amplitude: number(largest, 3), unit: unitOf(signal), frequency: number(own.frequency_hz[at] ?? null, 4)}));
}

function numbersOfTwo({rapid, own}, other) {
  const rows = own.signals.map((signal) => {
    const second = other.own.signals.find(({name}) => name === signal.name), unit = unitOf(signal);
    if (!second) return [title(signal), `${number(most(signal.measured))} ${unit}`, "–", "–"];
    const apart = less(signal.measured, laidOver(own, other.own, second.measured)).filter((value) => value !== null);
    const rms = Math.sqrt(apart.reduce((sum, value) => sum + value * value, 0) / apart.length);
    return [title(signal), ...[signal, second].map(({measured}) => `${number(most(measured))} ${unit}`), `${number(rms, 3)} ${unit}`];
  });
  const heads = [rapid, other.rapid].map((each) => t("rapid.most.of", {id: nameOf(each)}));
  return table({caption: t("rapid.numbers"), stack: true, head: [t("rapid.signal"), ...heads, t("rapid.difference_rms")], rows});
}

// another rapid's signal at the times of this one, both from the start of the move; mirrored if it moved the other way
function laidOver(own, other, values) {
  const side = own.direction * other.direction;
  const later = own.move_begin_s - other.move_begin_s;
  return between(own.time_s, other.time_s.map((time) => time + later), values).map((value) => (value === null ? null : side * value));
}

// linear interpolation between known values; null beyond them and next to unknown ones
function between(x, grid, values) {
  let k = 0;
  return x.map((at) => {
    while (k + 2 < grid.length && grid[k + 1] <= at) k++;
    const [low, high] = [grid[k], grid[k + 1]];
    if (high === undefined || at < low - 1e-9 || at > high + 1e-9 || values[k] === null || values[k + 1] === null) return null;
    return values[k] + (values[k + 1] - values[k]) * (at - low) / (high - low);
  });
}
