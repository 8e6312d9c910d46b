// The frame of all pages: it routes addresses, draws the navigation, and always shows the state and the Disarm button.

import {el, faultBox, lamp} from "/static/dom.js";
import {ask, download, get, onLoginNeeded, post, socket} from "/static/ask.js";
import {logIn, logOut, lookWho, onSession, session} from "/static/session.js";
import {lookNow, until, watch} from "/static/status.js";
import {typeset} from "/static/typeset.js";
import {ago, decimal, number, t, when} from "/static/text.js";

const PAGES = document.getElementById("nav").dataset.pages.split(" ");
const OF_A_MACHINE = PAGES.includes("machine");
const HIDDEN = OF_A_MACHINE ? ["panel"] : [];
const main = document.getElementById("main");
const told = document.getElementById("told");
let endPage = null;
let turn = 0;

// the arguments of a page besides its element and the parts of its path
export const context = {ask, get, post, socket, download, watch, lookNow, until, session, logIn, disarm: disarmNow, go, say, t, ago, decimal, number, when};

// announce a message: to screen readers at once, on the screen for a while
const SHOWN_MS = 12000;
let hiding = null;
export function say(text) {
  told.textContent = typeset(text);
  told.classList.remove("past");
  clearTimeout(hiding);
  hiding = setTimeout(() => told.classList.add("past"), SHOWN_MS);
}

function pathOf(address) {
  const [name, ...rest] = address.pathname.split("/").filter(Boolean).map(decodeURIComponent);
  return {name: name ?? PAGES[0], rest, query: address.searchParams};
}

// go("/rapids/X/12") shows another page
export function go(address, replace = false) {
  history[replace ? "replaceState" : "pushState"]({}, "", address);
  return show();
}

async function show() {
  const mine = ++turn;
  const path = pathOf(new URL(location.href));
  endPage?.();
  endPage = null;
  markNavigation(path.name);
  say("");
  document.body.classList.toggle("bare", HIDDEN.includes(path.name));
  nameMachine();
  main.setAttribute("aria-busy", "true");
  main.replaceChildren(el("p", {class: "soft"}, t("page.loading")));
  const end = await shown(path, () => mine === turn).catch(failed);
  if (mine === turn) endPage = end; else end?.();
  if (mine === turn) main.removeAttribute("aria-busy");
}

async function shown(path, current) {
  if (session().login_needed && session().role === null) return askToLogIn();
  if (![...PAGES, ...HIDDEN].includes(path.name)) return failed({code: "NotFound", text: t("page.missing")});
  const page = await import(`/static/pages/${path.name}.js`);
  if (!current()) return null;
  main.replaceChildren();
  return page.show(main, path, context);
}

function askToLogIn() {
  main.replaceChildren(
    el("h1", {}, "fdhil"), el("p", {}, t("login.needed")),
    el("button", {type: "button", class: "primary", onclick: logIn}, t("login")));
  return null;
}

function failed(fault) {
  main.replaceChildren(el("h1", {}, "fdhil"), faultBox({
    code: fault.code ?? "PageFault", text: fault.code ? fault.text : t("page.failed", {text: fault.message}), advice: fault.advice,
  }));
  return null;
}

function drawNavigation() {
  document.getElementById("nav").replaceChildren(el("ul", {}, PAGES.map((name) => el("li", {},
    el("a", {href: `/${name}`}, t(`nav.${name}`))))));
  document.getElementById("skip").textContent = t("skip");
  document.getElementById("zone").textContent = t("times.zone", {zone: Intl.DateTimeFormat().resolvedOptions().timeZone});
}

function markNavigation(name) {
  for (const link of document.querySelectorAll("#nav a")) {
    if (link.pathname === `/${name}`) link.setAttribute("aria-current", "page"); else link.removeAttribute("aria-current");
  }
}

// product and machine, on every page
function nameMachine() {
  document.getElementById("machine-name").textContent = named ? ` · ${named}` : "";
  const name = pathOf(new URL(location.href)).name;
  document.title = [[...PAGES].includes(name) ? t(`nav.${name}`) : name, named, "fdhil"].filter(Boolean).join(" – ");
}

// the state of the correction, and the permanent buttons
const state = el("span", {class: "state"});
const disarm = el("button", {type: "button", class: "stop", onclick: disarmNow}, t("disarm"));
const login = el("button", {type: "button", class: "quiet"});

async function disarmNow() {
  say(t("disarm.asked"));
  try {
    const answer = await post("/api/machine/disarm");
    await until((status) => !status.armed);  // the head and the announcement agree
    say(t("disarm.done", answer));
  } catch (fault) {
    say(`${fault.code}: ${fault.text}. ${fault.advice}`);
  }
  lookNow();
}

function drawStanding() {
  const {name, role, login_needed: needed} = session();
  disarm.hidden = !needed || role === null || !OF_A_MACHINE;
  login.hidden = !needed;
  login.textContent = role === null ? t("login") : t("logout", {name});
  login.onclick = role === null ? logIn : () => logOut().then(() => say(t("logout.done")));
  document.getElementById("standing").replaceChildren(OF_A_MACHINE ? state : "", disarm, login);
}

let silent = false, named = "";
function drawState({told, status, fault}) {
  if (told && named !== told.machine) { named = told.machine; nameMachine(); }
  if (fault && !silent) say(fault.status === 0 ? fault.text : t("daemon.silent"));
  if (!fault && silent) say(t("daemon.back"));
  silent = Boolean(fault);
  const known = status && !fault;
  const kind = !known ? "none" : ["FROZEN", "lost"].includes(status.state) ? "bad" : status.state.startsWith("OFF") ? "none" : "warn";
  state.replaceChildren(lamp(kind, known ? t("state", {state: status.state}) : t("state.unknown")));
}

document.addEventListener("click", (event) => {
  const link = event.target.closest?.("a[href]");
  if (!link || event.defaultPrevented || event.button || event.ctrlKey || event.metaKey || event.shiftKey || event.altKey) return;
  if (link.origin !== location.origin || link.target || link.hasAttribute("download") || link.hash) return;
  event.preventDefault();
  go(link.href).then(() => main.focus({preventScroll: true}));
  scrollTo(0, 0);
});
addEventListener("popstate", show);

let unwatch = null;
let readable;
onSession(() => {
  if (session().role === null) named = "";
  nameMachine();
  drawStanding();
  unwatch?.();
  unwatch = session().role === null || !OF_A_MACHINE ? null : watch(drawState);
  if (readable !== session().role) { readable = session().role; show(); }
});
onLoginNeeded(() => lookWho().catch(failed));

const {name: first} = pathOf(location);
if (PAGES.includes(first)) import(`/static/pages/${first}.js`).catch(() => null);  // while the session is requested
drawNavigation();
lookWho().catch(function again(fault) {
  failed(fault);
  setTimeout(() => lookWho().catch(again), 3000);
});
