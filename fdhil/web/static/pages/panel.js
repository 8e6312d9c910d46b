// A panel for a tab of an NC's own screen, from 400 x 300 pixels on: state, offsets, running program, and the Disarm button.

import {el, faultBox, lamp, table} from "/static/dom.js";
import {useStyles} from "/static/pages/program.js";

export async function show(main, path, context) {
  const {t, number} = context;
  await useStyles();
  document.title = t("panel.title");
  const machine = el("h1", {}, "fdhil"), state = el("p", {}), parts = el("div", {class: "rest"}), told = el("div", {"aria-live": "polite"});
  const disarm = el("button", {type: "button", class: "stop", onclick: disarmNow}, t("disarm"));
  const login = el("button", {type: "button", class: "quiet", onclick: () => context.logIn()}, t("login"));
  main.append(el("div", {class: "tab"}, el("div", {class: "head"}, machine, state, disarm, login), told, parts));
  let drawn = "";

  async function disarmNow() {
    told.textContent = t("disarm.asked");
    try {
      told.textContent = t("disarm.done", await context.post("/api/machine/disarm"));
    } catch (fault) {
      told.replaceChildren(faultBox(fault));
    }
    context.lookNow();
  }

  function draw({status, fault}) {
    const {role, login_needed: needed} = context.session();
    disarm.hidden = role !== "operate";
    login.hidden = !needed || role === "operate";
    const known = status && !fault;
    const kind = !known ? "none" : ["FROZEN", "lost"].includes(status.state) ? "bad" : status.state.startsWith("OFF") ? "none" : "warn";
    const facts = known ? [kind, status.machine, status.state, rows(status, context), sentences(status, context)] : [fault?.text];
    if (JSON.stringify(facts) === drawn) return;
    drawn = JSON.stringify(facts);
    state.replaceChildren(lamp(kind, known ? status.state : t("state.unknown")));
    if (!known) { parts.replaceChildren(fault ? faultBox(fault) : ""); return; }
    machine.textContent = status.machine;
    const [, , , axes, lines] = facts;
    parts.replaceChildren(
      table({caption: t("panel.axes"), head: [t("panel.axis"), t("panel.offset"), t("panel.skill"), t("panel.temperature"), {text: t("panel.model"), class: "word"}],
        rows: axes.map((row) => [el("a", {href: `/machine/${row[0]}`, target: "_blank"}, row[0]), ...row.slice(1, -1), {text: row.at(-1), class: "word"}])}),
      ...lines.map((line) => el("p", {}, line)));
  }

  return context.watch(draw);

  function rows(status) {
    const sent = status.guard?.offset_um ?? {};
    return Object.entries(status.axes).map(([axis, told]) => [
      axis, number(sent[axis] ?? NaN, 3), told.skill ? number(told.skill.rms_um, 2) : "–",
      number(told.slideway_c ?? told.temperature_c ?? NaN, 3),
      told.revision ? t("panel.revision", {revision: told.revision}) : t("panel.unknown")]);
  }
}

function sentences(status, {t, number}) {
  const {nc, armed, checking, passes, troubles, guard} = status;
  const name = (program) => String(program ?? "").split("/").pop();
  const percent = (share) => (share === null || share === undefined ? "–" : `${number(share * 100, 3)} %`);
  return [
    troubles?.length ? `${troubles[0].code}: ${troubles[0].text}` : null,
    guard?.cause ? `${guard.cause.code}: ${guard.cause.text}; ${guard.cause.advice}` : null,
    nc && nc.motion !== "unknown" ? t("panel.nc", {
      motion: nc.motion, line: nc.line ?? "–", feed: number(nc.feed_mm_min ?? NaN, 4), override: percent(nc.feed_override)}) : null,
    armed?.program ? t("panel.armed", {program: name(armed.program), promise: armed.promise ?? ""}) : t("panel.armed.none"),
    checking ? t("panel.checking", {program: name(checking.program), line: checking.line}) : null,
    passes?.length ? t("panel.pass", {
      program: name(passes.at(-1).program), measured: number(passes.at(-1).measured.rms_um, 3), predicted: number(passes.at(-1).predicted.rms_um, 3)}) : null,
    status.unacknowledged?.count ? t("panel.waiting", status.unacknowledged) : null,
  ].filter(Boolean);
}
