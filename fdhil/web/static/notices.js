// Notices as pages show them: how grave, what happened, who acknowledged it.

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

export function noticeList(notices) {
  return el("ul", {class: "plain"}, notices.map((notice) => el("li", {},
    el("p", {}, gravity(notice), " ", el("strong", {}, notice.code), `, ${where(notice)}: ${notice.text}`),
    el("p", {class: "soft"}, `${minute(notice.time)} (${t("events.number")} ${notice.number}) `, answered(notice)))));
}
