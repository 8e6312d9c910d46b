// The drives' state and parameter trends: /history, /history/X.

import {course} from "/static/course.js";
import {el, lamp, table} from "/static/dom.js";
import {number, t} from "/static/text.js";
import {dress, minute, noticeList} from "/static/notices.js";

const date = (time) => (time ? time.slice(0, 10) : "–");

export async function show(main, path, context) {
  dress();
  const place = main.appendChild(el("div"));  // answers that arrive after a page change are ignored
  if (path.rest.length) return showAxis(place, path.rest[0], context);
  const {axes} = await context.get("/api/history");
  if (axes.length === 1) return showAxis(place, axes[0].axis, context);
  place.append(el("h1", {}, t("history.title")), el("p", {class: "soft"}, t("history.intro")),
    el("div", {class: "grid"}, axes.map(overview)));
  return null;
}

function overview(axis) {
  return el("section", {"aria-label": t("history.open", {axis: axis.axis})},
    el("h2", {}, el("a", {href: `/history/${encodeURIComponent(axis.axis)}`}, t("history.open", {axis: axis.axis}))),
    el("p", {}, lamp(axis.state, t(`history.${axis.state}`))),
    axis.says.map((sentence) => el("p", {}, sentence)), seen(axis));
}

function seen(axis) {
  const key = axis.newest_time ? "history.seen" : "history.seen.none";
  const values = {seen: axis.rapids_seen, refused: axis.rapids_refused, time: axis.newest_time ? minute(axis.newest_time) : ""};
  return el("p", {class: "soft"}, t(key, values));
}

async function showAxis(place, name, context) {
  const told = await context.get(`/api/history/${encodeURIComponent(name)}`);
  const charts = [];
  place.append(
    el("h1", {}, t("history.axis", {axis: name})), told.axes.length > 1 ? otherAxes(told.axes, name) : "",
    section(t("history.how"), el("p", {}, lamp(told.state, t(`history.${told.state}`))),
      told.says.map((sentence) => el("p", {}, sentence)), seen(told), latest(told), limits(told)),
    section(t("history.courses"), told.courses.length ? told.courses.map((each) => parameter(each, name, charts)) : el("p", {}, t("history.courses.none")),
      slopes(told)),
    section(t("history.changes"), changes(told, name)),
    section(t("history.notices"), told.notices.length ? noticeList(told.notices) : el("p", {}, t("history.notices.none")),
      el("p", {}, el("a", {href: `/events?axis=${encodeURIComponent(name)}`}, t("history.notices.all", {axis: name})))),
    refused(told) ?? "", revisions(told) ?? "");
  for (const draw of charts.splice(0)) charts.push(draw());
  return () => charts.forEach((each) => each.end());
}

const section = (title, ...children) => el("section", {"aria-label": title}, el("h2", {}, title), children);

function otherAxes(axes, name) {
  return el("nav", {"aria-label": t("history.axes")}, el("ul", {}, axes.map((axis) => el("li", {},
    el("a", {href: `/history/${encodeURIComponent(axis)}`, "aria-current": axis === name ? "page" : null}, axis)))));
}

function latest(told) {
  if (!told.latest.length) return el("p", {}, t("history.latest.none"));
  return table({
    caption: t("history.latest"),
    head: ["parameter", "newest", "unit", "nominal", "beside", "since", "may", "limit"].map((key) => t(`history.${key}`)),
    rows: told.latest.map((row) => [row.parameter, row.latest, row.unit, row.nominal, row.beside_nominal, row.since_first,
      row.may_change_by, row.limit]),
  });
}

function limits(told) {
  if (!told.limits.length) return null;
  const span = (limit) => t("history.limit.until", {earliest: date(limit.earliest), latest: limit.latest ? date(limit.latest) : t("history.limit.open")});
  return table({
    caption: t("history.limits"),
    head: [t("history.parameter"), t("history.limit.value"), t("history.limit.date"), t("history.limit.span")],
    rows: told.limits.map((limit) => [limit.name, `${number(limit.value)} ${limit.unit}`,
      limit.reached ? lamp("bad", t("history.limit.now")) : date(limit.date), span(limit)]),
  });
}

function parameter(told, axis, charts) {
  const title = told.name === told.parameter ? t("history.course", told) : told.name;
  const place = el("div", {class: "grid"});
  charts.push(() => course(place, {told: told.over_time, caption: t("history.over.time", told)}));
  if (told.over_temperature) {
    charts.push(() => course(place, {told: told.over_temperature, caption: t("history.over.temperature", told)}));
  }
  return el("div", {class: "course"},
    el("h3", {}, title), place,
    el("p", {class: "soft"}, told.over_time.words, " ", told.over_temperature?.words ?? ""),
    el("details", {}, el("summary", {}, t("history.estimates", {...told, count: told.estimates.length})), estimates(told, axis)));
}

function estimates(told, axis) {
  return table({
    caption: t("history.estimates", {...told, count: told.estimates.length}),
    head: [t("history.time"), t("history.value"), t("history.temperature"), t("history.window")],
    rows: told.estimates.map((row) => [minute(row.time), row.shown, number(row.temperature_celsius), rapid(axis, row.window)]),
  });
}

const rapid = (axis, id) => el("a", {href: `/rapids/${encodeURIComponent(axis)}/${id}`}, String(id));

function slopes(told) {
  if (!told.slopes.length) return null;
  return table({
    caption: t("history.slopes"), head: [t("history.parameter"), t("history.unit"), t("history.kelvin"), t("history.day")],
    rows: told.slopes.map((row) => [row.name, row.unit, row.per_kelvin, row.per_day]),
  });
}

function changes(told, axis) {
  if (!told.changes.length) return el("p", {}, t("history.changes.none"));
  return table({
    caption: t("history.changes.caption"), head: [t("history.time"), t("history.window"), t("history.moved"), t("history.cause")],
    rows: told.changes.map((row) => [minute(row.time), rapid(axis, row.window), {text: row.moved, class: "long"}, {text: row.cause, class: "long"}]),
  });
}

function refused(told) {
  if (!told.refused.length) return null;
  return section(t("history.refused"), table({
    caption: t("history.refused.caption"), head: [t("history.reason"), t("history.count"), t("history.last"), t("history.when")],
    rows: told.refused.map((row) => [row.code, String(row.count), {text: row.last_text, class: "long"}, row.last_time]),
  }));
}

function revisions(told) {
  if (!told.revisions.length) return null;
  const names = [...new Set(told.revisions.flatMap((row) => Object.keys(row.parameters)))];
  const caption = t("history.revisions", {shown: told.revisions.length, kept: told.revisions_kept});
  return section(caption, el("details", {}, el("summary", {}, caption), table({
    caption,
    head: [t("history.revision"), t("history.time"), t("history.temperature"), t("history.used"), ...names.map((name) => `${name} (${told.revisions[0].units[name] ?? ""})`)],
    rows: told.revisions.map((row) => [String(row.revision), minute(row.time), number(row.temperature_celsius), String(row.windows_used),
      ...names.map((name) => row.parameters[name] ?? "–")]),
  })));
}
