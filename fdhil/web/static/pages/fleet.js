// All machines: /fleet, and the parameter trends of one axis: /fleet/MACHINE/AXIS. Reads only; nothing reaches a machine.

import {chart} from "/static/chart.js";
import {el, lamp, table} from "/static/dom.js";
import {number, t, when} from "/static/text.js";

const WORDS = ["look", "labels", "service.note"];
const day = (time) => (time ? time.slice(0, 10) : t("fleet.due.open"));
const minute = (time) => when(Date.parse(time) / 1000);
const percent = (part) => `${part > 0 ? "+" : ""}${number(100 * part, 3)} %`;
const signed = (value) => (value > 0 ? `+${number(value, 3)}` : number(value, 3));
const heads = (...keys) => keys.map((key) => ({text: t(`fleet.${key}`), class: WORDS.includes(key) ? "word" : null}));
const section = (title, ...children) => el("section", {"aria-label": title}, el("h2", {}, title), children);
const place = (machine, axis) => el("a", {href: `/fleet/${encodeURIComponent(machine)}/${axis}`}, t("fleet.axis.of", {machine, axis}));

export async function show(main, path, context) {
  const spot = main.appendChild(el("div"));  // answers that arrive after a page change are ignored
  if (path.rest.length === 2) return showAxis(spot, ...path.rest, context);
  const by = path.query.get("by") ?? "type";
  const [told, unlike] = await Promise.all([context.get("/api/fleet"), context.get(`/api/fleet/outliers?by=${encodeURIComponent(by)}`)]);
  spot.append(
    el("h1", {}, t("fleet.title")), el("p", {class: "soft"}, t("fleet.intro", {count: told.machines.length})),
    told.refused_messages ? el("p", {}, lamp("warn", t("fleet.refused", {count: told.refused_messages}))) : "",
    section(t("fleet.due"), due(told.due)),
    section(t("fleet.outliers"), chooser(told.machines, by, context), outliers(unlike.outliers)),
    section(t("fleet.machines"), machines(told.machines)));
  return null;
}

function due(rows) {
  if (!rows.length) return el("p", {}, t("fleet.due.none"));
  return table({
    caption: t("fleet.due.caption"), stack: true,
    head: heads("axis", "parameter", "value", "limit", "date", "span"),
    rows: rows.map((row) => [place(row.machine, row.axis), row.parameter, `${number(row.value)} ${row.unit}`, `${number(row.limit)} ${row.unit}`,
      row.reached ? lamp("bad", t("fleet.due.now")) : lamp("warn", day(row.date)),
      t("fleet.due.between", {earliest: day(row.earliest), latest: day(row.latest)})]),
  });
}

function chooser(machines, by, context) {
  const names = [...new Set(["type", by, ...machines.flatMap((machine) => Object.keys(machine.labels))])].sort();
  const choice = el("select", {id: "by", onchange: (event) => context.go(`/fleet?by=${encodeURIComponent(event.target.value)}`)},
    names.map((name) => el("option", {value: name, selected: name === by}, name)));
  return el("p", {}, el("label", {for: "by"}, t("fleet.by")), choice);
}

function outliers(rows) {
  if (!rows.length) return el("p", {}, t("fleet.outliers.none"));
  return table({
    caption: t("fleet.outliers.caption"), stack: true,
    head: heads("axis", "parameter", "value", "off", "expected", "count", "look"),
    rows: rows.map((row) => [place(row.machine, row.axis), row.parameter, `${number(row.value)} ${row.unit}`, lamp("bad", percent(row.off)),
      `${number(row.median)} ${row.unit}`, String(row.sisters),
      {class: "long", text: t(row.off_by_its_other_axes / row.off > 0.5 ? "fleet.look.machine" : "fleet.look.axis")}]),
  });
}

function machines(rows) {
  if (!rows.length) return el("p", {}, t("fleet.none"));
  const labels = (machine) => Object.entries(machine.labels).map(([name, text]) => `${name} ${text}`).join(", ");
  const axes = (machine) => el("span", {class: "targets"}, Object.keys(machine.axes).flatMap((axis) => [
    el("a", {href: `/fleet/${encodeURIComponent(machine.machine)}/${axis}`, "aria-label": t("fleet.axis.of", {machine: machine.machine, axis})}, axis), " "]));
  return table({
    caption: t("fleet.machines.caption"), stack: true,
    head: heads("machine", "labels", "heard", "records", "missing", "notices", "axes"),
    rows: rows.map((row) => [row.doubt ? lamp("bad", `${row.machine}: ${row.doubt}`) : row.machine, {class: "long", text: labels(row)}, minute(row.last_heard), number(row.records, 9),
      row.missing > 0 ? lamp("bad", number(row.missing, 9)) : t("fleet.missing.none"),
      row.open_notices ? lamp("warn", String(row.open_notices)) : "0", axes(row)]),
  });
}

async function showAxis(spot, machine, axis, context) {
  const where = `machine=${encodeURIComponent(machine)}`;
  const [told, {services}] = await Promise.all([
    context.get(`/api/fleet/axis?${where}&axis=${encodeURIComponent(axis)}`), context.get(`/api/fleet/services?${where}`)]);
  const grid = el("div", {class: "charts"});
  spot.append(
    el("h1", {}, t("fleet.axis.of", {machine, axis})), el("p", {}, el("a", {href: "/fleet"}, t("fleet.back"))),
    section(t("fleet.newest"), newest(told.courses)),
    section(t("fleet.courses"), grid),
    section(t("fleet.services"), changes(services.filter((each) => each.axis === null || each.axis === axis), axis)));
  const charts = told.courses.filter((each) => each.sets.some((set) => set.value !== null)).map((each) => draw(grid, each));
  return () => charts.forEach((each) => each.end());
}

function newest(courses) {
  const value = (set) => (set.low === null ? number(set.value) : `${number(set.value)} (${number(set.low)} … ${number(set.high)})`);
  return table({
    caption: t("fleet.newest.caption"),
    head: heads("parameter", "value", "slope", "temperature", "date"),
    rows: courses.map((each) => [each.parameter, `${value(each.sets.at(-1))} ${each.unit}`,
      each.slope_per_30_days === null ? "–" : `${signed(each.slope_per_30_days)} ${each.unit}`,
      number(each.sets.at(-1).temperature_c, 3), minute(each.sets.at(-1).time)]),
  });
}

function draw(grid, {parameter, unit, sets}) {
  const shown = chart(grid, {
    caption: t("fleet.course", {parameter}), unit, x: {time: true},
    series: [{label: t("fleet.interval"), colour: 1, band: true}, {label: t("fleet.set"), colour: 2, points: true}],
  });
  const rising = [...sets].sort((one, other) => Date.parse(one.time) - Date.parse(other.time));
  shown.set(rising.map((set) => Date.parse(set.time) / 1000),
    [{low: rising.map((set) => set.low), high: rising.map((set) => set.high)}, rising.map((set) => set.value)]);
  return shown;
}

function changes(services, axis) {
  if (!services.length) return el("p", {}, t("fleet.services.none"));
  const rows = services.flatMap((service) => {
    const head = [day(service.serviced_at), {class: "long", text: service.note || "–"}];
    const own = service.changes.filter((change) => change.axis === axis);
    if (!own.length) return [[...head, "–", "–", t("fleet.service.unknown")]];
    return own.map((change) => [...head, change.parameter, `${number(change.before)} ${change.unit}`,
      `${signed(change.change)} (${signed(change.low)} … ${signed(change.high)})${change.sure ? "" : `, ${t("fleet.service.chance")}`}`]);
  });
  return table({
    caption: t("fleet.services.caption"), stack: true,
    head: heads("service.when", "service.note", "parameter", "service.before", "service.change"),
    rows,
  });
}
