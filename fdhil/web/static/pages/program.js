// Programs before machining: drop one, see where and why it has errors, without and with the correction.

import {el, faultBox, lamp, table} from "/static/dom.js";
import {showForecast} from "/static/forecast.js";
import {minute} from "/static/notices.js";
import {armingPanel} from "/static/pages/arming.js";

const POLL_MS = 400, PASSES = 5, JOBS = 10, NAMED = 20;
const OVER = ["done", "failed", "cancelled"];

export async function show(main, path, context) {
  const {t} = context;
  const [digest] = path.rest;
  await useStyles();
  const [kept, {programs: named}] = await Promise.all([context.get("/api/program"), context.get("/api/machine/programs")]);
  kept.programs = kept.programs.filter((each) => each.digest !== digest);
  const shown = el("div", {});
  const drop = dropPlace(kept, named, context);
  const running = digest ? el("div", {}) : null;
  main.append(el("h1", {}, t("program.title")), ...(digest ? [shown, drop] : [drop]), await jobs(context), await learning(context));
  if (!digest) return null;
  const ends = [follow(shown, digest, path.query, context, running, (told) => ends.push(onTheMachine(running, told, context)))];
  return () => ends.forEach((end) => end());
}

// wait for the styles, so that nothing is drawn without them
export function useStyles() {
  const place = "/static/pages/program.css";
  if (document.querySelector(`link[href="${place}"]`)) return Promise.resolve();
  return new Promise((drawn) => document.head.append(el("link", {rel: "stylesheet", href: place, onload: drawn, onerror: drawn})));
}

function dropPlace(kept, named, context) {
  const {t} = context;
  const megabytes = Math.floor(kept.largest_bytes / 2 ** 20);
  const told = el("div", {"aria-live": "polite"});
  const choose = el("input", {type: "file", id: "program-file", onchange: () => take(choose.files[0])});
  const box = el("div", {class: "drop"},
    el("label", {for: "program-file"}, t("program.drop.label", {megabytes})), choose,
    el("p", {class: "soft"}, t("program.drop.again")));

  async function take(file) {
    if (!file) return;
    if (file.size > kept.largest_bytes) {
      told.replaceChildren(faultBox({code: "TooLarge", text: t("program.too_large", {name: file.name, megabytes})}));
      return;
    }
    told.textContent = t("program.sending", {name: file.name});
    try {
      const query = new URLSearchParams({name: file.name.slice(0, 255)});
      const answer = await context.ask(`/api/program?${query}`, {
        method: "POST", body: file, headers: {"Content-Type": "application/octet-stream"},
      });
      context.go(`/program/${(await answer.json()).digest}`);
    } catch (fault) {
      told.replaceChildren(faultBox(fault));
    }
  }

  // forecast again: its parameters may be newer
  async function takeNamed(name) {
    try {
      context.go(`/program/${(await context.post(`/api/program/named?${new URLSearchParams({name})}`)).digest}`);
    } catch (fault) {
      told.replaceChildren(faultBox(fault));
    }
  }

  const over = (on) => (event) => { event.preventDefault(); box.classList.toggle("over", on); };
  box.addEventListener("dragover", over(true));
  box.addEventListener("dragleave", over(false));
  box.addEventListener("drop", (event) => { over(false)(event); take(event.dataTransfer.files[0]); });
  return el("section", {"aria-labelledby": "program-drop"},
    el("h2", {id: "program-drop"}, t("program.drop.title")),
    el("p", {}, t("program.drop.text")), box, told,
    named.length ? el("div", {}, el("h3", {}, t("program.named")), el("ul", {class: "actions plain"}, named.slice(0, NAMED).map(({name}) => el("li", {},
      el("button", {type: "button", class: "quiet", onclick: () => takeNamed(name)}, name))))) : null,
    kept.programs.length ? el("div", {}, el("h3", {}, t("program.kept")), el("ul", {}, kept.programs.map((each) => el("li", {},
      el("a", {href: `/program/${each.digest}`}, each.name), each.state === "done" ? "" : ` (${t(`program.state.${each.state}`)})`)))) : null);
}

// polls until the forecast is over, then shows it; returns a function that ends it
function follow(shown, digest, query, context, next, onDone) {
  const {t} = context;
  const words = el("span", {});
  const cancel = el("button", {type: "button", onclick: () => context.post(`/api/program/${digest}/cancel`).catch(() => null)}, t("program.cancel"));
  const bar = el("progress", {"aria-label": t("program.title")});
  const waiting = el("section", {}, el("p", {role: "status"}, words), bar, el("p", {class: "actions"}, cancel));
  let timer = null, end = null, ended = false;

  async function look() {
    let told;
    try {
      told = await context.get(`/api/program/${digest}`);
    } catch (fault) {
      if (!ended) shown.replaceChildren(faultBox(fault));
      if (fault.code === "NoNetwork") timer = setTimeout(look, 3000);
      return;
    }
    if (ended) return;
    if (OVER.includes(told.state)) return conclude(told);
    if (!waiting.isConnected) shown.replaceChildren(waiting);
    const step = told.state === "waiting" ? "program.waiting" : `program.step.${told.step ?? "read"}`;
    words.textContent = t(step, {name: told.name, rows: context.number(told.rows ?? 0, 9)});
    timer = setTimeout(look, POLL_MS);
  }

  async function conclude(told) {
    if (waiting.isConnected) context.say(t(`program.${told.state}`, told));
    if (told.state === "done") {
      end = await showForecast(shown, told, query, context, next);
      if (!ended) onDone(told);
    }
    else if (told.state === "failed") shown.replaceChildren(el("section", {}, el("h2", {}, told.name), faultBox(told.fault)));
    else shown.replaceChildren(el("section", {}, el("p", {}, t("program.cancelled", told))));
    if (ended) end?.();
  }

  look();
  return () => { ended = true; clearTimeout(timer); end?.(); };
}

async function learning(context) {
  const {t, number} = context;
  const part = el("section", {"aria-labelledby": "program-learning"}, el("h2", {id: "program-learning"}, t("program.learning")));
  let told;
  try {
    told = await context.get("/api/program/learning");
  } catch (fault) {
    part.append(faultBox(fault));
    return part;
  }
  if (!told.learning) part.append(el("p", {}, t("program.learning.off")));
  else if (!told.lessons.length) part.append(el("p", {}, t("program.learning.none")));
  if (told.lessons.length) part.append(table({
    caption: t("program.learning.caption"),
    head: [{text: t("program.learning.program")}, t("program.learning.passes"), t("program.learning.without"), {text: t("program.learning.curve"), class: "word"}, t("program.learning.drawn")],
    rows: told.lessons.map((each) => [
      {text: each.name ?? t("program.learning.unnamed", {digest: each.program.slice(0, 12)})},
      each.passes, number(each.without_um, 3),
      {text: each.curve_um.slice(-10).map((um) => number(um, 3)).join("  "), class: "word"}, curve(each, t)]),
  }));
  return part;
}

// arm the judged program, and show its passes: measured and predicted
function onTheMachine(place, told, context) {
  const {t, number} = context;
  const arming = armingPanel(context, {name: told.name, digest: told.digest});
  const state = el("p", {role: "status"}), passes = el("div", {});
  place.replaceChildren(el("section", {"aria-labelledby": "program-machine"},
    el("h2", {id: "program-machine"}, t("program.machine")), state, arming.node, passes));
  let drawn = "";
  const stop = context.watch(({status, fault}) => {
    arming.update(status, fault);
    const own = (status?.passes ?? []).filter((each) => each.program_digest === told.digest).slice(-PASSES).reverse();
    const armed = status?.armed?.program_digest === told.digest;
    const key = JSON.stringify([armed, status?.state, own.map((each) => each.pass)]);
    if (key === drawn) return;
    drawn = key;
    state.textContent = armed ? t(`guard.${status.guard?.state ?? "absent"}`) : t("program.machine.not_armed");
    passes.replaceChildren(own.length ? table({
      caption: t("program.machine.passes"), head: [t("program.jobs.pass"), t("program.passes.predicted"), t("program.passes.measured"), t("program.jobs.max")],
      rows: own.map((each) => [each.pass, number(each.predicted.rms_um, 3), number(each.measured.rms_um, 3), number(each.measured.max_um, 3)]),
    }) : "");
  });
  return () => { stop(); arming.end(); };
}

// all stored passes, page by page
async function jobs(context) {
  const {t, number} = context;
  const part = el("section", {"aria-labelledby": "program-jobs"}, el("h2", {id: "program-jobs"}, t("program.jobs")));
  const {jobs: all} = await context.get("/api/program/jobs");
  if (!all.length) { part.append(el("p", {}, t("program.jobs.none"))); return part; }
  const list = el("div", {});
  const more = el("button", {type: "button", onclick: () => draw(shown + JOBS)}, t("program.jobs.more"));
  let shown = 0;
  function draw(count) {
    shown = count;
    list.replaceChildren(table({
      caption: t("program.jobs.caption"), stack: true,
      head: [t("program.learning.program"), t("program.jobs.when"), t("program.jobs.pass"), t("program.jobs.without"), t("program.passes.predicted"),
        t("program.passes.measured"), t("program.jobs.max"), {text: t("program.passes.ended"), class: "word"}],
      rows: all.slice(0, shown).map((each) => [each.program, minute(each.time), each.pass, number(each.without_um, 3), number(each.predicted_um, 3),
        {text: lamp({info: "good", minor: "warn", MAJOR: "bad"}[each.severity], number(each.measured_um, 3))}, number(each.max_um, 3),
        {text: each.ended_by ?? t("program.jobs.whole"), class: "word"}]),
    }));
    more.hidden = shown >= all.length;
  }
  draw(JOBS);
  part.append(list, more);
  return part;
}

// the passes as a small curve next to their numbers
function curve({curve_um: left, without_um: without}, t) {
  const svg = (tag, attributes, ...children) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    node.append(...children);
    return node;
  };
  const most = Math.max(without, ...left, 1e-9);
  const at = (um, k) => `${4 + (left.length > 1 ? k * 112 / (left.length - 1) : 0)},${4 + 32 * (1 - um / most)}`;
  return svg("svg", {class: "curve", viewBox: "0 0 120 40", role: "img", "aria-label": t("program.learning.curve")},
    svg("polyline", {points: left.map(at).join(" ")}),
    ...left.map((um, k) => { const [cx, cy] = at(um, k).split(","); return svg("circle", {cx, cy, r: 2.5}); }));
}
