// The machine: its axes now, the correction, required actions, each parameter within its band; tables as details.

import {el, faultBox, lamp, table} from "/static/dom.js";
import {classOf, dress, minute, noticeText, where} from "/static/notices.js";
import {band} from "/static/sparkline.js";
import {armingPanel} from "/static/pages/arming.js";
import {AxisTraces} from "/static/pages/axis_traces.js";

const SHOWN = {R: ["mΩ", 1e3], L: ["mH", 1e3], K: ["N·m/A", 1], Jt: ["g·m²", 1e3], ft: ["mN·m·s", 1e3], Cd: ["N·m", 1]};
const AT_REST = ["OFF", "OFF(SHADOW)", "FROZEN", "lost"];
const STORE_PERIOD_MS = 30000, PASSES = 3, ALARMS = 3;

export async function show(main, path, context) {
  dress();
  const {t} = context;
  const title = el("h1", {}, t("nav.machine"));
  const names = ["heard", "needs", "guard", "parameters", "axes", "offsets", "numbers"];
  const parts = Object.fromEntries(names.map((name) => [name, el("div")]));
  const arming = armingPanel(context), traces = new AxisTraces(context);
  const tile = (id, ...nodes) => el("section", {class: "tile", "aria-labelledby": id}, el("h2", {id}, t(`machine.${id}`)), nodes);
  main.append(title, parts.heard,
    el("div", {class: "tiles"}, tile("axes", traces.node), tile("correction", parts.guard, arming.node), tile("needs", parts.needs)),
    el("section", {"aria-labelledby": "parameters"}, el("h2", {id: "parameters"}, t("machine.parameters")), parts.parameters),
    el("details", {class: "panel"}, el("summary", {}, t("machine.details")), parts.axes, parts.offsets, parts.numbers));
  const only = path.rest[0] ?? null;
  let revisions = "";
  let drawn = {};

  // a part is redrawn only if its content has changed, so that focus and selection are kept
  function draw(name, shown, ...nodes) {
    const key = JSON.stringify(shown);
    if (drawn[name] === key) return;
    drawn[name] = key;
    parts[name].replaceChildren(...nodes.flat());
  }

  async function drawStored() {
    const told = await context.get("/api/machine/parameters").catch((fault) => ({fault, axes: {}}));
    draw("parameters", [told.axes, told.fault?.text], parameterCharts(told, only, context));
    draw("numbers", [told.axes, told.fault?.text], parameterTables(told, only, context));
  }

  function drawNow({told, status, fault}) {
    arming.update(status, fault);
    title.textContent = told ? told.machine : t("nav.machine");
    draw("heard", [fault?.text, told?.status && heardText(told.status, context)],
      fault ? faultBox(fault) : [], told?.status ? el("p", {class: "soft"}, heardText(told.status, context)) : []);
    if (!told) return;
    traces.update(Object.fromEntries(Object.entries(told.axes).filter(([axis]) => only === null || axis === only)));
    const listed = (status?.troubles ?? []).map(({code, axis}) => code + axis);
    const alarms = fault ? [] : (status?.alarms?.first ?? []).filter(({state, code, axis}) => state === "active" && !listed.includes(code + axis));
    draw("needs", [told.next, alarms], needs(told.next, alarms, context));
    const axes = axisRows(told, status, only, context);
    draw("axes", [axes.key, fault?.code], table({
      stack: true,
      caption: t(fault ? "machine.axes.before" : "machine.axes.caption"), head: axes.head, rows: axes.rows,
    }));
    const guard = guardText(status, fault, context);
    draw("guard", [guard, status?.passes], [...guard.lines.map((line) => el("p", {}, line)), ...passes(status, context)]);
    draw("offsets", guard.offsets, guard.offsets.length ? table({
      caption: t("machine.offsets"),
      head: [t("machine.axis"), t("machine.offset.sent"), t("machine.offset.may"), t("machine.offset.shadow")], rows: guard.offsets,
    }) : []);
    const now = JSON.stringify(Object.values(status?.axes ?? {}).map((axis) => axis.revision));
    if (now !== revisions) { revisions = now; drawStored(); }
  }

  const stop = context.watch(drawNow);
  if (!drawn.parameters) drawStored();
  const timer = setInterval(drawStored, STORE_PERIOD_MS);
  return () => { stop(); clearInterval(timer); arming.end(); traces.end(); };
}

function sentence(text) {
  return text ? `${text[0].toUpperCase()}${text.slice(1)}.` : "";
}

// required actions and active alarms, with a link to all of them
function needs(next, alarms, {t}) {
  const steps = next.map((step) => el("li", {class: step.urgent ? "urgent" : null},
    step.urgent ? lamp("bad", t("machine.urgent")) : null, " ", el("strong", {}, step.text), " ",
    step.page ? el("a", {href: step.page}, sentence(step.advice)) : sentence(step.advice)));
  const shown = alarms.slice(0, ALARMS).map((alarm) => el("li", {},
    lamp({MAJOR: "bad", minor: "warn"}[alarm.severity], t("events.state.active")), " ", el("a", {href: "/events"}, noticeText(alarm)),
    el("span", {class: "soft"}, ` ${where(alarm)}, ${t("events.since", {from: minute(alarm.since)})} `), classOf(alarm)));
  const more = alarms.length > ALARMS ? [el("li", {}, el("a", {href: "/events"}, t("machine.alarms.more", {count: alarms.length - ALARMS})))] : [];
  return el("ul", {class: "steps"}, steps, shown, more);
}

// the last passes: predicted and measured errors
function passes(status, {t, number}) {
  const told = (status?.passes ?? []).slice(-PASSES).reverse();
  if (!told.length) return [el("p", {class: "soft"}, t("machine.passes.none"))];
  return [table({
    caption: t("machine.passes"), class: "small",
    head: [t("machine.pass"), t("machine.pass.predicted"), t("machine.pass.measured")],
    rows: told.map((each) => [`${each.program.split("/").pop()} ${each.pass}`, number(each.predicted.rms_um, 2), number(each.measured.rms_um, 2)]),
  })];
}

function heardText(status, {t, ago, number}) {
  const {source, sync, frames} = status;
  const rate = sync.rate_hz === null
    ? t("machine.sync.none") : t("machine.sync", {rate: number(sync.rate_hz, 4), expected: number(sync.expected_hz, 4)});
  const state = t(`machine.source.${source.state}`, {ago: ago(source.heard_s_ago)});
  return `${state}. ${rate}. ${t("machine.frames", {lost: number(frames.lost, 12)})}.`;
}

function axisRows(told, status, only, {t, number, decimal}) {
  const names = Object.keys(told.axes).filter((axis) => only === null || axis === only);
  const facts = names.map((axis) => {
    const {light, text} = told.axes[axis];
    const now = status?.axes[axis] ?? {};
    const share = now.accepted + now.refused ? t("machine.rapids.of", {good: now.accepted, all: now.accepted + now.refused}) : "–";
    const degrees = now.slideway_c ?? now.temperature_c;
    return [axis, light, text, now.drive_state ?? "–", share, now.skill ? number(now.skill.rms_um, 2) : "–",
      degrees === undefined || degrees === null ? "–" : decimal(degrees, 1)];
  });
  return {
    key: facts,
    head: [t("machine.axis"), {text: t("machine.state"), class: "word"}, {text: t("machine.meaning"), class: "word"},
      {text: t("machine.drive"), class: "word"}, t("machine.rapids"), t("machine.skill"), t("machine.temperature")],
    rows: facts.map(([axis, light, text, drive, share, skill, degrees]) => [
      el("a", {href: `/machine/${axis}`}, axis), {text: lamp(light, t(`light.${light}`)), class: "word"},
      {text, class: "long"}, {text: drive, class: "word"}, el("a", {href: `/rapids?axis=${axis}`}, share), skill, degrees]),
  };
}

function guardText(status, fault, {t, number, decimal}) {
  if (!status || fault) return {lines: [t("machine.guard.unknown")], offsets: []};
  const guard = status.guard ?? {};
  const sent = guard.offset_um ?? {};
  const may = guard.may_stand_um ?? {};
  const shadow = guard.shadow_um ?? {};
  const names = [...new Set([...Object.keys(sent), ...Object.keys(may), ...Object.keys(shadow)])];
  const um = (value) => (value === null || value === undefined ? t("machine.unknown") : decimal(value, 1));
  const lines = [
    t(`guard.${guard.state ?? "absent"}`),
    AT_REST.includes(status.state) ? `${t("machine.stands")} ${sentence(status.may_stand?.text)}` : "",
    status.armed ? t("machine.armed", {program: String(status.armed.program ?? "–").split("/").pop(), promise: status.armed.promise ?? ""}) : "",
    status.checking ? t("machine.checking", {seconds: number(status.checking.checked_s, 3), line: status.checking.line}) : "",
  ].filter(Boolean);
  return {lines, offsets: names.map((axis) => [axis, um(sent[axis]), um(may[axis]), axis in shadow ? um(shadow[axis]) : "–"])};
}

const shownAxes = (told, only) => Object.keys(told.axes).filter((axis) => only === null || axis === only);

function parameterCharts(told, only, context) {
  const {t} = context;
  if (told.fault) return [faultBox(told.fault)];
  const names = shownAxes(told, only);
  if (!names.length) return [el("p", {}, t("machine.parameters.none"))];
  return names.map((axis) => el("div", {class: "small-charts"},
    el("h3", {}, el("a", {href: `/history/${axis}`}, t("machine.parameters.axis", {axis}))),
    el("ul", {}, Object.entries(told.axes[axis].parameters).map(([name, its]) => el("li", {}, smallChart(axis, name, its, context))))));
}

function smallChart(axis, name, {value, low, high, unit, first, change, limit, light, course}, {t, decimal}) {
  const [shownUnit, factor] = SHOWN[name] ?? [unit, 1];
  const half = high === null ? null : (high - value) * factor;
  const [least, most] = first === null ? [null, null] : [first - Math.abs(first) * limit, first + Math.abs(first) * limit];
  const text = half === null ? decimal(value * factor, 3) : `${decimal(value * factor, places(half))} ± ${decimal(half, places(half))}`;
  const moved = change === null ? t("change.none") : t("machine.of", {change: signed(change, decimal), limit: decimal(limit * 100, 0)});
  return [el("p", {}, el("strong", {}, name), el("span", {class: "soft"}, ` ${shownUnit}`)), el("p", {}, text),
    band({label: t("machine.band", {axis, name, change: moved}), course, low, high, least, most}),
    el("p", {}, lamp(light, ""), ` ${moved}`, light === "bad" ? `, ${t("change.bad")}` : "")];
}

// one decimal more than the first digit of half the interval
const places = (half) => (half ? Math.max(0, Math.min(7, 1 - Math.floor(Math.log10(half)))) : 4);
const signed = (change, decimal) => `${change >= 0.0005 ? "+" : ""}${decimal(change * 100, 1)}`;

function parameterTables(told, only, context) {
  const {t, when} = context;
  return shownAxes(told, only).flatMap((axis) => {
    const found = told.axes[axis];
    const stamp = when(found.published_wall_s);
    return [table({
      stack: true,
      caption: t("machine.parameters.caption", {axis, revision: found.revision, when: stamp, rapids: found.windows_used}),
      head: [t("machine.parameter"), t("machine.value"), t("machine.interval"), {text: t("machine.unit"), class: "word"},
        t("machine.change"), t("machine.limit"), {text: t("machine.state"), class: "word"}],
      rows: Object.entries(found.parameters).map(([name, told]) => parameterRow(name, told, context)),
    }), ...found.warnings.map((warning) => el("p", {}, lamp("warn", warning))),
    el("p", {}, el("a", {href: `/history/${axis}`}, t("machine.course", {axis})))];
  });
}

function parameterRow(name, {value, low, high, unit, change, limit, light}, {t, decimal, number}) {
  const [shownUnit, factor] = SHOWN[name] ?? [unit, 1];
  const half = high === null ? null : (high - value) * factor, shown = places(half);
  const interval = low === null ? "–" : t("machine.from.to", {low: decimal(low * factor, shown), high: decimal(high * factor, shown)});
  return [name, decimal(value * factor, shown), interval, {text: shownUnit, class: "word"},
    change === null ? "–" : `${signed(change, decimal)} %`, `±${number(limit * 100, 3)} %`,
    {text: lamp(light, t(`change.${light}`)), class: "word"}];
}
