// Programs before they are cut: drop one, see where and why it errs, without and with the correction.

import {el, faultBox, table} from "/static/dom.js";
import {showForecast} from "/static/forecast.js";

const POLL_MS = 400;
const OVER = ["done", "failed", "cancelled"];

export async function show(main, path, context) {
  const {t} = context;
  const [digest] = path.rest;
  await useStyles();
  const kept = await context.get("/api/program");
  kept.programs = kept.programs.filter((each) => each.digest !== digest);
  const shown = el("div", {});
  const drop = dropPlace(kept, context);
  main.append(el("h1", {}, t("program.title")), ...(digest ? [shown, drop] : [drop]), await learning(context));
  return digest ? follow(shown, digest, path.query, context) : null;
}

// wait until the styles are there, so that nothing is drawn without them
export function useStyles() {
  const place = "/static/pages/program.css";
  if (document.querySelector(`link[href="${place}"]`)) return Promise.resolve();
  return new Promise((drawn) => document.head.append(el("link", {rel: "stylesheet", href: place, onload: drawn, onerror: drawn})));
}

function dropPlace(kept, context) {
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

  const over = (on) => (event) => { event.preventDefault(); box.classList.toggle("over", on); };
  box.addEventListener("dragover", over(true));
  box.addEventListener("dragleave", over(false));
  box.addEventListener("drop", (event) => { over(false)(event); take(event.dataTransfer.files[0]); });
  return el("section", {"aria-labelledby": "program-drop"},
    el("h2", {id: "program-drop"}, t("program.drop.title")),
    el("p", {}, t("program.drop.text")), box, told,
    kept.programs.length ? el("div", {}, el("h3", {}, t("program.kept")), el("ul", {}, kept.programs.map((each) => el("li", {},
      el("a", {href: `/program/${each.digest}`}, each.name), each.state === "done" ? "" : ` (${t(`program.state.${each.state}`)})`)))) : null);
}

// asks until the forecast is over, then shows it; returns what ends it
function follow(shown, digest, query, context) {
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
    if (told.state === "done") end = await showForecast(shown, told, query, context);
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
  part.append(el("p", {}, told.daemon ? (told.passes.length ? "" : t("program.passes.none")) : t("program.passes.silent")));
  if (told.passes.length) part.append(table({
    caption: t("program.passes.caption"),
    head: [t("program.learning.program"), t("program.learning.passes"), t("program.passes.measured"), t("program.passes.predicted"), {text: t("program.passes.ended"), class: "word"}],
    rows: told.passes.map((each) => [
      each.program.split("/").pop(), each.pass, number(each.measured.rms_um, 3), number(each.predicted.rms_um, 3), {text: each.ended_by, class: "word"}]),
  }));
  return part;
}

// the passes as a little curve beside their numbers, which say the same
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
