// Sends requests to the server. The token of a login is stored for this tab only and sent in a header, never in an address or cookie.

import {t} from "/static/text.js";

const KEPT = "fdhil-token";
let token = sessionStorage.getItem(KEPT);
const ended = new EventTarget();

export class Fault extends Error {
  constructor(document, status) {
    super(document.text);
    Object.assign(this, {code: document.code, text: document.text, advice: document.advice ?? "", status, document});
  }
}

export function keep(given) {
  token = given;
  if (given) sessionStorage.setItem(KEPT, given); else sessionStorage.removeItem(KEPT);
}

// call f when a login has ended or is needed
export const onLoginNeeded = (f) => ended.addEventListener("ended", f);

export async function ask(path, {method = "GET", body, headers = {}, signal} = {}) {
  const sent = {...headers, ...(token ? {Authorization: `Bearer ${token}`} : {})};
  if (method !== "GET") sent["X-Fdhil"] = "1";
  let answer;
  try {
    answer = await fetch(path, {method, body, headers: sent, signal, credentials: "omit", cache: "no-store"});
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Fault({code: "NoNetwork", text: t("network.lost"), advice: t("network.advice")}, 0);
  }
  if (answer.ok) return answer;
  const told = await answer.json().catch(() => ({code: String(answer.status), text: answer.statusText}));
  if (answer.status === 401 && path !== "/api/session") {
    keep(null);
    ended.dispatchEvent(new Event("ended"));
  }
  throw new Fault(told, answer.status);
}

// get("/api/…") returns the document; post("/api/…", {…}) sends one and returns the answer
export const get = async (path, options = {}) => (await ask(path, options)).json();
export const post = async (path, document = {}, options = {}) => (await ask(path, {
  method: "POST", body: JSON.stringify(document), ...options,
  headers: {"Content-Type": "application/json", ...options.headers},
})).json();

// a socket to the server, with the login: messages as from WebSocket
export function socket(path) {
  const place = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`;
  return new WebSocket(place, ["fdhil", ...(token ? [`bearer.${token}`] : [])]);
}

// save the content of an address as a file
export async function download(path, name) {
  const place = URL.createObjectURL(await (await ask(path)).blob());
  const link = Object.assign(document.createElement("a"), {href: place, download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(place), 10000);
}
