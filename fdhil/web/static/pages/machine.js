// The machine: what to do next, the axes, the guard and its offsets, the parameters, and arming.

import {el, faultBox, lamp, table} from "/static/dom.js";
import {armingPanel} from "/static/pages/arming.js";

const SHOWN = {R: ["mΩ", 1e3], L: ["mH", 1e3], K: ["N·m/A", 1], Jt: ["g·m²", 1e3], ft: ["mN·m·s", 1e3], Cd: ["N·m", 1]};
const AT_REST = ["OFF", "OFF(SHADOW)", "FROZEN", "lost"];
const STORE_PERIOD_MS = 30000;

export async function show(main, path, context) {
  const {t} = context;
  const title = el("h1", {}, t("nav.machine"));
  const parts = Object.fromEntries(["heard", "next", "axes", "guard", "parameters"].map((name) => [name, el("div")]));
  const arming = armingPanel(context);
  main.append(title, parts.heard,
    el("section", {"aria-labelledby": "next"}, el("h2", {id: "next"}, t("machine.next")), parts.next),
    el("section", {"aria-labelledby": "axes"}, el("h2", {id: "axes"}, t("machine.axes")), parts.axes),
    el("section", {"aria-labelledby": "guard"}, el("h2", {id: "guard"}, t("machine.guard")), parts.guard, arming.node),
    el("section", {"aria-labelledby": "parameters"}, el("h2", {id: "parameters"}, t("machine.parameters")), parts.parameters));
  const only = path.rest[0] ?? null;
  let revisions = "";
  let drawn = {};

  // a part is drawn anew only when what it shows has changed, so that focus and selection stay
  function draw(name, shown, ...nodes) {
    const key = JSON.stringify(shown);
    if (drawn[name] === key) return;
    drawn[name] = key;
    parts[name].replaceChildren(...nodes.flat());
  }

  async function drawStored() {
    const told = await context.get("/api/machine/parameters").catch((fault) => ({fault, axes: {}}));
    draw("parameters", [told.axes, told.fault?.text], parameterTables(told, only, context));
  }

  function drawNow({told, status, fault}) {
    arming.update(status, fault);
    title.textContent = told ? told.machine : t("nav.machine");
    draw("heard", [fault?.text, told?.status && heardText(told.status, context)],
      fault ? faultBox(fault) : [], told?.status ? el("p", {class: "soft"}, heardText(told.status, context)) : []);
    if (!told) return;
    draw("next", told.next, el("ol", {class: "steps"}, told.next.map((step) => el("li", {class: step.urgent ? "urgent" : null},
      step.urgent ? lamp("bad", t("machine.urgent")) : null, " ", el("strong", {}, step.text), " ", step.page ? el("a", {href: step.page}, sentence(step.advice)) : sentence(step.advice)))));
    const axes = axisRows(told, status, only, context);
    draw("axes", [axes.key, fault?.code], table({
      stack: true,
      caption: t(fault ? "machine.axes.before" : "machine.axes.caption"), head: axes.head, rows: axes.rows,
    }));
    const guard = guardText(status, fault, context);
    draw("guard", guard, ...guardNodes(guard, context));
    const now = JSON.stringify(Object.values(status?.axes ?? {}).map((axis) => axis.revision));
    if (now !== revisions) { revisions = now; drawStored(); }
  }

  const stop = context.watch(drawNow);
  if (!drawn.parameters) drawStored();
  const timer = setInterval(drawStored, STORE_PERIOD_MS);
  return () => { stop(); clearInterval(timer); arming.end(); };
}

function sentence(text) {
  return text ? `${text[0].toUpperCase()}${text.slice(1)}.` : "";
}

function heardText(status, {t, ago, number}) {
  const {source, sync, frames} = status;
  const rate = sync.rate_hz === null
    ? t("machine.sync.none") : t("machine.sync", {rate: number(sync.rate_hz, 4), expected: number(sync.expected_hz, 4)});
  const state = t(`machine.source.${source.state}`, {ago: ago(source.heard_s_ago)});
  return `${state}. ${rate}. ${t("machine.frames", {lost: number(frames.lost, 12)})}.`;
}

function axisRows(told, status, only, {t, number}) {
  const names = Object.keys(told.axes).filter((axis) => only === null || axis === only);
  const facts = names.map((axis) => {
    const {light, text} = told.axes[axis];
    const now = status?.axes[axis] ?? {};
    const share = now.accepted + now.refused ? t("machine.rapids.of", {good: now.accepted, all: now.accepted + now.refused}) : "–";
    const degrees = now.slideway_c ?? now.temperature_c;
    return [axis, light, text, now.drive_state ?? "–", share, now.skill ? number(now.skill.rms_um, 2) : "–",
      degrees === undefined || degrees === null ? "–" : number(Math.round(degrees * 10) / 10, 3)];
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

function guardText(status, fault, {t, number}) {
  if (!status || fault) return {lines: [t("machine.guard.unknown")], offsets: []};
  const guard = status.guard ?? {};
  const sent = guard.offset_um ?? {};
  const may = guard.may_stand_um ?? {};
  const shadow = guard.shadow_um ?? {};
  const names = [...new Set([...Object.keys(sent), ...Object.keys(may), ...Object.keys(shadow)])];
  const um = (value) => (value === null || value === undefined ? t("machine.unknown") : number(Math.round(value * 10) / 10, 6));
  const lines = [
    t(`guard.${guard.state ?? "absent"}`),
    AT_REST.includes(status.state) ? `${t("machine.stands")} ${sentence(status.may_stand?.text)}` : "",
    status.armed ? t("machine.armed", {program: String(status.armed.program ?? "–").split("/").pop(), promise: status.armed.promise ?? ""}) : "",
    status.checking ? t("machine.checking", {seconds: number(status.checking.checked_s, 3), line: status.checking.line}) : "",
  ].filter(Boolean);
  return {lines, offsets: names.map((axis) => [axis, um(sent[axis]), um(may[axis]), axis in shadow ? um(shadow[axis]) : "–"])};
}

function guardNodes({lines, offsets}, {t}) {
  return [
    ...lines.map((line) => el("p", {}, line)),
    offsets.length ? table({
      caption: t("machine.offsets"),
      head: [t("machine.axis"), t("machine.offset.sent"), t("machine.offset.may"), t("machine.offset.shadow")], rows: offsets,
    }) : null,
  ].filter(Boolean);
}

function parameterTables(told, only, context) {
  const {t, when} = context;
  if (told.fault) return [faultBox(told.fault)];
  const names = Object.keys(told.axes).filter((axis) => only === null || axis === only);
  if (!names.length) return [el("p", {}, t("machine.parameters.none"))];
  return names.flatMap((axis) => {
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
  const half = high === null ? null : (high - value) * factor;
  // one place beyond the one where half the interval begins
  const places = half ? Math.max(0, Math.min(7, 1 - Math.floor(Math.log10(half)))) : 4;
  const interval = low === null ? "–" : t("machine.from.to", {low: decimal(low * factor, places), high: decimal(high * factor, places)});
  return [name, decimal(value * factor, places), interval, {text: shownUnit, class: "word"},
    change === null ? "–" : `${change >= 0.0005 ? "+" : ""}${decimal(change * 100, 1)} %`, `±${number(limit * 100, 3)} %`,
    {text: lamp(light, t(`change.${light}`)), class: "word"}];
}
