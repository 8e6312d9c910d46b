// Notices on the pages: severity, text, acknowledgement.

import {el, lamp} from "/static/dom.js";
import {t, when} from "/static/text.js";

const LOOK = "/static/pages/history.css";
export function dress() {
  if (!document.querySelector(`link[href="${LOOK}"]`)) document.head.append(el("link", {rel: "stylesheet", href: LOOK}));
}

const KINDS = {MAJOR: "bad", minor: "warn", info: "none"};
export const minute = (time) => when(Date.parse(time) / 1000);
export const gravity = (notice) => lamp(KINDS[notice.severity], t(`events.${notice.severity}`));
export const where = (notice) => (notice.axis ? t("events.axis", notice) : t("events.machine"));

export function answered(notice) {
  const given = notice.acknowledged;
  if (!given) return notice.severity === "info" ? "" : t("events.waits");
  return t(given.note ? "events.acknowledged.note" : "events.acknowledged", {...given, time: minute(given.time)});
}

// "HeartbeatLost" as "Heartbeat lost"; capitals are kept
const CAPITALS = ["Nc", "Pdo", "Sync", "Crc", "Pc", "Nmt"];
export function classWords(code) {
  const words = code.match(/[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])/g) ?? [code];
  return words.map((word, k) => (CAPITALS.includes(word) ? word.toUpperCase() : k ? word.toLowerCase() : word)).join(" ");
}

export const sentence = (text) => (text ? `${text[0].toUpperCase()}${text.slice(1).replace(/\.$/, "")}.` : "");
export const classOf = ({code}) => el("span", {class: "class"}, classWords(code), " ", el("code", {}, code));
export const noticeText = (notice) => sentence(notice.cause ?? notice.text);

export function noticeList(notices) {
  return el("ul", {class: "plain"}, notices.map((notice) => el("li", {},
    el("p", {}, gravity(notice), " ", el("strong", {}, noticeText(notice))),
    el("p", {class: "soft"}, `${where(notice)}, ${notice.until ? t("events.from.until", {from: minute(notice.time), until: minute(notice.until)}) : minute(notice.time)} (${t("events.number")} ${notice.number}) `,
      answered(notice), " ", classOf(notice)))));
}
